"""Held particles are a fixed region of any shape."""

import pytest
import torch
from mpm_bodies import block, soft_world, tensors

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.log import Log
from physics3d.mpm.rollout import rollout


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_held_particles_of_a_box_are_a_fixed_region(precision):
    """Halfway to the particles above those below z = 0.1 m lies z = 0.1 m, the face of the box."""
    position, volume = block((3, 2, 4), 0.1)
    push = torch.tensor((0.3, 0.2, -0.1), dtype=torch.float64)
    below = HeldParticles(position=position[position[:, 2] < 0.1])
    ends = []
    for boundary in (below, FixedRegion(lower=(-9.0, -9.0, -9.0), upper=(9.0, 9.0, 0.1))):
        world = soft_world(boundaries=(boundary,), precision=precision)
        more = dict(velocity=push, frames=4, frame_dt=0.03, threads=1, log=Log(None))
        with torch.no_grad():
            ends.append(rollout(world, tensors(world.start), position, volume, **more).position[-1])
    moved = (ends[0] - position).norm(dim=1)
    assert float(moved[position[:, 2] > 0.3].min()) > 1e-3
    # the box is a thousandth of a cell larger, for nodes on its surface
    assert float((ends[0] - ends[1]).norm()) < 2e-3 * float((ends[1] - position).norm())


@pytest.mark.parametrize("position", [(), ((1.0, 2.0),), ((0.0, 0.0, float("inf")),)], ids=["none", "two", "infinite"])
def test_positions_that_make_no_sense_are_refused(position):
    with pytest.raises(ValueError, match=r"HeldParticles.position is .* take finite positions"):
        HeldParticles(position=position).check()
