"""The health of a frame counts what it says."""

import torch
from mpm_bodies import CUBE, CUBE_VOLUME, small_rollout


def test_isolated_and_lone_particles_are_counted_and_stay_finite():
    position = torch.cat([CUBE, torch.tensor([[1.0, 0.0, 0.0], [5.0, 0.0, 0.0]], dtype=torch.float64)])
    volume = torch.cat([CUBE_VOLUME, CUBE_VOLUME[:2]])
    trajectory = small_rollout(position=position, volume=volume, velocity=0.3 * position.flip(1))
    assert trajectory.health["isolated"][0] == 2
    assert torch.isfinite(trajectory.deformation).all()
    alone = small_rollout(position=CUBE[:1], volume=CUBE_VOLUME[:1], velocity=torch.ones(3))
    assert alone.health["isolated"] == [1, 1, 1]
