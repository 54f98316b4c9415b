"""Laws of the inside, on closed bodies whose volume is known."""

from functools import cache

import numpy as np
import pytest
from analytic_bodies import annulus, box, cup, discs, sphere, together, torus, wall
from fillings import SPACING, filled
from scipy.spatial import cKDTree

from physics3d.filling.solids import Poisson, WindingNumber
from physics3d.filling.surface import sample_surface

norm = np.linalg.norm
radius = lambda q: norm(q[:, :2], axis=1)
between = lambda q, a, b: (q[:, 2] > a) & (q[:, 2] < b)


def capped_sphere(rng):
    p, n = sphere(8000, 0.05, rng)
    return p[p[:, 2] > -0.04], n[p[:, 2] > -0.04]


def cylinder(r, height, rng):
    return together(wall(6000, r, 0, height, rng), annulus(600, 0, r, 0, rng, up=-1), annulus(600, 0, r, height, rng))


# body, volume [m^3], inside test
CLOSED = {
    "sphere": (lambda rng: sphere(8000, 0.05, rng), 4 / 3 * np.pi * 0.05**3, lambda q: norm(q, axis=1) < 0.05),
    "torus": (
        lambda rng: torus(8000, 0.06, 0.02, rng),
        2 * np.pi**2 * 0.06 * 0.02**2,
        lambda q: (radius(q) - 0.06) ** 2 + q[:, 2] ** 2 < 0.02**2,
    ),
    "box": (
        lambda rng: box(8000, (0.05, 0.04, 0.03), rng),
        8 * 0.05 * 0.04 * 0.03,
        lambda q: (np.abs(q) < [0.05, 0.04, 0.03]).all(1),
    ),
    "stem": (
        lambda rng: cylinder(0.011, 0.2, rng),
        np.pi * 0.011**2 * 0.2,
        lambda q: (radius(q) < 0.011) & between(q, 0, 0.2),
    ),
}
SOLIDS = [(Poisson(), SPACING), (WindingNumber(), 1.5 * SPACING)]  # direct summation is slow: coarser


def overlap(solid, gaussians, inside, rng, spacing=SPACING) -> float:
    """Intersection over union of the solid found and the true one, by 20 000 random points (4e-3 rms)."""
    surface, _ = sample_surface(gaussians, spacing)
    point = gaussians.mean.double().numpy()
    q = rng.uniform(point.min(0) - 0.005, point.max(0) + 0.005, (20_000, 3))
    found, true = solid.inside(surface, spacing)(q), inside(q)
    return (found & true).sum() / (found | true).sum()


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@cache
def ball():
    """The sphere of `CLOSED`, and what is filled of it."""
    rng = np.random.default_rng(0)
    gaussians = discs(*CLOSED["sphere"][0](rng), rng)
    return gaussians, filled(gaussians)


@pytest.mark.parametrize(("solid", "spacing"), SOLIDS, ids=["Poisson", "WindingNumber"])
@pytest.mark.parametrize("name", CLOSED)
def test_closed_bodies_are_filled_and_volumes_add_up(name, solid, spacing, rng):
    make, volume, inside = CLOSED[name]
    gaussians = discs(*make(rng), rng)
    spacing = SPACING if name == "stem" else spacing  # else it is two and a half cells thick
    body = filled(gaussians, solid=solid, spacing=spacing)
    assert overlap(solid, gaussians, inside, rng, spacing) > 0.95
    # samples are means over half a spacing, which cuts edges: the 22 mm stem and coarser cells feel it
    tolerance = 0.02 if spacing == SPACING and name != "stem" else 0.05
    assert float(body.volume.double().sum()) == pytest.approx(volume, rel=tolerance)
    assert inside(body.position.double().numpy()).mean() > 0.98


def test_noise_does_not_spoil_filling(rng):
    make, volume, inside = CLOSED["sphere"]
    gaussians = discs(*make(rng), rng, noise=0.001)
    assert overlap(Poisson(), gaussians, inside, rng) > 0.95
    assert float(filled(gaussians).volume.double().sum()) == pytest.approx(volume, rel=0.03)


@pytest.mark.parametrize(("solid", "spacing"), SOLIDS, ids=["Poisson", "WindingNumber"])
def test_a_missing_cap_is_closed(solid, spacing, rng):
    gaussians = discs(*capped_sphere(rng), rng)
    # the cap itself is 2.8 % of the sphere
    assert overlap(solid, gaussians, CLOSED["sphere"][2], rng, spacing) > 0.93


def test_a_cake_without_base_is_filled(rng):
    gaussians = discs(*together(wall(8000, 0.06, 0, 0.06, rng), annulus(4000, 0, 0.06, 0.06, rng)), rng)
    inside = lambda q: (radius(q) < 0.06) & between(q, 0, 0.06)
    assert overlap(Poisson(), gaussians, inside, rng) > 0.95
    assert float(filled(gaussians).volume.double().sum()) == pytest.approx(np.pi * 0.06**3, rel=0.03)


def test_a_cup_stays_open(rng):
    r, t, h = 0.05, 0.012, 0.1  # the wall is two particles thick
    gaussians = discs(*cup(r, t, h, rng), rng)
    body = filled(gaussians)
    q = body.position.double().numpy()
    cavity = (radius(q) < r - t - SPACING) & (q[:, 2] > t + SPACING)
    assert cavity.sum() == 0
    volume = np.pi * (r**2 * h - (r - t) ** 2 * (h - t))
    assert float(body.volume.double().sum()) == pytest.approx(volume, rel=0.03)


def test_particles_keep_their_distance():
    q = ball()[1].position.double().numpy()
    distance = cKDTree(q).query(q, k=2)[0][:, 1]
    # the lattice inside is exact; cells on the boundary have their centroid moved by up to three eighths of the spacing
    assert np.median(distance) == pytest.approx(SPACING, rel=0.01)
    assert distance.min() > 0.3 * SPACING


def test_without_interior_a_shell_remains():
    gaussians, whole = ball()
    shell = filled(gaussians, interior=False)
    assert not bool(shell.interior.any())
    assert len(shell.position) == int((~whole.interior).sum())
    assert float(shell.position.norm(dim=1).min()) > 0.05 - 2.5 * SPACING
