"""Laws of what is known before a second is simulated: what is behind, what misses, what is too coarse, what is held."""

import re
from dataclasses import replace

import pytest
import torch

from physics3d.boundaries.bounding_box import BoundingBox
from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.enforced_translation import EnforcedTranslation
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.boundaries.mesh_collider import MeshCollider
from physics3d.boundaries.moving_cuboid import MovingCuboid
from physics3d.boundaries.sequential_release import SequentialRelease
from physics3d.filling.body import Body
from physics3d.filling.in_world import look_ahead
from physics3d.gaussians.embedding import embed
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.world import World

SPACING = 0.01


def ball(radius: float = 0.05, spacing: float = SPACING) -> Body:
    """Around the origin; no particle's middle lies on a plane of symmetry."""
    axis = (torch.arange(-int(radius / spacing), int(radius / spacing)) + 0.5) * spacing
    x = torch.cartesian_prod(axis, axis, axis)
    x = x[x.norm(dim=1) < radius]
    return Body(
        position=x,
        volume=torch.full((len(x),), spacing**3),
        part=torch.zeros(len(x), dtype=torch.int32),
        interior=torch.zeros(len(x), dtype=torch.bool),
        spacing=spacing,
        embedding=embed(x[:1], torch.arange(1), x, spacing),
    )


def world(*boundaries, dx: float = 2 * SPACING) -> World:
    return World(
        material=NeoHookean(),
        density=1000.0,
        start={"youngs_modulus": 1e4, "poissons_ratio": 0.3},
        dx=dx,
        boundaries=boundaries,
    )


def said(body: Body, world: World, folder, excitation=()) -> str:
    look_ahead(body, world, excitation, Log(folder, quiet=True))
    return (folder / "log.txt").read_text()


def cube(half: float) -> dict:
    """A closed mesh around its origin."""
    corner = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = tuple(t for a, b, c, d in quads for t in ((a, b, c), (a, c, d)))
    return dict(vertices=tuple(corner), triangles=triangles)


FAR = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
# each has z = 0.013 m for the only surface that the ball meets, with what is forbidden below it
BELOW = {
    "half space": HalfSpace(point=(0.3, 0.0, 0.013), normal=(0.0, 0.0, 2.0), kind="separate"),
    "sticky half space": HalfSpace(point=(0.0, 0.0, 0.013), normal=(0.0, 0.0, 1.0)),
    "bounding box": BoundingBox(lower=(-1.0, -1.0, 0.013), upper=(1.0, 1.0, 1.0)),
    "cuboid": MovingCuboid(lower=FAR[0], upper=(1.0, 1.0, 0.013), velocity=(0.0, 0.0, 0.1), duration=1.0),
    "cuboid under way": MovingCuboid(
        lower=FAR[0], upper=(1.0, 1.0, -0.087), velocity=(0.0, 0.0, 0.1), start=-1.0, duration=5.0
    ),
    "mesh": MeshCollider(**cube(1.0), position=(0.0, 0.0, -0.987)),
    "mesh, turned": MeshCollider(**cube(10.0), scale=0.1, rotation=(0.0, 0.0, 0.7), position=(0.0, 0.0, -0.987)),
    "mesh under way": MeshCollider(
        **cube(1.0), position=(0.0, 0.0, -1.187), velocity=(0.0, 0.0, 0.1), start=-2.0, duration=5.0
    ),
}


@pytest.mark.parametrize("name", BELOW)
def test_what_starts_behind_a_boundary_is_counted_with_its_depth(name, tmp_path):
    body = ball()
    depth = 0.013 - body.position[:, 2]
    text = said(body, world(BELOW[name]), tmp_path)
    # the count by the particles' own coordinates; 0.01 mm for meshes, whose distance is in float32
    assert f"{int((depth > 0).sum())} of {len(depth)} particles start behind {type(BELOW[name]).__name__}" in text
    assert f"up to {float(depth.max()):.3g} m deep" in text and "move it" in text


@pytest.mark.parametrize("name", BELOW)
def test_what_is_in_front_of_a_boundary_is_not_mentioned(name, tmp_path):
    body = ball()
    body = replace(body, position=body.position + torch.tensor([0.0, 0.0, 0.058]))  # the lowest 1 mm in front
    assert "behind" not in said(body, world(BELOW[name]), tmp_path)


@pytest.mark.parametrize("name", BELOW)
def test_a_body_wholly_behind_is_refused(name):
    body = ball()
    body = replace(body, position=body.position - torch.tensor([0.0, 0.0, 0.1]))
    with pytest.raises(ValueError, match="the whole body; move it, or the body"):
        look_ahead(body, world(BELOW[name]), (), Log(None))


def test_what_comes_later_is_no_obstacle_yet(tmp_path):
    later = replace(BELOW["cuboid"], start=0.5)
    assert "behind" not in said(ball(), world(later), tmp_path)


MISSES = {
    "impulse": Impulse(force=(1.0, 0.0, 0.0), centre=(0.0, 0.0, 0.5), radius=0.1, duration=0.1),
    "impulse in a box": Impulse(force=(1.0, 0.0, 0.0), lower=(1.0, 1.0, 1.0), upper=(2.0, 2.0, 2.0), duration=0.1),
    "translation": EnforcedTranslation(
        lower=(1.0, 1.0, 1.0), upper=(2.0, 2.0, 2.0), velocity=(0.1, 0.0, 0.0), duration=1.0
    ),
    "rotation": EnforcedRotation(
        point=(1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), radius=0.1, half_height=0.1, angular_velocity=1.0, duration=1.0
    ),
    "release": SequentialRelease(
        lower=(1.0, 1.0, 1.0), upper=(2.0, 2.0, 2.0), direction=(0.0, 0.0, 1.0), layers=2, interval=0.1
    ),
}


@pytest.mark.parametrize("name", MISSES)
def test_what_misses_the_body_is_refused_and_says_where_the_body_is(name):
    remedy = r"holds none of the \d+ particles at rest; .* the body lies in \(-0.045, -0.045, -0.045\) \.\. \(0.045"
    for boundaries, excitation in (((), (MISSES[name],)), ((MISSES[name],), ())):
        with pytest.raises(ValueError, match=remedy):
            look_ahead(ball(), world(*boundaries), excitation, Log(None))


@pytest.mark.parametrize("dx", [0.2, 5.0, 1e4])
def test_a_body_smaller_than_a_cell_is_refused(dx):
    # 0.1 m: the ball's own size, a fifteenth of which bends as it should
    remedy = re.escape(f"world.dx is {dx:g} m") + r".* smaller than a cell; take world.dx <= 0.0067 m"
    with pytest.raises(ValueError, match=remedy):
        look_ahead(ball(), world(dx=dx), (), Log(None))


def test_particles_farther_apart_than_cells_are_refused():
    with pytest.raises(ValueError, match=r"each is alone in its cell; take world.dx = 0.02 m, or fill.spacing = 0.002"):
        look_ahead(ball(), world(dx=0.004), (), Log(None))


def test_what_holds_the_body_is_counted(tmp_path):
    body = ball()
    low = body.position[:, 2] < -0.03
    attached = (body.position[:, 2] > 0.03) & (body.position[:, 0] > 0)
    region = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, -0.03))
    text = said(replace(body, attached=attached), world(region), tmp_path / "both")
    assert f"held: {int(attached.sum())} particles where it touches what is static, {int(low.sum())} particles" in text
    assert "by FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, -0.03))" in text
    assert "nothing holds the body still" in said(body, world(), tmp_path / "none")


def test_an_unresolved_section_is_warned_about(tmp_path):
    x = torch.cartesian_prod(torch.arange(2.0), torch.arange(2.0), torch.arange(20.0)) * SPACING
    bar = replace(
        ball(),
        position=x,
        volume=torch.full((80,), SPACING**3),
        part=torch.zeros(80, dtype=torch.int32),
        interior=torch.zeros(80, dtype=torch.bool),
    )
    clamp = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 0.025))
    # 2 particles of 10 mm are 20 mm: one cell of 20 mm, two of 10 mm
    coarse, fine = (said(bar, world(clamp, dx=dx), tmp_path / f"{dx}") for dx in (0.02, 0.01))
    assert "warning: thinnest held section" in coarse and "20 mm, 2.0 particles across" in coarse
    assert "take scene.dx <= 0.01 m" in coarse and "1.0 cells, whose error is 14 % in frequency, 28 % in E" in coarse
    assert "warning" not in fine
