"""A field of stiffness: its weights, when it is taken, and bodies that are soft at their foot or at their top."""

import math
from dataclasses import replace

import pytest
import torch
from small_scene import ELASTIC, bar, bar_chain, cameras, capture, learner, world

from physics3d.learning.fields import GlobalField
from physics3d.learning.interval import Beyond
from physics3d.learning.stiffness_field import StiffnessField, smooth, trilinear, worth
from physics3d.log import Log
from physics3d.materials.mixture import Mixture
from physics3d.materials.viscoelastic import Viscoelastic

STIFF, SOFT = 8e4, 1e4  # [Pa]
FRAMES = 6  # a quarter of a second: the push, and the bar on its way back


def test_weights_reproduce_what_is_linear():
    """Trilinear interpolation is exact for linear functions, wherever all nodes of a cell count."""
    X = torch.rand((400, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    X[0], X[1] = 0, 1
    X[:, 2] *= 3
    weights = trilinear(X, 4)
    assert weights.shape[1] == 2 * 2 * 4
    torch.testing.assert_close(weights.sum(1), torch.ones(400).double(), rtol=0, atol=1e-14)
    linear = X @ torch.tensor([0.3, -0.2, 0.7]).double() + 1
    at_nodes = torch.linalg.lstsq(weights, linear).solution
    torch.testing.assert_close(weights @ at_nodes, linear, rtol=0, atol=1e-12)


@pytest.mark.parametrize("nodes", [2, 3, 5])
def test_nodes_without_matter_do_not_count(nodes):
    """A line of particles has nodes along itself, whatever there would be beside it."""
    X = torch.zeros(100, 3)
    X[:, 2] = torch.linspace(0, 1, 100)
    weights = trilinear(X, nodes)
    assert weights.shape[1] == nodes and float(weights.min()) >= 0
    bent = X.clone()
    bent[:50, 0] = torch.linspace(1, 0, 50)  # an L: its corner has a node, the far corner of the square has none
    assert nodes < trilinear(bent, nodes).shape[1] < nodes**2 or nodes == 2


def test_only_moduli_vary_and_zero_is_one_stiffness():
    """Doubling all nodes' theta is doubling the modulus; Poisson's ratio stays a number."""
    whole = GlobalField(start=world(ELASTIC).estimate().parameters, learn=("youngs_modulus",))
    field = StiffnessField(whole=whole, weights=trilinear(bar()[0].mean, 3))
    assert field.parameters(field.zero())["youngs_modulus"].tolist() == pytest.approx([2e4] * 256)
    theta = field.zero()
    theta[1:] = math.log(2)
    values = field.parameters(theta)
    assert values["youngs_modulus"].tolist() == pytest.approx([4e4] * 256)
    assert values["poissons_ratio"].dim() == 0
    assert float(field.bound(theta * 1e6)[1:].exp().max()) == pytest.approx(whole.span)


def test_what_a_field_is_worth():
    """Schwarz: 8 nodes cost 4 ln n; half the loss is worth n/2 ln 2. With 20 independent data that is less."""
    for independent, taken in ((20, False), (60, True)):
        gain, cost = worth(2.0, 1.0, nodes=8, independent=independent)
        assert gain == pytest.approx(0.5 * independent * math.log(2)) and cost == pytest.approx(
            4 * math.log(independent)
        )
        assert (gain > cost) == taken


def test_a_smooth_field_is_a_gaussian_process():
    """Its covariance is that of the formula, 1 at every particle, from few numbers. The eigenvectors that are left out
    have a fiftieth of the largest eigenvalue at most: some hundredths in the mean, and more at the ends.
    """
    X, length = bar()[1].position.double(), 0.1
    weights = smooth(X, length)
    expected = (-torch.cdist(X, X).square() / (2 * length**2)).exp()
    off = (weights @ weights.T - expected).abs()
    assert float(off.mean()) < 0.03 and float(off.max()) < 0.2
    torch.testing.assert_close(weights.norm(dim=1), torch.ones(len(X)).double())
    assert smooth(X, 0.2).shape[1] < weights.shape[1] < smooth(X, 0.05).shape[1] < 40


def test_a_field_goes_on_from_the_particles_of_its_covariance_to_all():
    """3000 places on a line, of which 500 make the covariance, 150 to a length: the places are others by a thousandth
    of the line, a 300th of the length, and so is the field."""
    X = torch.zeros(3000, 3)
    X[:, 0] = torch.linspace(0, 1, 3000)
    weights, few = smooth(X, 0.3), smooth(X[::6], 0.3)
    assert weights.shape[1] == few.shape[1]
    torch.testing.assert_close(weights[::6] @ weights[::6].T, few @ few.T, rtol=0, atol=1 / 300)


def test_every_particle_stays_within_the_span_of_its_start():
    whole = GlobalField(start=world(ELASTIC).estimate().parameters, learn=("youngs_modulus",), span=10.0)
    field = StiffnessField(whole=whole, weights=trilinear(bar()[0].mean, 3))
    theta = field.zero()
    theta[0], theta[1:3] = math.log(8), math.log(8)
    values = field.parameters(theta)["youngs_modulus"]
    assert float(values.max()) == pytest.approx(2e5) and float(values.min()) == pytest.approx(1.6e5)


class Graded:
    """A bar of two halves: one number per particle, told by nobody but its height."""

    def __init__(self, *, low: float, high: float):
        self.low, self.high = low, high

    def parameters(self, theta):
        high = bar()[1].position[:, 2] > 0.2
        return {
            "youngs_modulus": torch.where(high, self.high, self.low).double(),
            "poissons_ratio": torch.tensor(0.3, dtype=torch.float64),
        }

    def velocity(self, theta):
        return torch.zeros(3, dtype=torch.float64)

    def heavier(self, theta):
        return 0.0

    def zero(self):
        return torch.zeros(1, dtype=torch.float64)


def graded(**halves: float):
    """Clips of it from two sides."""
    blank = capture(ELASTIC, frames=FRAMES, views=2)
    chain = bar_chain(world(ELASTIC), Graded(**halves), blank, FRAMES)
    with torch.no_grad():
        motion = chain.simulate(torch.zeros(1))
        clips = [chain.render(motion, view, torch.arange(FRAMES)) for view in range(2)]
    videos = tuple((c.clamp(0, 1) * 255).round().to(torch.uint8) for c in clips)
    return replace(blank, takes=(replace(blank.takes[0], videos=videos, cameras=cameras(2)),))


def test_a_soft_foot_is_found_and_a_uniform_bar_keeps_one_stiffness(tmp_path):
    """The ratio of the halves is 8; half of its logarithm is asked: nodes half a bar apart cannot follow a step, and
    a stiff top hardly bends."""
    options = dict(frames=FRAMES, steps=5, nodes=3, views_per_step=0, search=3, search_span=4.0, polish=2)
    options |= dict(beyond=Beyond(density=0.0))  # the density is as given
    stage = learner({"youngs_modulus": 2e4, "poissons_ratio": 0.3}, ("youngs_modulus",), **options)
    estimate = stage(graded(low=SOFT, high=STIFF), *bar(), log=Log(tmp_path, quiet=True))
    E, z = estimate.parameters["youngs_modulus"].double(), bar()[1].position[:, 2]
    assert E.shape == (256,)
    ratio = float(E[z > 0.25].log().mean() - E[z < 0.15].log().mean())
    assert ratio > 0.5 * math.log(STIFF / SOFT)
    assert list(estimate.intervals) == ["youngs_modulus"]
    assert "taken" in (tmp_path / "log.txt").read_text()
    assert (tmp_path / "previews" / "stiffness.png").stat().st_size > 1000
    plain = stage(capture(ELASTIC, frames=FRAMES, views=2), *bar(), log=Log(tmp_path / "plain", quiet=True))
    assert plain.parameters["youngs_modulus"].dim() == 0
    assert "one stiffness is kept" in (tmp_path / "plain" / "log.txt").read_text()


def geometric_mean(values: torch.Tensor, where: torch.Tensor) -> float:
    return float(values[where].double().log().mean().exp())


def test_a_soft_blossom_on_a_stiff_stem_is_found_by_a_smooth_field(tmp_path):
    """Within a factor 1.6 each, of the 8 between them: the field cannot follow a step within its length, half the bar.
    What is held, below 0.06, does not show."""
    options = dict(frames=FRAMES, steps=2, smooth=0.2, views_per_step=0, search=3, search_span=4.0, polish=4)
    stage = learner({"youngs_modulus": 2e4, "poissons_ratio": 0.3}, ("youngs_modulus",), **options)
    estimate = stage(graded(low=STIFF, high=SOFT), *bar(), log=Log(tmp_path, quiet=True))
    E, z = estimate.parameters["youngs_modulus"], bar()[1].position[:, 2]
    assert len(E.unique()) == 16, "every layer of particles has its own"
    stem, blossom = geometric_mean(E, (z > 0.06) & (z < 0.15)), geometric_mean(E, z > 0.25)
    assert 1 / 1.6 < stem / STIFF < 1.6 and 1 / 1.6 < blossom / SOFT < 1.6, (stem, blossom)


def test_a_soft_blossom_on_a_stiff_stem_is_found_by_parts():
    """Where the parts are known there is no step to follow: the moduli that made the clip, in a thousandth of a pixel's
    error: 5 %."""
    law = Viscoelastic(branches=0)
    start = {f"{part}.{name}": value for part in ("stem", "blossom") for name, value in ELASTIC.items()}
    stage = learner(ELASTIC, ("youngs_modulus",), frames=FRAMES, steps=0, search=3, search_span=4.0, polish=6)
    there = replace(stage.world, material=Mixture(materials={"stem": law, "blossom": law}), start=start)
    stage = replace(stage, world=there, learn=("stem.youngs_modulus", "blossom.youngs_modulus"))
    gaussians, body = bar()
    high = (body.position[:, 2] > 0.2).to(torch.int32)
    found = stage(
        graded(low=STIFF, high=SOFT), gaussians, replace(body, part=high, parts=("stem", "blossom")), log=Log(None)
    )
    assert float(found.parameters["stem.youngs_modulus"]) == pytest.approx(STIFF, rel=0.05)
    assert float(found.parameters["blossom.youngs_modulus"]) == pytest.approx(SOFT, rel=0.05)
