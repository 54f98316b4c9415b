"""The grid is no larger than the way that particles can go."""

import torch
from mpm_bodies import CUBE, small_rollout, soft_world


def test_room_of_the_grid_does_not_grow_with_the_speed(monkeypatch):
    """Under 1e6 m/s^2 the first, far too long substeps are rejected on a small grid, not tried on a huge one."""
    monkeypatch.setattr("physics3d.mpm.window.MOST_NODES", 100**3)
    world = soft_world(gravity=(0.0, 0.0, -1e6))
    trajectory = small_rollout(world, frames=2, frame_dt=1e-3)
    dt = trajectory.substep_dt
    fallen = (trajectory.position[-1] - CUBE)[:, 2]
    # g t (t + dt)/2, as in free fall at any other acceleration
    torch.testing.assert_close(fallen, torch.full_like(fallen, -1e6 * 1e-3 * (1e-3 + dt) / 2), atol=0, rtol=1e-9)
