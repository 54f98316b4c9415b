"""Bodies and regions that cannot be are refused in one line with field, value and remedy; odd ones are simulated."""

import math
from dataclasses import replace

import pytest
import torch
from mpm_bodies import CUBE, CUBE_VOLUME, small_rollout, soft_world, tensors


@pytest.mark.parametrize(
    "name, value", [("youngs_modulus", -1.0), ("poissons_ratio", 0.5), ("youngs_modulus", math.nan)]
)
def test_senseless_parameters_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        small_rollout(parameters=tensors(soft_world().start | {name: value}))


def test_senseless_bodies_are_refused(unchecked):
    for position, volume, says in (
        (torch.where(torch.arange(64)[:, None] == 3, torch.nan, CUBE), CUBE_VOLUME, "position holds 3 non-finite"),
        (CUBE, torch.zeros_like(CUBE_VOLUME), "volume of 64 of 64 particles"),
        (CUBE, CUBE_VOLUME[:5], "volume has shape"),
        (CUBE[:0], CUBE_VOLUME[:0], "at least one particle"),
    ):
        with pytest.raises(ValueError, match=says):
            small_rollout(position=position, volume=volume)
    with pytest.raises(ValueError, match="frames is 0"):
        small_rollout(frames=0)
    with pytest.raises(ValueError, match="frame_dt is 0"):
        small_rollout(frame_dt=0.0)
    with pytest.raises(ValueError, match="velocity has shape"):
        small_rollout(velocity=torch.zeros(2))


def test_particles_outside_the_region_are_refused_at_the_start_and_reported_when_they_leave():
    with pytest.raises(ValueError, match=r"16 of 64 particles are outside .* enlarge"):
        small_rollout(
            soft_world(lower=(-0.1, -0.1, -0.1), upper=(0.5, 0.5, 0.26)), position=CUBE * torch.tensor((1, 1, 1.6))
        )
    with pytest.raises(ValueError, match=r"frame \d+: \d+ of 64 particles left the simulated region .*BoundingBox"):
        small_rollout(
            soft_world(lower=(-0.1, -0.1, -0.1), upper=(0.5, 0.5, 0.5)),
            velocity=torch.tensor((0.0, 3.0, 0.0)), frames=30,
        )  # fmt: skip


def test_falling_out_of_an_automatic_region_is_no_error():
    world = soft_world(gravity=(0.0, 0.0, -9.81))
    x = small_rollout(world, frames=11, frame_dt=0.1, velocity=torch.tensor((1.0, 0.0, 0.0))).position
    assert float(x[-1, :, 2].mean()) < -4.5


def test_sheet_of_one_particle_is_simulated():
    sheet = CUBE[CUBE[:, 2] < 0.03]
    trajectory = small_rollout(
        replace(soft_world(), precision="float32"),
        sheet,
        CUBE_VOLUME[: len(sheet)],
        velocity=torch.tensor((0.1, 0.0, 0.3)),
    )
    torch.testing.assert_close(
        trajectory.position[-1].double(), sheet + torch.tensor((0.004, 0.0, 0.012)), atol=1e-6, rtol=0
    )
