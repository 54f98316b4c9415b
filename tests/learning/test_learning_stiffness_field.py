"""A field of stiffness: its weights, when it is taken, and a body that is soft at its foot."""

import math
from dataclasses import replace

import pytest
import torch
from small_scene import ELASTIC, bar, bar_chain, cameras, capture, learner, world

from physics3d.learning.fields import GlobalField
from physics3d.learning.stiffness_field import StiffnessField, trilinear, worth
from physics3d.log import Log

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


class Graded:
    """A bar whose lower half is soft: one number per particle, told by nobody but its height."""

    def parameters(self, theta):
        high = bar()[1].position[:, 2] > 0.2
        return {
            "youngs_modulus": torch.where(high, STIFF, SOFT).double(),
            "poissons_ratio": torch.tensor(0.3, dtype=torch.float64),
        }

    def velocity(self, theta):
        return torch.zeros(3, dtype=torch.float64)

    def zero(self):
        return torch.zeros(1, dtype=torch.float64)


def graded():
    """Clips of it from two sides."""
    blank = capture(ELASTIC, frames=FRAMES, views=2)
    chain = bar_chain(world(ELASTIC), Graded(), blank, FRAMES)
    with torch.no_grad():
        motion = chain.simulate(torch.zeros(1))
        clips = [chain.render(motion, view, torch.arange(FRAMES)) for view in range(2)]
    videos = tuple((c.clamp(0, 1) * 255).round().to(torch.uint8) for c in clips)
    return replace(blank, takes=(replace(blank.takes[0], videos=videos, cameras=cameras(2)),))


def test_a_soft_foot_is_found_and_a_uniform_bar_keeps_one_stiffness(tmp_path):
    """The ratio of the halves is 8; half of its logarithm is asked: nodes half a bar apart cannot follow a step, and
    a stiff top hardly bends."""
    options = dict(frames=FRAMES, steps=5, nodes=3, views_per_step=0, search=3, search_span=4.0, polish=2)
    stage = learner({"youngs_modulus": 2e4, "poissons_ratio": 0.3}, ("youngs_modulus",), **options)
    estimate = stage(graded(), *bar(), log=Log(tmp_path, quiet=True))
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
