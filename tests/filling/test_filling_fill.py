"""Laws of filling as a whole: all Gaussians ride along, some make no particles, nonsense is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import discs, joined, sheet, sphere
from fillings import WITH, filled


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_every_moving_gaussian_is_embedded_and_parts_are_kept(rng):
    a, b = discs(*sphere(4000, 0.03, rng), rng), discs(*sphere(4000, 0.03, rng), rng)
    c = discs(*sheet(500, 0.3, rng), rng)
    b = replace(b, mean=b.mean + torch.tensor([0.1, 0, 0]))
    label = torch.cat([torch.full((len(g),), k, dtype=torch.int32) for g, k in ((c, 0), (a, 1), (b, 2))])
    gaussians = joined(c, a, b)
    body = filled(gaussians, label=label)
    assert torch.equal(body.embedding.which, torch.nonzero(label > 0).flatten())
    assert torch.equal(body.part, (body.position[:, 0] > 0.05).to(torch.int32))
    body.check()


def test_a_model_of_many_faint_gaussians_is_filled_as_one_of_opaque_ones(rng):
    """A fit may cover a surface by ten layers of a tenth each: all of them are its surface."""
    gaussians = discs(*sphere(8000, 0.05, rng), rng)
    faint = replace(gaussians, opacity_logit=torch.logit(0.06 * gaussians.opacity))
    assert float(faint.opacity.max()) < WITH["opacity"]
    assert torch.equal(filled(faint).position, filled(gaussians).position)


def test_floaters_become_no_particles(rng):
    gaussians = discs(*sphere(8000, 0.05, rng), rng)
    far = discs(rng.uniform(-0.2, 0.2, (12, 3)) + np.array([0, 0, 0.4]), np.tile([0.0, 0.0, 1.0], (12, 1)), rng)
    body = filled(joined(gaussians, far))
    assert float(body.position.norm(dim=1).max()) < 0.06
    assert len(body.embedding.which) == 8012


def test_nonsense_is_refused_with_a_remedy(rng):
    gaussians = discs(*sphere(1000, 0.05, rng), rng)
    with pytest.raises(ValueError, match="no Gaussian may move"):
        filled(gaussians, label=torch.zeros(1000, dtype=torch.int32))
    with pytest.raises(ValueError, match=r"fill.spacing is 0 m"):
        filled(gaussians, spacing=0.0)
    with pytest.raises(ValueError, match=r"fill.spacing = 1e-05 m cuts .* take at least"):
        filled(gaussians, spacing=1e-5)
    with pytest.raises(ValueError, match=r"only 3 of 3 moving Gaussians .* segment.prompts"):
        filled(gaussians, label=(torch.arange(1000) < 3).to(torch.int32))
    with pytest.raises(ValueError, match=r"fill.isolated is 'burn'; take one of attach"):
        filled(gaussians, isolated="burn")


@pytest.mark.parametrize(("radius", "spacing"), [(0.05, 5.0), (0.001, 0.01)])
def test_a_body_smaller_than_a_cell_is_refused(radius, spacing, rng):
    gaussians = discs(*sphere(1000, radius, rng), rng, sigma=radius / 20, thickness=radius / 100)
    # a cell is two spacings
    with pytest.raises(
        ValueError, match=rf"fill.spacing is {spacing:g} m, and the body .* smaller than a cell .* take"
    ):
        filled(gaussians, spacing=spacing)
