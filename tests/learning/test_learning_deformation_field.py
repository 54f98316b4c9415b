"""The deformation field without physics: its shape functions, and a motion that it has to find."""

import pytest
import torch
from small_scene import ELASTIC, bar, bar_chain, capture, world

from physics3d.learning.chain import filmed
from physics3d.learning.deformation_field import fit_field, shape_functions, spread
from physics3d.learning.fields import GlobalField
from physics3d.log import Log


def test_shape_functions_sum_to_one_and_their_slopes_are_those_of_differences():
    """Float64, central differences of 1e-6 of the reach: 1e-8 of the slope."""
    X = torch.rand((50, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    centre, reach = spread(X, 9)
    w, slope = shape_functions(X, centre, reach)
    torch.testing.assert_close(w.sum(1), torch.ones(50, dtype=torch.float64), rtol=0, atol=1e-14)
    h = 1e-6 * reach
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = h
        difference = (shape_functions(X + step, centre, reach)[0] - shape_functions(X - step, centre, reach)[0]) / h / 2
        torch.testing.assert_close(slope[..., axis], difference, rtol=0, atol=1e-7 / reach)


def test_nodes_are_points_of_the_body_far_from_each_other():
    """Of a line of 101 points at equal distances, 5 nodes: both ends, the middle, the quarters."""
    X = torch.zeros(101, 3)
    X[:, 0] = torch.arange(101) / 100
    centre, reach = spread(X, 5)
    assert sorted(centre[:, 0].tolist()) == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    assert reach == pytest.approx(0.25)
    assert len(spread(X[:3], 48)[0]) == 3


def test_a_filmed_motion_is_found_without_physics_and_only_where_it_was_filmed():
    """The bar's own clip, against the particles of the simulation that drew it: the mean height of the picture's
    motion is found within a tenth; depth, which one camera hardly shows, is not asked for."""
    clip = capture(ELASTIC, frames=6)
    field = GlobalField(start=world(ELASTIC).estimate().parameters, learn=("youngs_modulus",))
    chain = bar_chain(world(ELASTIC), field, clip, 6)
    with torch.no_grad():
        truth = chain.simulate(field.zero())
    gaussians, body = bar()
    clips, draw = filmed(clip, gaussians, body, clip.takes[0], torch.arange(6), image_scale=1.0, device="cpu")
    options = dict(prior=chain.prior, fps=20.0, nodes=12, steps=80, learning_rate=0.05)
    found = fit_field(clips, draw, body, **options, log=Log(None))
    moved, true = (m.position - m.position[0] for m in (found, truth))
    top = bar()[1].position[:, 2] > 0.3
    assert float(true[-1, top, 0].abs().mean()) > 0.01, "or there is nothing to find"
    error = (moved - true)[:, top, 0].square().mean().sqrt() / true[:, top, 0].square().mean().sqrt()
    assert float(error) < 0.1
    found.check()
    assert torch.equal(found.position[0], bar()[1].position)
