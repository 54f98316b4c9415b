"""What each boundary promises, and that a boundary says so when its numbers make no sense."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from mpm_bodies import block, every_boundary, soft_world, tensors

from physics3d.boundaries import mesh_collider
from physics3d.boundaries.base import Setting, mirror_nodes
from physics3d.boundaries.bounding_box import BoundingBox
from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.enforced_translation import EnforcedTranslation
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.boundaries.mesh_collider import MeshCollider
from physics3d.boundaries.moving_cuboid import MovingCuboid
from physics3d.boundaries.sequential_release import SequentialRelease
from physics3d.log import Log
from physics3d.mpm.rollout import rollout
from physics3d.open3d_import import open3d

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
        Impulse(force=(1, 0, 0), centre=(0, 0, 0), duration=1.0),
        Impulse(force=(1, 0, 0), lower=(0, 0, 0), upper=(1, 1, 1), nearest=3, duration=1.0),
        Impulse(force=(1, 0, 0), lower=(0, 0, 0), duration=1.0),
        Impulse(force=(1, 0, 0), centre=(0, 0, 0), nearest=0, duration=1.0),
        Impulse(centre=(0, 0, 0), radius=1.0, duration=1.0),
        Impulse(force=(1, 0, 0), acceleration_of_each=(1, 0, 0), centre=(0, 0, 0), radius=1.0, duration=1.0),
        FixedRegion(lower=(0, 0, 0), upper=(1, 1, 1), duration=0.0),
        MeshCollider(),
        MeshCollider(path="nowhere.obj"),
        MeshCollider(path="mesh.gltf"),
        MeshCollider(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0)), triangles=((0, 1, 3),)),
        MeshCollider(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0)), triangles=((0, 1, 2),)),  # open
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


def test_impulse_acts_on_its_region_and_by_its_acceleration():
    """One layer of the block, chosen in three ways; an acceleration gives force times mass."""
    window = dict(start=0.0, duration=0.01)
    regions = (
        dict(lower=(0, 0, 0), upper=(0.05, 0.3, 0.3)),
        dict(centre=(-1e3, 0.15, 0.15), radius=1e3 + 0.05),
        dict(centre=(-1e3, 0.15, 0.15), nearest=36),
    )
    ends = []
    for region in regions:
        poke = Impulse(force=(9.0, 0.0, 0.0), **region, **window)
        ends.append(simulate(soft_world(), frames=2, frame_dt=0.02, excitation=(poke,)))
    mass = 36 * 1000.0 * 0.05**3
    poke = Impulse(acceleration_of_each=(9.0 / mass, 0.0, 0.0), **regions[0], **window)
    ends.append(simulate(soft_world(), frames=2, frame_dt=0.02, excitation=(poke,)))
    for end in ends:
        assert end.health["momentum_x"][-1] == pytest.approx(0.09, rel=1e-9)
        # the far ball is curved by 1e-5 of a cell: the same particles, hence the same motion to round-off
        torch.testing.assert_close(end.position[-1], ends[0].position[-1], atol=1e-12, rtol=0)


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


def dropped(plane: float, *, gap: float, speed: float, seconds: float, frames: int, onto=None, **changes):
    """A bar of 2 x 2 x 8 cells with a wave speed of 10 m/s that falls onto separating ground, or `onto` something,
    `plane` cells above a node; heights [frames] of its lower and upper face above that [cells], and the trajectory."""
    dx = 0.05
    ground = onto or HalfSpace(point=(0.0, 0.0, plane * dx), normal=(0.0, 0.0, 1.0), kind="separate")
    world = soft_world(boundaries=(ground,), dx=dx, start=dict(youngs_modulus=1e5, poissons_ratio=0.0), **changes)
    position, volume = block((2, 2, 8), dx, lower=(0.0, 0.0, (plane + gap) * dx))
    with torch.no_grad():
        trajectory = rollout(
            world, tensors(world.start), position, volume, velocity=torch.tensor((0.0, 0.0, -speed)).double(),
            frames=frames, frame_dt=seconds / (frames - 1), threads=1, log=Log(None),
        )  # fmt: skip
    z = trajectory.position[..., 2] / dx - plane
    return z.min(1).values - 0.25, z.max(1).values + 0.25, trajectory


@pytest.mark.parametrize("plane", [0.0, 0.3, 0.49, 0.6, 0.9])
def test_falling_bar_meets_separating_ground_at_its_plane_and_leaves_after_the_time_of_a_wave(plane):
    """Free until its lower face arrives, in contact for 2 H/c, wherever the plane lies between the nodes."""
    lower, _, trajectory = dropped(plane, gap=2.0, speed=0.5, seconds=0.5, frames=251)
    momentum = torch.tensor(trajectory.health["momentum_z"], dtype=torch.float64)
    force = momentum.diff()
    pressed = (force > 0.02 * force.max()).nonzero().flatten()
    first, last = int(pressed[0]), int(pressed[-1])
    # it travels 0.02 cells per frame; nodes that act by themselves stop it 0.1 to 1.1 cells early
    assert abs(float(lower[first])) < 0.05
    # half a cell of material before the nodes, strained by v/c = 0.05
    assert float(lower.min()) > -0.1
    # half a cell of too much or too little in 8, on the way up and down; nodes that act by themselves take 2 H/c longer
    assert 0.002 * (last - first) == pytest.approx(2 * 0.4 / 10, rel=0.2)
    assert float(momentum[-1]) > 0.8 * 0.5 * 1000 * 0.1 * 0.1 * 0.4


@pytest.mark.parametrize("plane", [0.0, 0.3, 0.49, 0.6, 0.9])
@pytest.mark.parametrize("rises", [False, True])
def test_a_plate_meets_the_material_at_its_face_wherever_the_grid_lies(plane, rises):
    """A bar falls onto a plate at rest, or a plate rises against a bar at rest: seen from either, the same."""
    face, speed = plane * 0.05, 0.5
    plate = MovingCuboid(
        lower=(-1, -1, face - 0.5), upper=(1, 1, face), velocity=(0, 0, speed if rises else 0), duration=1.0
    )
    lower, _, trajectory = dropped(
        plane, gap=2.0, speed=0.0 if rises else speed, seconds=0.3, frames=151, onto=plate, lower=(-0.5,) * 3,
        upper=(0.9,) * 3,
    )  # fmt: skip
    force = torch.tensor(trajectory.health["momentum_z"], dtype=torch.float64).diff()
    first = int((force > 0.02 * force.max()).nonzero()[0])
    gone = speed * 0.002 * torch.arange(len(lower)) / 0.05 if rises else torch.zeros(len(lower))  # of the plate [cells]
    # they come nearer by 0.02 cells per frame; a face that jumps from node to node meets 0.1 to 1.1 cells early
    assert abs(float((lower - gone)[first])) < 0.05


# both schemes have the same boundaries and nodes: one plane between nodes tells whether the implicit one obeys them
@pytest.mark.parametrize(
    ("plane", "scheme"), [(0.0, "explicit"), (0.45, "explicit"), (0.9, "explicit"), (0.45, "implicit")]
)
def test_column_comes_to_rest_with_its_lower_face_on_separating_ground(plane, scheme):
    lower, upper, trajectory = dropped(
        plane, gap=0.3, speed=0.0, seconds=1.0, frames=11, gravity=FALL, damping=20.0, scheme=scheme
    )
    sag = 1000 * 9.81 * 0.4**2 / (2 * 1e5) / 0.05
    assert trajectory.health["speed_max"][-1] < 1e-3
    # a few per cent of strain over half a cell; nodes that act by themselves leave it 0.3 cells deep to 0.2 above
    assert abs(float(lower[-1])) < 0.1
    assert float(upper[-1]) == pytest.approx(8 - sag, abs=0.1)


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
    assert float(moved[height > 0.1].max()) == 0.0
    assert float(moved[height < 0.1].min()) > 5e-4


def test_fixed_region_lets_go_at_its_end():
    hold = FixedRegion(lower=(-1, -1, -1), upper=(1, 1, 1), duration=0.05)
    trajectory = simulate(soft_world(gravity=FALL), frames=3, frame_dt=0.05, excitation=(hold,))
    moved = (trajectory.position - trajectory.position[0])[..., 2]
    assert float(moved[1].abs().max()) == 0.0
    # it falls from half a substep before the end on, for that is where its velocities are
    dt = 0.05 / trajectory.health["substeps"][2]
    torch.testing.assert_close(moved[2], torch.full_like(moved[2], -9.81 * 0.05 * (0.05 + dt) / 2), atol=1e-9, rtol=0)


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


# ---------------------------------------------------------------------------------------------------- mirrors


def setting(lower=(-1.0, -1.0, -1.0), cells=(3, 3, 3)) -> Setting:
    position, volume = block(cells, 0.1)
    return Setting(position=position, mass=1000 * volume, volume=volume, lower=lower, upper=(1.0, 1.0, 1.0), dx=0.1)


def test_walls_mirror_only_on_nodes_without_friction_or_material_behind():
    floor = HalfSpace(point=(0, 0, 0), normal=(0, 0, 2), kind="slip")
    far = 2**28
    assert mirror_nodes([floor], setting()) == [-far, -far, 10, far, far, far] + [0] * 6
    roof = HalfSpace(point=(0, 0, 0.3), normal=(0, 0, -1))
    assert mirror_nodes([floor, roof], setting()) == [-far, -far, 10, far, far, 13] + [0] * 5 + [1]
    box = BoundingBox(lower=(0, -0.5, -0.5), upper=(0.5, 0.5, 0.5), kind="sticky")
    # the innermost of two walls; the sticky one of two at the same place
    assert mirror_nodes([box, floor], setting()) == [10, 5, 10, 15, 15, 15, 1, 1, 0, 1, 1, 1]
    for change in (
        dict(friction=0.1),
        dict(kind="separate"),
        dict(normal=(0, 1e-3, 1)),
        dict(point=(0, 0, -0.01)),  # between nodes
        dict(point=(0, 0, 0.1)),  # runs through the body: that part is held, not mirrored
    ):
        assert mirror_nodes([dataclasses.replace(floor, **change)], setting()) is None


@pytest.mark.parametrize("threads", [1, 2])
def test_slip_walls_are_planes_of_symmetry(threads):
    """An eighth of a block in a corner of three walls moves as it does in the whole block, which has none."""
    dx = 0.1
    whole, volume = block((4, 4, 4), dx, lower=(-0.2, -0.2, -0.2))
    stretch = torch.tensor((3.0, -2.0, 1.0), dtype=torch.float64)
    velocity = stretch * whole  # linear, so that its gradient is the same whatever particles it is taken from
    region = dict(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0), dt=0.002)
    more = dict(frames=4, frame_dt=0.04, threads=threads, log=Log(None))
    start = tensors(soft_world().start)
    corner = BoundingBox(lower=(0, 0, 0), upper=(0.9, 0.9, 0.9))
    part = (whole > 0).all(1)
    with torch.no_grad():
        free = rollout(soft_world(**region), start, whole, volume, velocity=velocity, **more)
        walled = rollout(
            soft_world(**region, boundaries=(corner,)), start, whole[part], volume[part],
            velocity=velocity[part], **more,
        )  # fmt: skip
    assert float((free.deformation[-1] - torch.eye(3)).abs().max()) > 0.05
    # the fit of the initial velocity gradient is good to 1e-10 1/s; the sums on the grid are the same to round-off
    torch.testing.assert_close(walled.position, free.position[:, part], atol=1e-10, rtol=0)
    torch.testing.assert_close(walled.deformation, free.deformation[:, part], atol=1e-9, rtol=0)


def test_gradients_through_mirrors_are_those_of_one_thread_and_equal_bit_by_bit_on_reruns():
    """Nodes read each other's values at a mirror, so that threads could add to one adjoint at a time."""
    position, volume = block((3, 3, 2), 0.1)
    corner = BoundingBox(kind="sticky", lower=(0, 0, 0), upper=(0.5, 0.5, 0.2))
    world = soft_world(boundaries=(corner,), lower=(-1, -1, -1), upper=(1, 1, 1), dt=0.002)
    weight = torch.randn(position.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def gradient(threads: int) -> torch.Tensor:
        v = (0.5 * position.flip(1) + 0.1 * weight).requires_grad_()
        trajectory = rollout(
            world, tensors(world.start), position, volume,
            velocity=v, frames=3, frame_dt=0.02, threads=threads, log=Log(None),
        )  # fmt: skip
        return torch.autograd.grad((weight * trajectory.position[-1]).sum(), v)[0]

    one, two, again = gradient(1), gradient(2), gradient(2)
    assert torch.equal(two, again)
    # round-off of twenty substeps
    torch.testing.assert_close(one, two, atol=1e-12, rtol=1e-12)
    assert float(one.norm()) > 1e-2


# ------------------------------------------------------------------------------------------------ mesh collider


def cube(size: float = 1.0, lower=(0.0, 0.0, 0.0)) -> dict:
    mesh = open3d().geometry.TriangleMesh.create_box(size, size, size).translate(lower)
    return dict(vertices=torch.tensor(np.asarray(mesh.vertices)), triangles=torch.tensor(np.asarray(mesh.triangles)))


@pytest.mark.parametrize(("kind", "friction"), [("sticky", 0.0), ("slip", 0.0), ("separate", 0.3)])
def test_big_cube_is_a_half_space(kind, friction):
    """A block slides down onto a plane between nodes: both colliders see the same nodes behind the same plane."""
    floor = HalfSpace(point=(0, 0, 0.04), normal=(0, 0, 1), kind=kind, friction=friction)
    mesh = MeshCollider(**cube(4.0), position=(-2.0, -2.0, -3.96), kind=kind, friction=friction)
    ends = []
    for boundary in (floor, mesh):
        world = soft_world(gravity=FALL, boundaries=(boundary,), lower=(-0.5, -0.5, -0.3), upper=(0.9, 0.9, 0.9))
        velocity = torch.tensor((0.5, 0.0, 0.0), dtype=torch.float64)
        ends.append(simulate(world, frames=4, frame_dt=0.03, velocity=velocity, lower=(0, 0, 0.1)).position[-1])
    # the distance to a plane is sampled in single precision and interpolated exactly
    torch.testing.assert_close(ends[0], ends[1], atol=1e-6, rtol=0)


def test_ball_stays_outside_a_ball():
    """A ball of jelly falls on one that stands: particles half a cell thick touch it, no more."""
    mesh = open3d().geometry.TriangleMesh.create_sphere(0.3, resolution=20)
    ball = MeshCollider(
        vertices=torch.tensor(np.asarray(mesh.vertices)), triangles=torch.tensor(np.asarray(mesh.triangles)),
        position=(0.0, 0.02, 0.0), kind="separate",
    )  # fmt: skip
    dx = 0.05
    position, volume = block((6, 6, 6), dx, lower=(-0.15, -0.15, 0.3))
    inside = (position - position.mean(0)).norm(dim=1) < 0.15
    world = soft_world(gravity=FALL, boundaries=(ball,), dx=dx, start=dict(youngs_modulus=1e5, poissons_ratio=0.3))
    with torch.no_grad():
        trajectory = rollout(
            world, tensors(world.start), position[inside], volume[inside],
            frames=9, frame_dt=0.03, threads=1, log=Log(None),
        )  # fmt: skip
    depth = 0.3 - (trajectory.position - torch.tensor(ball.position, dtype=torch.float64)).norm(dim=2).min(1).values
    # the layer of particles that touches is pressed to a little less
    assert -0.25 * dx < float(depth.max()) < -0.1 * dx
    # it was turned back
    assert max(trajectory.health["momentum_z"]) > 0.0


def test_material_in_a_moving_mesh_moves_rigidly_with_it_in_its_window():
    """Exact turns in every substep: round-off of the displacements, whatever the substep."""
    w = torch.tensor((0.5, 0.0, 2.0), dtype=torch.float64)
    mesh = MeshCollider(
        **cube(1.2, (-0.6, -0.6, -0.6)), position=(0.15, 0.15, 0.15), velocity=(0.3, -0.2, 0.1),
        angular_velocity=tuple(w.tolist()), start=0.02, duration=0.1,
    )  # fmt: skip
    start = simulate(soft_world(), frames=1, frame_dt=0.02, cells=(2, 2, 2), lower=(0.1, 0.1, 0.1)).position[0]
    x = simulate(
        soft_world(), frames=8, frame_dt=0.02, cells=(2, 2, 2), lower=(0.1, 0.1, 0.1), excitation=(mesh,)
    ).position
    centre = torch.tensor(mesh.position, dtype=torch.float64)
    for frame in range(8):
        s = min(max(0.02 * frame - 0.02, 0.0), 0.1)
        turn = torch.linalg.matrix_exp(s * torch.linalg.cross(w.expand(3, 3), torch.eye(3, dtype=torch.float64)).T)
        expected = (start - centre) @ turn.T + centre + s * torch.tensor(mesh.velocity, dtype=torch.float64)
        torch.testing.assert_close(x[frame], expected, atol=1e-12, rtol=0)


def test_mesh_scene_turned_by_a_right_angle_gives_the_turned_motion():
    """Mesh, gravity and body turn about x by 90 degrees: (x, y, z) -> (x, -z, y)."""
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    wedge = dict(
        vertices=((-0.5, -0.5, -0.5), (1.0, -0.5, -0.5), (-0.5, 1.0, -0.5), (-0.5, -0.5, 0.7)),
        triangles=((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
    )
    position, volume = block((2, 2, 2), 0.1, lower=(-0.1, -0.1, 0.1))
    ends = []
    for Q, rotation in ((torch.eye(3, dtype=torch.float64), (0, 0, 0)), (turn, (math.pi / 2, 0, 0))):
        mesh = MeshCollider(
            **wedge, rotation=rotation, velocity=tuple((Q @ torch.tensor((0.1, 0.0, 0.3)).double()).tolist()),
            angular_velocity=tuple((Q @ torch.tensor((0.0, 0.5, 1.0)).double()).tolist()),
            kind="separate", friction=0.2,
        )  # fmt: skip
        gravity = tuple((Q @ torch.tensor(FALL, dtype=torch.float64)).tolist())
        world = soft_world(gravity=gravity, boundaries=(mesh,), lower=(-1, -1, -1), upper=(1, 1, 1), dt=0.002)
        with torch.no_grad():
            x = rollout(
                world, tensors(world.start), position @ Q.T, volume, frames=3, frame_dt=0.05, threads=1, log=Log(None)
            ).position
        ends.append((x - x[0])[-1] @ Q)
    assert float((ends[0][:, 0]).abs().max()) > 1e-3
    # distances are sampled in single precision
    torch.testing.assert_close(ends[0], ends[1], atol=1e-6, rtol=0)


def test_mesh_comes_from_a_file_of_any_format(tmp_path):
    mesh = open3d().geometry.TriangleMesh.create_sphere(200.0, resolution=8)
    mesh.compute_triangle_normals()
    given = MeshCollider(
        vertices=torch.tensor(np.asarray(mesh.vertices)), triangles=torch.tensor(np.asarray(mesh.triangles)), scale=1e-3
    )
    expected = given.parameters(setting())
    for suffix in mesh_collider.SUFFIXES:
        path = str(tmp_path / f"ball{suffix}")
        open3d().io.write_triangle_mesh(path, mesh)
        read = MeshCollider(path=path, scale=1e-3)
        read.check()
        # text files hold six digits
        torch.testing.assert_close(read.parameters(setting()), expected, atol=1e-4, rtol=1e-4)
    (tmp_path / "empty.ply").write_text("ply")
    with pytest.raises(ValueError, match="no mesh"):
        MeshCollider(path=str(tmp_path / "empty.ply")).parameters(setting())


def test_mesh_that_cannot_be_used_is_refused_with_the_remedy():
    for change, words in (
        (dict(scale=1e3, velocity=(1.0, 0.0, 0.0)), "samples of its distance.*larger world.dx"),
        (dict(position=(9.0, 0.0, 0.0)), "outside the region.*move it"),
    ):
        with pytest.raises(ValueError, match=words):
            MeshCollider(**cube(), **change).parameters(setting())
    hole = cube()
    with pytest.raises(ValueError, match=r"3 of 18 edges.*without holes"):
        MeshCollider(vertices=hole["vertices"], triangles=hole["triangles"][1:]).check()


MEETS_A_MESH = """
import torch
from physics3d.boundaries.mesh_collider import MeshCollider
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout
from physics3d.world import World

vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
mesh = MeshCollider(vertices=vertices, triangles=[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
start = dict(youngs_modulus=1e3, poissons_ratio=0.3)
world = World(material=NeoHookean(), density=1e3, start=start, dx=0.1, boundaries=(mesh,))
parameters = {name: torch.tensor(value) for name, value in start.items()}
position, volume = torch.tensor([[0.5, 0.5, 1.5]]), torch.tensor([1e-4])
rollout(world, parameters, position, volume, frames=2, frame_dt=1e-3, log=Log(None))
"""


def test_a_process_that_met_a_mesh_ends_well():
    """Open3D lets a process fail that ends while its own memory is in use, such as samples of a distance that the
    kernels' module keeps."""
    ended = subprocess.run([sys.executable, "-c", MEETS_A_MESH], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
