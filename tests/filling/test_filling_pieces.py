"""Laws of isolated pieces: named, and joined, dropped or kept as asked."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import discs, joined, sphere
from fillings import SPACING, filled

from physics3d.clusters import clusters
from physics3d.log import Log


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def two_pieces(rng, gap: float):
    """Balls of 5 and 2 cm radius, `gap` apart along x."""
    small = discs(*sphere(2500, 0.02, rng), rng)
    small = replace(small, mean=small.mean + torch.tensor([0.07 + gap, 0, 0]))
    return joined(discs(*sphere(8000, 0.05, rng), rng), small)


def pieces(body) -> int:
    return int(clusters(body.position.double().numpy(), 2 * SPACING).max()) + 1


def test_small_pieces_are_dropped_when_asked_and_said_in_one_line(rng, tmp_path):
    crumb = discs(*sphere(1500, 0.012, rng), rng)
    crumbs = [replace(crumb, mean=crumb.mean + torch.tensor([side, 0, 0])) for side in (0.1, -0.1)]
    gaussians = joined(joined(discs(*sphere(8000, 0.05, rng), rng), crumbs[0]), crumbs[1])
    log = Log(tmp_path, quiet=True)
    kept, dropped = filled(gaussians), filled(gaussians, drop_pieces_below=0.05, log=log)
    said = [line for line in (tmp_path / "log.txt").read_text().splitlines() if "isolated piece" in line]
    assert len(said) == 1 and "too small to keep: 2, of " in said[0]
    assert float(kept.position[:, 0].max()) > 0.08
    assert float(dropped.position[:, 0].max()) < 0.06
    assert len(dropped.embedding.which) == len(gaussians)


@pytest.mark.parametrize(("isolated", "gap", "count"), [
    ("attach", 2.5, 1), ("attach", 6, 2), ("keep", 2.5, 2), ("drop", 2.5, 1),
])  # fmt: skip
def test_isolated_pieces_are_named_and_treated_as_asked(isolated, gap, count, rng, tmp_path):
    """A gap of 2.5 spacings is bridged, one of 6 is not (from particle to particle it is one more, and four are
    the limit); wherever the piece goes, its Gaussians ride along."""
    gaussians = two_pieces(rng, gap * SPACING)
    body = filled(gaussians, isolated=isolated, log=Log(tmp_path, quiet=True))
    assert pieces(body) == count
    assert len(body.embedding.which) == len(gaussians)
    reaches = float(body.position[:, 0].max()) > 0.06
    assert reaches == (isolated != "drop")
    said = (tmp_path / "log.txt").read_text()
    fate = {"attach": "attached across" if gap < 6 else "kept", "keep": "kept", "drop": "dropped"}[isolated]
    assert "isolated piece at (0.1" in said or "isolated piece at (0.0" in said
    assert "% of the volume, " + fate in said
    if isolated == "attach" and gap < 6:
        whole = filled(gaussians, isolated="keep")
        # the bridge is thin: 31 particles of 3000
        assert 1 < float(body.volume.sum() / whole.volume.sum()) < 1.02


def test_pieces_of_different_parts_are_not_joined(rng):
    gaussians = two_pieces(rng, 3 * SPACING)
    label = torch.ones(len(gaussians), dtype=torch.int32)
    label[8000:] = 2
    assert pieces(filled(gaussians, isolated="attach", label=label)) == 2


def test_gaussians_ride_on_their_own_side_of_a_gap(rng):
    gaussians = two_pieces(rng, 2.5 * SPACING)
    body = filled(gaussians)
    side = (body.position[:, 0] > 0.055)[body.embedding.neighbours]
    carried = torch.where(body.embedding.weights != 0, side, side[:, :1])
    assert bool((carried == (torch.arange(len(gaussians)) >= 8000)[:, None]).all())
