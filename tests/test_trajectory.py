"""A trajectory survives a file, and its parts agree."""

from pathlib import Path

import pytest
import torch
from mpm_bodies import small_rollout

from physics3d.trajectory import Trajectory


def test_trajectory_survives_a_file(tmp_path: Path):
    trajectory = small_rollout()
    trajectory.save(tmp_path)
    again = Trajectory.load(tmp_path)
    assert torch.equal(again.position, trajectory.position) and again.health == trajectory.health


def test_parts_that_disagree_are_refused(unchecked, tmp_path: Path):
    trajectory = Trajectory(
        rest_position=torch.zeros(5, 3), position=torch.zeros(2, 4, 3), deformation=torch.zeros(2, 5, 3, 3),
        fps=24.0, health={}, substeps=1, substep_dt=0.1,
    )  # fmt: skip
    with pytest.raises(ValueError, match="disagree; expected"):
        trajectory.save(tmp_path)
