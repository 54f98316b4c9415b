"""What each boundary promises, and that a boundary says so when its numbers make no sense."""

import dataclasses
import math

import pytest
import torch
from mpm_bodies import block, every_boundary, soft_world, tensors

from physics3d.log import Log
from physics3d.mpm.boundaries.bounding_box import BoundingBox
from physics3d.mpm.boundaries.enforced_rotation import EnforcedRotation
from physics3d.mpm.boundaries.enforced_translation import EnforcedTranslation
from physics3d.mpm.boundaries.fixed_region import FixedRegion
from physics3d.mpm.boundaries.half_space import HalfSpace
from physics3d.mpm.boundaries.impulse import Impulse
from physics3d.mpm.boundaries.moving_cuboid import MovingCuboid
from physics3d.mpm.boundaries.sequential_release import SequentialRelease
from physics3d.mpm.rollout import rollout

FALL = (0.0, 0.0, -9.81)


def simulate(world, *, frames, frame_dt, cells=(3, 3, 3), lower=(0.0, 0.0, 0.0), **more):
    position, volume = block(cells, world.dx, lower=lower)
    more |= dict(frames=frames, frame_dt=frame_dt, threads=1, log=Log(None))
    with torch.no_grad():
        return rollout(world, tensors(world.start), position, volume, **more)


@pytest.mark.parametrize("boundary", every_boundary(), ids=lambda b: f"{type(b).__name__}-{getattr(b, 'kind', '')}")
def test_numbers_that_are_not_finite_are_refused(boundary):
    tried = 0
    for field in dataclasses.fields(boundary):
        value = getattr(boundary, field.name)
        if isinstance(value, float) or (isinstance(value, tuple) and field.name != "kind"):
            bad = math.nan if isinstance(value, float) else (math.nan, *value[1:])
            with pytest.raises(ValueError, match=field.name):
                dataclasses.replace(boundary, **{field.name: bad}).check()
            tried += 1
    assert tried


@pytest.mark.parametrize(
    "boundary",
    [
        HalfSpace(point=(0, 0, 0), normal=(0, 0, 1), kind="sticking"),
        HalfSpace(point=(0, 0, 0), normal=(0, 0, 0)),
        HalfSpace(point=(0, 0, 0), normal=(0, 0, 1), friction=-0.1),
        BoundingBox(kind="glue"),
        BoundingBox(lower=(0, 0, 0)),
        FixedRegion(lower=(1, 0, 0), upper=(0, 1, 1)),
        Impulse(force=(1, 0, 0), centre=(0, 0, 0), radius=0.0, duration=1.0),
        Impulse(force=(1, 0, 0), centre=(0, 0, 0), radius=1.0, duration=0.0),
        SequentialRelease(lower=(0, 0, 0), upper=(1, 1, 1), direction=(0, 0, 1), layers=0, interval=1.0),
    ],
    ids=repr,
)
def test_senseless_numbers_are_refused_with_a_remedy(boundary):
    with pytest.raises(ValueError, match="take"):
        boundary.check()


def test_region_without_particles_is_refused():
    poke = Impulse(force=(1, 0, 0), centre=(9, 9, 9), radius=0.1, duration=1.0)
    with pytest.raises(ValueError, match="none of the 216 particles"):
        simulate(soft_world(), frames=2, frame_dt=0.01, excitation=(poke,))


@pytest.mark.parametrize("dt", [None, 0.0007, 0.003])
def test_impulse_gives_its_momentum_exactly_whatever_the_substep(dt):
    """Start and end of the window fall inside substeps; force 20 N for 0.013 s and the body's mass 27 kg."""
    poke = Impulse(force=(20.0, -5.0, 1.0), centre=(0.0, 0.1, 0.1), radius=0.15, start=0.0051, duration=0.013)
    health = simulate(soft_world(dt=dt), frames=3, frame_dt=0.02, excitation=(poke,)).health
    for axis, force in zip("xyz", poke.force):
        # the kick of a substep is applied at its start, hence all of it is there at the end of the frame
        assert health[f"momentum_{axis}"][-1] == pytest.approx(force * 0.013, rel=1e-9)


def test_sticky_ground_holds_and_slip_ground_lets_slide():
    velocity = torch.tensor((0.5, 0.0, 0.0), dtype=torch.float64)
    speeds = {}
    for kind, friction in (("sticky", 0.0), ("slip", 0.0), ("separate", 0.0), ("separate", 0.3)):
        ground = HalfSpace(point=(0, 0, 0), normal=(0, 0, 2.0), kind=kind, friction=friction)
        world = soft_world(gravity=FALL, boundaries=(ground,), start=dict(youngs_modulus=1e5, poissons_ratio=0.0))
        trajectory = simulate(world, frames=5, frame_dt=0.02, velocity=velocity)
        assert float(trajectory.position[..., 2].min()) > -0.01
        speeds[kind, friction] = trajectory.health["momentum_x"][-1] / 27.0
    assert speeds["slip", 0.0] == pytest.approx(0.5, abs=1e-9)
    assert speeds["separate", 0.0] == pytest.approx(0.5, abs=1e-9)
    assert speeds["sticky", 0.0] < 0.35
    # Coulomb: the block loses mu g t while it stays on the ground; it bounces a little as it settles
    assert speeds["separate", 0.3] == pytest.approx(0.5 - 0.3 * 9.81 * 0.08, abs=0.05)


def test_only_a_separating_ground_lets_go():
    velocity = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    heights = {}
    for kind in ("slip", "separate"):
        world = soft_world(boundaries=(HalfSpace(point=(0, 0, 0), normal=(0, 0, 1.0), kind=kind),))
        heights[kind] = simulate(world, frames=2, frame_dt=0.05, velocity=velocity).position[-1, :, 2].mean() - 0.15
    assert float(heights["separate"]) == pytest.approx(0.05, abs=1e-9)
    assert float(heights["slip"]) < 0.045


def test_inclined_ground_stops_a_block_by_friction_below_the_angle_and_not_above():
    """tan 20 degrees = 0.36: friction 0.6 holds, 0.1 lets it slide with g (sin - mu cos)."""
    tilt = math.radians(20)
    gravity = (9.81 * math.sin(tilt), 0.0, -9.81 * math.cos(tilt))
    speed = {}
    for mu in (0.1, 0.6):
        ground = HalfSpace(point=(0, 0, 0), normal=(0, 0, 1.0), kind="separate", friction=mu)
        world = soft_world(
            gravity=gravity, boundaries=(ground,), damping=1.0, start=dict(youngs_modulus=1e5, poissons_ratio=0.0)
        )
        speed[mu] = simulate(world, frames=6, frame_dt=0.04, cells=(4, 4, 2)).health["momentum_x"][-1] / 32.0
    slide = 9.81 * (math.sin(tilt) - 0.1 * math.cos(tilt)) * (1 - math.exp(-0.2))
    assert speed[0.1] == pytest.approx(slide, rel=0.1)
    assert abs(speed[0.6]) < 0.1 * slide


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_nothing_leaves_a_bounding_box(kind):
    world = soft_world(
        boundaries=(BoundingBox(kind=kind),), lower=(-0.2, -0.2, -0.2), upper=(0.6, 0.6, 0.6), gravity=FALL
    )
    velocity = torch.tensor((2.0, 1.0, -1.0), dtype=torch.float64)
    x = simulate(world, frames=10, frame_dt=0.05, velocity=velocity).position
    assert float(x.min()) > -0.2 and float(x.max()) < 0.6


def test_fixed_region_holds_the_material_inside():
    world = soft_world(gravity=FALL, boundaries=(FixedRegion(lower=(-1, -1, 0.1), upper=(1, 1, 1)),))
    trajectory = simulate(world, frames=4, frame_dt=0.05, cells=(2, 2, 6))
    moved = (trajectory.position[-1] - trajectory.position[0]).norm(dim=1)
    height = trajectory.position[0, :, 2]
    # more than the reach of the weights inside the region, nothing moves at all
    assert float(moved[height > 0.26].max()) == 0.0
    assert float(moved[height < 0.1].min()) > 1e-3


def test_moving_cuboid_carries_the_material_and_goes_away():
    push = MovingCuboid(lower=(-1, -1, -1), upper=(0.15, 1, 1), velocity=(0.4, 0, 0), start=0.02, duration=0.1)
    trajectory = simulate(soft_world(), frames=9, frame_dt=0.02, cells=(4, 2, 2), excitation=(push,))
    held = trajectory.position[0, :, 0] < 0.05
    moved = (trajectory.position - trajectory.position[0])[:, held, 0]
    for frame, way in ((1, 0.0), (3, 0.016), (6, 0.04)):
        # the window opens within round-off of a substep
        torch.testing.assert_close(moved[frame], torch.full_like(moved[frame], way), atol=0.4 * 0.005, rtol=0)
    # afterwards it is free, with the momentum it got
    assert trajectory.health["momentum_x"][-1] == pytest.approx(trajectory.health["momentum_x"][6], rel=0.1)


def test_enforced_translation_moves_its_particles_exactly_and_then_frees_them():
    pull = EnforcedTranslation(lower=(0, 0, 0), upper=(0.1, 1, 1), velocity=(-0.2, 0.1, 0), start=0.02, duration=0.06)
    trajectory = simulate(soft_world(), frames=8, frame_dt=0.02, excitation=(pull,))
    held = trajectory.position[0, :, 0] < 0.1
    moved = (trajectory.position - trajectory.position[0])[:, held]
    assert float(moved[1].abs().max()) < 1e-12
    expected = torch.tensor((-0.2, 0.1, 0.0), dtype=torch.float64) * 0.06
    # held rigidly: every particle of the box alike, to a substep at both ends of the window
    assert float((moved[4] - moved[4, 0]).abs().max()) < 1e-12
    torch.testing.assert_close(moved[4], expected.expand_as(moved[4]), atol=0.2 * 0.006, rtol=0)
    assert float((moved[7] - moved[7, 0]).abs().max()) > 1e-4


def test_enforced_rotation_keeps_the_radius_and_turns_the_deformation():
    twist = EnforcedRotation(
        point=(0.15, 0.15, 0.05), axis=(0, 0, 3.0), radius=0.5, half_height=0.051, angular_velocity=3.0, duration=1.0
    )
    trajectory = simulate(soft_world(), frames=6, frame_dt=0.05, excitation=(twist,))
    held = trajectory.position[0, :, 2] < 0.1
    angle = 3.0 * 0.25
    c, s = math.cos(angle), math.sin(angle)
    R = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    centre = torch.tensor(twist.point, dtype=torch.float64)
    expected = (trajectory.position[0, held] - centre) @ R.T + centre
    # the turn of every substep is exact: round-off
    torch.testing.assert_close(trajectory.position[-1, held], expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(trajectory.deformation[-1, held], R.expand(int(held.sum()), 3, 3), atol=1e-11, rtol=0)


def test_layers_are_released_one_after_the_other():
    layers = SequentialRelease(
        lower=(0, 0, 0), upper=(1, 1, 1), direction=(0, 0, 1), layers=3, start=0.05, interval=0.1
    )
    world = soft_world(gravity=FALL)
    trajectory = simulate(world, frames=5, frame_dt=0.1, excitation=(layers,), cells=(1, 1, 3))
    height = trajectory.position[0, :, 2]
    moved = (trajectory.position - trajectory.position[0]).norm(dim=2)
    bottom, middle, top = height < 0.1, (height > 0.1) & (height < 0.2), height > 0.2
    assert float(moved[1, bottom].min()) > 1e-3 and float(moved[1, middle | top].max()) == 0
    assert float(moved[2, middle].min()) > 1e-3 and float(moved[2, top].max()) == 0
    assert float(moved[4, top].min()) > 1e-2


def test_boundaries_act_together():
    """A block is pushed along the ground by a cuboid against a wall: each does its part."""
    world = soft_world(
        gravity=FALL,
        boundaries=(
            HalfSpace(point=(0, 0, 0), normal=(0, 0, 1), kind="slip"),
            HalfSpace(point=(0.4, 0, 0), normal=(-1, 0, 0), kind="slip"),
        ),
    )
    push = MovingCuboid(lower=(-1, -1, -1), upper=(0.0, 1, 1), velocity=(0.5, 0, 0), duration=0.3)
    x = simulate(world, frames=7, frame_dt=0.05, excitation=(push,)).position[-1]
    assert float(x[:, 2].min()) > 0.0 and 0.3 < float(x[:, 0].max()) < 0.4 and float(x[:, 0].min()) > 0.11
