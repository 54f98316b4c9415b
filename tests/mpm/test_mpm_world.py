"""Bad input ends in one line that names the field, its value and the remedy; never in NaN."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from mpm_bodies import block, soft_world, tensors

from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.newtonian import Newtonian
from physics3d.mpm.rollout import rollout
from physics3d.trajectory import Trajectory
from physics3d.world import Estimate

POSITION, VOLUME = block((2, 2, 2), 0.1)


def simulate(world=None, position=POSITION, volume=VOLUME, *, parameters=None, frames=3, frame_dt=0.02, **more):
    world = world or soft_world()
    parameters = parameters or tensors(world.start)
    return rollout(
        world, parameters, position, volume, frames=frames, frame_dt=frame_dt, threads=1, log=Log(None), **more
    )


@pytest.mark.parametrize(
    "changes, says",
    [
        (dict(density=0.0), "world.density is 0.0"),
        (dict(dx=-0.1), "world.dx is -0.1"),
        (dict(cfl=1.5), "world.cfl is 1.5"),
        (dict(damping=-1.0), "world.damping is -1.0"),
        (dict(dt=0.0), "world.dt is 0.0"),
        (dict(density=math.nan), "world.density is nan"),
        (dict(gravity=(0.0, math.nan, 0.0)), "world.gravity is"),
        (dict(precision="half"), "world.precision is half"),
        (dict(scheme="crank"), "world.scheme is crank"),
        (dict(max_substeps=0), "world.max_substeps is 0"),
        (dict(lower=(0.0, 0.0, 0.0)), "world.lower"),
        (dict(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 0.0)), "world.lower"),
        (dict(start=dict(youngs_modulus=-1.0, poissons_ratio=0.3)), "youngs_modulus is -1"),
        (dict(start=dict(youngs_modulus=1e4, poissons_ratio=0.5)), "poissons_ratio is 0.5"),
        (dict(start=dict(youngs_modulus=1e4)), "poissons_ratio"),
    ],
    ids=lambda value: str(value),
)
def test_senseless_world_is_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        soft_world(**changes).estimate()


def test_estimate_is_the_start_and_survives_a_file(tmp_path: Path):
    estimate = soft_world().estimate()
    estimate.save(tmp_path)
    again = Estimate.load(tmp_path)
    assert {name: float(value) for name, value in again.parameters.items()} == soft_world().start
    assert torch.equal(again.velocity, torch.zeros(3))


def test_trajectory_survives_a_file(tmp_path: Path):
    trajectory = simulate()
    trajectory.save(tmp_path)
    again = Trajectory.load(tmp_path)
    assert torch.equal(again.position, trajectory.position) and again.health == trajectory.health


@pytest.mark.parametrize(
    "name, value", [("youngs_modulus", -1.0), ("poissons_ratio", 0.5), ("youngs_modulus", math.nan)]
)
def test_senseless_parameters_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        simulate(parameters=tensors(soft_world().start | {name: value}))


def test_senseless_bodies_are_refused(unchecked):
    for position, volume, says in (
        (torch.where(torch.arange(64)[:, None] == 3, torch.nan, POSITION), VOLUME, "position holds 3 non-finite"),
        (POSITION, torch.zeros_like(VOLUME), "volume of 64 of 64 particles"),
        (POSITION, VOLUME[:5], "volume has shape"),
        (POSITION[:0], VOLUME[:0], "at least one particle"),
    ):
        with pytest.raises(ValueError, match=says):
            simulate(position=position, volume=volume)
    with pytest.raises(ValueError, match="frames is 0"):
        simulate(frames=0)
    with pytest.raises(ValueError, match="frame_dt is 0"):
        simulate(frame_dt=0.0)
    with pytest.raises(ValueError, match="velocity has shape"):
        simulate(velocity=torch.zeros(2))


def test_a_substep_above_the_limit_is_refused_and_the_limit_is_named():
    # c = sqrt(1.35 * 1e4/1000) = 3.67 m/s: a wave crosses 0.1 m in 0.027 s, a lone particle needs 0.0157 s
    with pytest.raises(
        ValueError, match=r"substep_dt is 0.02 s, waves cross a cell in 0.0272.* s .*take world.dt < 0.0157"
    ):
        simulate(soft_world(dt=0.02))
    assert simulate(soft_world(dt=0.0156)).substeps == 2


def test_automatic_substep_follows_the_speed_of_sound():
    counts = [
        simulate(soft_world(start=dict(youngs_modulus=E, poissons_ratio=0.3)), frames=2, frame_dt=0.1).substeps
        for E in (1e4, 1e6, 1e8)
    ]
    # ten times the speed, ten times the substeps, up to rounding up
    assert counts[1] == pytest.approx(10 * counts[0], rel=0.1) and counts[2] == pytest.approx(10 * counts[1], rel=0.02)


def test_particles_outside_the_region_are_refused_at_the_start_and_reported_when_they_leave():
    with pytest.raises(ValueError, match=r"16 of 64 particles are outside .* enlarge"):
        simulate(
            soft_world(lower=(-0.1, -0.1, -0.1), upper=(0.5, 0.5, 0.26)), position=POSITION * torch.tensor((1, 1, 1.6))
        )
    with pytest.raises(ValueError, match=r"frame \d+: \d+ of 64 particles left the simulated region .*BoundingBox"):
        simulate(
            soft_world(lower=(-0.1, -0.1, -0.1), upper=(0.5, 0.5, 0.5)),
            velocity=torch.tensor((0.0, 3.0, 0.0)), frames=30,
        )  # fmt: skip


def test_falling_out_of_an_automatic_region_is_no_error():
    world = soft_world(gravity=(0.0, 0.0, -9.81))
    x = simulate(world, frames=11, frame_dt=0.1, velocity=torch.tensor((1.0, 0.0, 0.0))).position
    assert float(x[-1, :, 2].mean()) < -4.5


@pytest.mark.parametrize("force", [1e4, 1e7])
def test_an_impulse_that_would_cross_the_grid_in_a_substep_ends_well_or_says_why(force):
    poke = Impulse(force=(force, 0.0, 0.0), centre=(0.1, 0.1, 0.1), radius=1.0, start=0.005, duration=0.01)
    try:
        trajectory = simulate(excitation=(poke,), frames=3)
    except ValueError as error:
        assert "frame" in str(error) and ("take" in str(error) or "enlarge" in str(error))
    else:
        # the whole body takes off rigidly with the momentum of the impulse, in ever more substeps
        assert trajectory.health["momentum_x"][-1] == pytest.approx(force * 0.01, rel=1e-6)
        assert torch.isfinite(trajectory.deformation).all()


def test_fixed_substep_that_becomes_too_long_is_reported_with_frame_and_remedy():
    poke = Impulse(force=(1e4, 0.0, 0.0), centre=(0.1, 0.1, 0.1), radius=1.0, start=0.03, duration=0.01)
    with pytest.raises(ValueError, match=r"frame \d: .*take world.dt <"):
        simulate(soft_world(dt=0.01), excitation=(poke,), frames=5)


def test_isolated_and_lone_particles_are_counted_and_stay_finite():
    position = torch.cat([POSITION, torch.tensor([[1.0, 0.0, 0.0], [5.0, 0.0, 0.0]], dtype=torch.float64)])
    volume = torch.cat([VOLUME, VOLUME[:2]])
    trajectory = simulate(position=position, volume=volume, velocity=0.3 * position.flip(1))
    assert trajectory.health["isolated"][0] == 2
    assert torch.isfinite(trajectory.deformation).all()
    alone = simulate(position=POSITION[:1], volume=VOLUME[:1], velocity=torch.ones(3))
    assert alone.health["isolated"] == [1, 1, 1]


def test_one_frame_is_the_initial_state():
    trajectory = simulate(frames=1)
    assert torch.equal(trajectory.position[0], POSITION) and trajectory.substeps == 0


def test_sheet_of_one_particle_is_simulated():
    sheet = POSITION[POSITION[:, 2] < 0.03]
    trajectory = simulate(
        replace(soft_world(), precision="float32"), sheet, VOLUME[: len(sheet)], velocity=torch.tensor((0.1, 0.0, 0.3))
    )
    torch.testing.assert_close(
        trajectory.position[-1].double(), sheet + torch.tensor((0.004, 0.0, 0.012)), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize(
    "changes, says",
    [
        (dict(start=dict(youngs_modulus=1e12, poissons_ratio=0.3)), "waves cross a cell .* take a softer material"),
        (dict(dt=1e-6), "take world.dt > 0.0002, or a larger max_substeps"),
    ],
    ids=["stiff", "dt"],
)
def test_more_substeps_than_a_frame_may_have_are_refused_before_they_start(changes, says):
    with pytest.raises(ValueError, match=rf"frame 1 would need \d+ substeps .* world.max_substeps = 100: .*{says}"):
        simulate(soft_world(max_substeps=100, scheme="explicit", **changes))


def test_viscosity_shortens_the_automatic_substep():
    """Waves alone ask for 0.95 a, with b = rho dx^2/(6 eta) both for 0.95 a [(1 + x^2)^(1/2) - x], x = a/(2 b)."""
    counts = {}
    for eta in (0.0, 1e3, 1e4, 1e5):
        start = dict(bulk_modulus=1e5, viscosity=eta, power_index=1.0)
        world = soft_world(material=Newtonian(), start=start, scheme="explicit")
        counts[eta] = simulate(world, frames=2, frame_dt=0.1).substeps
    a, b = 0.1 / math.sqrt(3 * 1e5 / 1000), {eta: 1000 * 0.01 / (6 * eta) for eta in (1e3, 1e4, 1e5)}
    assert counts[0.0] == math.ceil(0.1 / min(0.5 * 0.1 / 10, 0.95 * a))
    for eta, viscous in b.items():
        x = a / (2 * viscous)
        limit = 0.95 * a * (math.sqrt(1 + x * x) - x)
        assert counts[eta] == math.ceil(0.1 / min(0.5 * 0.1 / 10, limit))
    # ten times the viscosity, ten times the substeps
    assert counts[1e5] == pytest.approx(10 * counts[1e4], rel=0.02)


def test_rejected_substeps_are_counted_and_what_stays_too_fast_is_placed_in_time_and_space():
    poke = Impulse(force=(1e4, 0.0, 0.0), centre=(0.1, 0.1, 0.1), radius=1.0, start=0.005, duration=0.01)
    health = simulate(excitation=(poke,), frames=3).health
    assert sum(health["rejected"]) > 0
    with pytest.raises(ValueError, match=r"frame 1: particle \d+ at \(.*\) m moves .* cells in a step .* from 0 s on"):
        simulate(soft_world(scheme="implicit", dt=0.02), excitation=(replace(poke, force=(1e5, 0.0, 0.0)),), frames=3)
