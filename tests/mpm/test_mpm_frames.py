"""A frame that turns out too fast is done again, and what stays too fast says why; never in NaN."""

from dataclasses import replace

import pytest
import torch
from mpm_bodies import CUBE, small_rollout, soft_world

from physics3d.boundaries.impulse import Impulse


def test_one_frame_is_the_initial_state():
    trajectory = small_rollout(frames=1)
    assert torch.equal(trajectory.position[0], CUBE) and trajectory.substeps == 0


@pytest.mark.parametrize("force", [1e4, 1e7])
def test_an_impulse_that_would_cross_the_grid_in_a_substep_ends_well_or_says_why(force):
    poke = Impulse(force=(force, 0.0, 0.0), centre=(0.1, 0.1, 0.1), radius=1.0, start=0.005, duration=0.01)
    try:
        trajectory = small_rollout(excitation=(poke,), frames=3)
    except ValueError as error:
        assert "frame" in str(error) and ("take" in str(error) or "enlarge" in str(error))
    else:
        # the whole body takes off rigidly with the momentum of the impulse, in ever more substeps
        assert trajectory.health["momentum_x"][-1] == pytest.approx(force * 0.01, rel=1e-6)
        assert torch.isfinite(trajectory.deformation).all()


def test_fixed_substep_that_becomes_too_long_is_reported_with_frame_and_remedy():
    poke = Impulse(force=(1e4, 0.0, 0.0), centre=(0.1, 0.1, 0.1), radius=1.0, start=0.03, duration=0.01)
    with pytest.raises(ValueError, match=r"frame \d: .*take world.dt <"):
        small_rollout(soft_world(dt=0.01), excitation=(poke,), frames=5)


def test_rejected_substeps_are_counted_and_what_stays_too_fast_is_placed_in_time_and_space():
    poke = Impulse(force=(1e4, 0.0, 0.0), centre=(0.1, 0.1, 0.1), radius=1.0, start=0.005, duration=0.01)
    health = small_rollout(excitation=(poke,), frames=3).health
    assert sum(health["rejected"]) > 0
    with pytest.raises(ValueError, match=r"frame 1: particle \d+ at \(.*\) m moves .* cells in a step .* from 0 s on"):
        small_rollout(
            soft_world(scheme="implicit", dt=0.02), excitation=(replace(poke, force=(1e5, 0.0, 0.0)),), frames=3
        )
