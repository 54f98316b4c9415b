"""Laws of what cameras see of a body: it is as large as its pictures, wherever a fit has put its Gaussians."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from analytic_bodies import box, discs, joined, petal, sphere
from seen_bodies import RADIUS, SPACING, Round, around, ball, filled, radius_in_pictures

from physics3d.filling.seen import seen
from physics3d.gaussians.cameras import look_at
from physics3d.log import Log


@pytest.fixture
def rng():
    return np.random.default_rng(0)


PLAIN, DEEP = (0.0, 0.0003), (0.003, 0.0005)  # depth and thickness of the discs of a ball [m]


@cache
def seen_around(depth: float, flat: float):
    """A ball, the cameras around it, and its radius in their pictures [m]."""
    gaussians, cameras = ball(np.random.default_rng(0), depth, flat), around()
    return gaussians, cameras, radius_in_pictures(gaussians, cameras)


@cache
def volume_of(depth: float, flat: float) -> float:
    """Of what is filled of it [m^3]."""
    gaussians, cameras, _ = seen_around(depth, flat)
    return float(filled(gaussians, cameras).volume.double().sum())


@pytest.mark.parametrize(("depth", "flat"), [PLAIN, DEEP])
def test_a_body_is_as_large_as_its_pictures_wherever_its_gaussians_lie(depth, flat):
    truth, volume = seen_around(depth, flat)[2], volume_of(depth, flat)
    # three quarters of a pixel; by the centres and their thickness it is 1.3 and 1.8 mm
    assert (volume * 3 / (4 * np.pi)) ** (1 / 3) == pytest.approx(truth, abs=1.2e-3)


def test_fewer_particles_fill_the_same_body():
    """... of the same stiffness in bending: the second moment of what a cell holds is known."""
    gaussians, cameras, truth = seen_around(*PLAIN)
    for spacing in (SPACING, 2 * SPACING):
        body = filled(gaussians, cameras, spacing=spacing)
        assert len(body.position) < 1.3 * 4 / 3 * np.pi * (truth / spacing) ** 3  # shells of cells that are cut
        x, volume, moment = (a.numpy() for a in (body.matter.position, body.matter.volume, body.matter.moment))
        square = (volume[:, None] * (x**2 + moment[:, [0, 1, 2], [0, 1, 2]])).sum(0)
        radius = np.sqrt(5 * square / volume.sum())  # of a ball: int x^2 dV = V R^2 / 5
        np.testing.assert_allclose(radius, truth, atol=1.2e-3)  # three quarters of a pixel, as above
    assert volume.sum() == pytest.approx(volume_of(*PLAIN), rel=0.03)


def test_what_is_filled_is_what_lies_inside_the_surface_seen(rng):
    """... and not within a spacing inside it, where the centres lie."""
    point, normal = sphere(6000, RADIUS, rng)
    gaussians, cameras = discs(point - SPACING * normal, normal, rng, sigma=0.003, thickness=0.0005), around()
    gaussians = replace(gaussians, opacity_logit=torch.full((len(point),), -1.5))
    box = dict(lower=np.full(3, -0.07), upper=np.full(3, 0.07))
    view = seen(gaussians, torch.ones(len(gaussians)).int(), cameras, **box, spacing=SPACING, log=Log(None))
    inside = float((view.distance < 0).sum()) * view.h**3
    # the lattice counts whole cells of 2 mm of a ball of 5 cm
    assert float(filled(gaussians, cameras).volume.double().sum()) == pytest.approx(inside, rel=0.04)


def test_one_camera_says_what_it_sees(rng):
    """What lies beside its picture of the body is beside; what is behind the body it does not know."""
    gaussians, camera = ball(rng, 0.0, 0.0003), around(1)
    box = dict(lower=np.full(3, -0.07), upper=np.full(3, 0.07))
    view = seen(gaussians, torch.ones(len(gaussians)).int(), camera, **box, spacing=SPACING, log=Log(None))
    towards = (camera[0].centre / camera[0].centre.norm()).numpy()
    across = np.cross(towards, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(towards, [0.0, 0.0, 1.0]))
    assert view.beside(0.062 * across[None]).all()
    assert view.deep(-0.03 * towards[None]).all() and not view.beside(-0.06 * towards[None]).any()


def test_cameras_that_do_not_see_the_body_are_an_error(rng):
    gaussians = ball(rng, 0.0, 0.0003)
    away = [replace(c, world_to_camera=look_at(2 * c.centre, 4 * c.centre)) for c in around(8)]
    with pytest.raises(ValueError, match=r"cameras see the surface of the body near .* % of its Gaussians only"):
        filled(gaussians, away)


def test_what_hides_a_body_takes_nothing_from_it(rng):
    """A static plate before half of the cameras: they say nothing of what is behind it."""
    gaussians, cameras, _ = seen_around(*DEEP)
    side = np.stack([np.full(4000, 0.09), *rng.uniform(-0.15, 0.15, (2, 4000))], 1)
    plate = discs(side, np.tile([1.0, 0.0, 0.0], (4000, 1)), rng, sigma=0.006)
    both = joined(gaussians, plate)
    label = torch.cat([torch.ones(len(gaussians)), torch.zeros(len(plate))]).int()
    beside = float(filled(both, cameras, label).volume.double().sum())
    assert beside == pytest.approx(volume_of(*DEEP), rel=0.02)


def test_nothing_is_filled_where_the_cameras_see_past_the_body():
    gaussians, cameras, truth = seen_around(*PLAIN)
    body = filled(gaussians, cameras, solid=Round(radius=1.3 * RADIUS))
    # a particle lies at the centroid of its cell; a tenth of the cameras may err
    assert float(body.position.norm(dim=1).max()) < truth + 0.5 * SPACING
    assert float(body.volume.double().sum()) == pytest.approx(4 / 3 * np.pi * truth**3, rel=0.1)


def test_distances_are_those_of_the_surface(rng):
    """... to three quarters of a pixel in the mean, and one for most."""
    gaussians, cameras, truth = seen_around(*PLAIN)
    box = dict(lower=np.full(3, -0.07), upper=np.full(3, 0.07))
    view = seen(gaussians, torch.ones(len(gaussians)).int(), cameras, **box, spacing=SPACING, log=Log(None))
    assert view.truncation == pytest.approx(0.75 * SPACING)
    x = sphere(2000, 1.0, rng)[0] * (truth + rng.uniform(-0.002, 0.002, (2000, 1)))
    moved, normal, found = view.settled(x, SPACING)
    error = np.linalg.norm(moved, axis=1) - truth
    assert found.mean() > 0.98
    assert abs(error[found].mean()) < 1.2e-3 and np.quantile(np.abs(error[found]), 0.9) < 1.6e-3
    assert ((normal * moved).sum(1)[found] > 0.9 * truth).mean() > 0.98  # outward, to 25 degrees
    assert view.beside(1.2 * x).all() and not view.beside(0.9 * x).any()


# [spacings] standard deviation of Gaussians across their disc; fits of plain surfaces have them as broad as particles
BREADTHS = [0.3, 1.0, 2.0]


@pytest.mark.parametrize("seen_by", ["cameras", "nobody"])
@pytest.mark.parametrize("breadth", BREADTHS)
def test_a_sheet_of_broad_gaussians_has_its_area(breadth, seen_by, rng):
    sides, sigma = np.array([0.18, 0.12]), breadth * SPACING
    point = rng.uniform([*(-sides / 2), 0], [*(sides / 2), 0], (1500, 3))
    gaussians = discs(point, np.tile([0.0, 0.0, 1.0], (1500, 1)), rng, sigma=sigma)
    body = filled(gaussians, around(16) if seen_by == "cameras" else ())
    # random packing scatters by a tenth; discs at the rim reach one deviation over it, and no farther
    least, most = 0.85 * sides.prod() / SPACING**2, 1.1 * (sides + 2 * sigma).prod() / SPACING**2
    assert least < len(body.position) < most
    assert float(body.position[:, 2].abs().max()) < 1e-3


def test_a_bent_petal_stays_thin_however_closely_it_is_looked_at(rng):
    """With cameras it is looked at twice as closely as its particles lie; its sides are as far apart as before."""
    (point, normal), area = petal(6000, rng)
    gaussians = discs(point - point.mean(0), normal, rng, noise=0.0003)
    body = filled(gaussians, around(16), thickness=0.001)
    # a solid of so many Gaussians would be several millimetres thick
    assert float(body.volume.double().sum()) == pytest.approx(0.001 * area, rel=0.1)


@pytest.mark.parametrize("breadth", BREADTHS)
def test_a_ball_of_broad_gaussians_has_its_volume(breadth, rng):
    """By itself it is the ball on which its discs lie. Their rims show around it: cameras see it a little larger."""
    point, normal = sphere(3000, RADIUS, rng)
    gaussians, cameras = discs(point, normal, rng, sigma=breadth * SPACING), around(16)
    radius = lambda body: (float(body.volume.double().sum()) * 3 / (4 * np.pi)) ** (1 / 3)
    # the rim of a disc lies sigma^2/2R outside of the ball
    assert RADIUS - 3e-4 < radius(filled(gaussians, ())) < RADIUS + (breadth * SPACING) ** 2 / (2 * RADIUS) + 3e-4
    # the discs' faces are where they are, whatever their rims do to outlines, which are the most that may be filled
    rims = radius_in_pictures(gaussians, cameras) - RADIUS
    assert -3e-4 < radius(filled(gaussians, cameras)) - RADIUS < 0.6 * rims


@pytest.mark.parametrize("breadth", BREADTHS)
def test_a_box_of_broad_gaussians_has_its_volume(breadth, rng):
    """Its discs lie in its faces, however broad: what is seen of them is the face, not their centres."""
    half, sigma = np.array([0.05, 0.04, 0.03]), breadth * SPACING
    gaussians = discs(*box(4000, half, rng), rng, sigma=sigma)
    for cameras in ((), around(16)):
        volume = float(filled(gaussians, cameras).volume.double().sum()) / (8 * half.prod())
        # faces reach one deviation over their edges, and a tenth of that ridge is filled
        assert 0.95 < volume < 1.06 + 0.1 * ((half + sigma).prod() / half.prod() - 1)


def test_gaussians_too_round_for_the_particles_are_refused_for_that(rng):
    """A flat cloud of balls as thick as it is wide in particles: not the cameras are wrong."""
    point = rng.uniform([-0.09, -0.06, 0], [0.09, 0.06, 0], (1500, 3))
    gaussians = discs(point, np.tile([0.0, 0.0, 1.0], (1500, 1)), rng, sigma=2 * SPACING, thickness=2 * SPACING)
    with pytest.raises(ValueError, match=r"24 mm thick, and its particles 6 mm apart.* larger scene.spacing"):
        filled(gaussians, around(16))


def test_leaves_that_hide_the_sky_from_each_other_stay_thin(rng):
    """Of two leaves 4 cm apart neither sees as much of the sky from below as from above; cameras see past both."""
    side, apart = 0.1, 0.04
    point = (
        rng.uniform(-side / 2, side / 2, (8000, 3)) * [1, 1, 0]
        + np.repeat([[0, 0, -1], [0, 0, 1]], 4000, 0) * apart / 2
    )
    gaussians = discs(point, np.tile([0.0, 0.0, 1.0], (8000, 1)), rng, sigma=0.003, noise=0.0003)
    body = filled(gaussians, around(32), thickness=0.001)
    # discs at the rim reach one deviation over it; a solid would be several millimetres thick
    assert float(body.volume.double().sum()) == pytest.approx(2 * 0.001 * (side + 0.006) ** 2, rel=0.15)


def test_what_outlines_alone_bound_is_shown_by_no_photograph():
    """Of a ball: all of it by cameras all around; by those above what they see, not the cone that closes it below."""
    gaussians, cameras, _ = seen_around(*PLAIN)
    whole = filled(gaussians, cameras).doubt
    assert whole.shown.float().mean() > 0.99
    above = [camera for camera in around(64) if camera.centre[2] > 0.2]  # of 0.4: by 30 degrees and more
    half = filled(gaussians, above).doubt
    height = half.position[:, 2] / RADIUS
    assert half.shown[height > 0].float().mean() > 0.95
    # a camera 30 degrees above the horizon sees down to where normals point 60 degrees below it
    assert half.shown[height < -0.9].float().mean() < 0.05
    assert half.volume[~half.shown].sum() > 5 * whole.volume.sum()
