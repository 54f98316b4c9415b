"""The shapes that scenes are composed of: closed, and of the volume that geometry gives them."""

import math

import numpy as np
import pytest

from physics3d.scenes.made import MadeTwin
from physics3d.scenes.shapes import Ball, Sheet, Tube, Turned
from physics3d.scenes.studio import Mesh
from physics3d.world import World

GREY = {"colour": (0.5, 0.5, 0.5)}
CONE = ((0.0, 0.0), (0.05, 0.0), (0.02, 0.06), (0.0, 0.06))
STRAIGHT = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
RING = ((0.06, 0.01), (0.09, 0.01), (0.09, 0.03), (0.06, 0.03), (0.06, 0.01))


def superellipsoid(a: float, b: float, c: float, p: float) -> float:
    """Volume of |x/a|^p + |y/b|^p + |z/c|^p <= 1 (Dirichlet's integral)."""
    return 8 * a * b * c * math.gamma(1 + 1 / p) ** 3 / math.gamma(1 + 3 / p)


def turned(profile, fluted: float = 0.0) -> float:
    """Pappus: 2 pi times the first moment of the profile's polygon; r (1 + e cos n phi) has 1 + e^2/2 times r^2."""
    r, z = np.array([*profile, profile[0]]).T
    moment = ((z[1:] - z[:-1]) * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2)).sum() / 6
    return 2 * math.pi * abs(moment) * (1 + fluted**2 / 2)


COIL = math.hypot(2 * math.pi * 3 * 0.03, 0.12)  # length of a helix of 3 turns of 3 cm on 12 cm
# name -> (shape, volume [m^3]); curves are cut into chords, which takes up to a per cent
CASES = {
    "ellipsoid": (Ball(**GREY, centre=(0.1, 0.2, 0.3), half=(0.03, 0.05, 0.04)), superellipsoid(0.03, 0.05, 0.04, 2)),
    "cushion": (
        Ball(**GREY, centre=(0.0, 0.0, 0.1), half=(0.03, 0.05, 0.04), power=4.0, turn=(20.0, 30.0, 40.0)),
        superellipsoid(0.03, 0.05, 0.04, 4),
    ),
    "block": (
        Ball(**GREY, centre=(0.0, 0.0, 0.1), half=(0.04, 0.04, 0.03), power=20.0),
        superellipsoid(0.04, 0.04, 0.03, 20),
    ),
    "rod": (Tube(**GREY, path=((0.0, 0.0, 0.0), (0.0, 0.03, 0.04)), radii=(0.01,)), math.pi * 0.01**2 * 0.05),
    "taper": (
        Tube(**GREY, path=((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)), radii=(0.02, 0.01)),
        math.pi * 0.1 / 3 * (0.02**2 + 0.02 * 0.01 + 0.01**2),
    ),
    "coil": (
        Tube(**GREY, path=((0.0, 0.0, 0.0), (0.0, 0.0, 0.12)), radii=(0.008,), coil=0.03, turns=3.0),
        math.pi * 0.008**2 * COIL,
    ),
    "cone": (Turned(**GREY, profile=CONE, smooth=False, turn=(0.0, 40.0, 0.0), foot=(0.1, 0.0, 0.0)), turned(CONE)),
    "fluted": (Turned(**GREY, profile=CONE, smooth=False, flutes=8, flute_depth=0.1), turned(CONE, 0.1)),
    "curled ring": (Turned(**GREY, profile=RING, smooth=False, curls=2, curl_height=0.02), turned(RING)),
    "plate": (
        Sheet(**GREY, path=STRAIGHT, across=(0.0, 1.0, 0.0), half_widths=(0.03,), thickness=0.01),
        0.1 * 0.06 * 0.01,
    ),
    "kite": (
        Sheet(**GREY, path=STRAIGHT, across=(0.0, 1.0, 0.0), half_widths=(0.04, 0.0), thickness=0.002),
        0.1 * 0.04 * 0.002,
    ),
}


def enclosed(meshes: list[Mesh]) -> float:
    """Volume by the divergence theorem: a sixth of the sum of the corners' determinants."""
    total = 0.0
    for mesh in meshes:
        a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
        total += abs(np.einsum("ni,ni->n", a, np.cross(b, c)).sum()) / 6
    return total


def edges_without_a_partner(mesh: Mesh) -> int:
    """Sides of triangles, between places, that no other triangle passes in the opposite sense."""
    places, index = np.unique(mesh.vertices.round(7), axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    key = np.concatenate([faces[:, k] * len(places) + faces[:, (k + 1) % 3] for k in range(3)])
    back = np.concatenate([faces[:, (k + 1) % 3] * len(places) + faces[:, k] for k in range(3)])
    real = key != back  # ends are drawn together to a point, or to a line
    edge, count = np.unique(np.concatenate([key[real], back[real]]), return_counts=True)
    return int((count % 2 == 1).sum()) if len(edge) else 0


@pytest.mark.parametrize("name", CASES)
def test_a_shape_is_closed_and_has_the_volume_of_geometry(name):
    shape, volume = CASES[name]
    meshes = shape.meshes(0, moves=True)
    assert enclosed(meshes) == pytest.approx(volume, rel=0.015)
    assert all(edges_without_a_partner(mesh) == 0 for mesh in meshes)


@pytest.mark.parametrize("name", CASES)
def test_its_particles_stand_for_its_volume(name):
    shape, volume = CASES[name]
    world = World(material=None, density=1.0, start={}, dx=0.007)
    twin = MadeTwin(name=name, moving={"it": shape}, world=world, learn=(), evaluate=())
    position, stands_for = twin.matter()
    # some 200 to 2000 points, each in or out: 4 % are three standard deviations of the smallest
    assert stands_for.sum() == pytest.approx(volume, rel=0.05)
    vertices = np.concatenate([m.vertices for m in shape.meshes(0, moves=True)])
    assert (position >= vertices.min(0) - 1e-6).all() and (position <= vertices.max(0) + 1e-6).all()


def test_what_overlaps_counts_once():
    shape, volume = CASES["cushion"]
    world = World(material=None, density=1.0, start={}, dx=0.007)
    twice = MadeTwin(name="twice", moving={"a": shape, "b": shape}, world=world, learn=(), evaluate=())
    assert twice.matter()[1].sum() == pytest.approx(volume, rel=0.05)


def test_copies_stand_around_the_axis():
    one = Ball(
        **GREY, centre=(0.1, 0.0, 0.05), half=(0.01, 0.01, 0.01), copies=4, full=False, carried_at=(0.1, 0.0, 0.0)
    )
    meshes = one.meshes(0, moves=True)
    middles = np.array([m.vertices.mean(0) for m in meshes])
    np.testing.assert_allclose(middles[:, :2], [(0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)], atol=2e-4)  # vertices' mean
    np.testing.assert_allclose(
        [m.anchor for m in meshes], [(0.1, 0, 0), (0, 0.1, 0), (-0.1, 0, 0), (0, -0.1, 0)], atol=1e-7
    )


@pytest.mark.parametrize(
    "shape, words",
    [
        (Tube(**GREY, path=((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), radii=(0.1, 0.1, 0.1)), "tube.radii has 3 values"),
        (Tube(**GREY, path=((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), radii=(0.1,), coil=0.1), "give both, or neither"),
        (Turned(**GREY, profile=((0.1, 0.0), (0.2, 0.0), (0.0, 1.0))), "turned.profile begins at"),
        (Ball(colour=(0.5, 0.5, 1.5), centre=(0.0, 0.0, 0.0), half=(0.1, 0.1, 0.1)), "ball.colour.2 is 1.5"),
    ],
)  # fmt: skip
def test_a_shape_that_cannot_be_is_named(shape, words):
    with pytest.raises(ValueError, match=words):
        shape.check()
