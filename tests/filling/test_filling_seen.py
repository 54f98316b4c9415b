"""Laws of what cameras see of a body: it is as large as its pictures, wherever a fit has put its Gaussians."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from analytic_bodies import discs, joined, sphere
from scipy.spatial import cKDTree

from physics3d.filling.fill import AbstractSolid, Poisson, fill
from physics3d.filling.seen import ground, seen
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.log import Log

RADIUS, SPACING = 0.05, 0.006  # [m]


def around(count: int = 24, distance: float = 0.4, width: int = 160) -> list[Camera]:
    """Cameras on a spiral over the sphere, all looking at the origin; a pixel is 1.6 mm there."""
    at = (np.arange(count) + 0.5) / count
    height, turn = 1 - 2 * at, np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    places = distance * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], 1)
    pose = [look_at(torch.from_numpy(p), torch.zeros(3)) for p in places]
    return [
        Camera(width=width, height=width, fx=250, fy=250, cx=width / 2, cy=width / 2, world_to_camera=m) for m in pose
    ]


def ball(rng, depth: float, flat: float) -> Gaussians:
    """Discs `flat` [m] thick and 3 mm wide, their centres evenly up to `depth` [m] below the surface of a ball.

    A fit ends with about as many, and as faint, as it takes to hide what is behind: an optical depth of two.
    """
    point, normal = sphere(6000, RADIUS, rng)
    made = discs(point - depth * rng.random((len(point), 1)) * normal, normal, rng, sigma=0.003, thickness=flat)
    return replace(made, opacity_logit=torch.full((len(point),), -1.5))


def radius_in_pictures(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Of a ball at the origin, from the area in which it hides more than half of what is behind [m]."""
    found = []
    for camera in cameras:
        alpha = render(gaussians, camera, background=(0.0, 0.0, 0.0)).alpha
        tangent = np.sqrt(float((alpha > 0.5).sum()) / np.pi) / camera.fx
        found.append(float(camera.centre.norm()) * np.sin(np.arctan(tangent)))
    return float(np.mean(found))


@dataclass(frozen=True, kw_only=True)
class Round(AbstractSolid):
    """An inside test that takes more than there is: a whole ball, whatever the samples say."""

    radius: float  # [m]

    def inside(self, surface, spacing):
        return lambda x: np.linalg.norm(x, axis=1) < self.radius


def filled(gaussians: Gaussians, cameras: list[Camera], label=None, solid: AbstractSolid = Poisson()):
    return fill(
        gaussians,
        torch.ones(len(gaussians), dtype=torch.int32) if label is None else label,
        spacing=SPACING,
        opacity=0.1,
        solid=solid,
        interior=True,
        sheet_thickness=None,
        isolated="keep",
        drop_pieces_below=0.0,
        attach=False,
        cameras=cameras,
        log=Log(None),
    )


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(("depth", "flat"), [(0.0, 0.0003), (0.003, 0.0005)])
def test_a_body_is_as_large_as_its_pictures_wherever_its_gaussians_lie(depth, flat, rng):
    gaussians, cameras = ball(rng, depth, flat), around()
    truth = radius_in_pictures(gaussians, cameras)
    volume = float(filled(gaussians, cameras).volume.double().sum())
    # three quarters of a pixel; by the centres and their thickness it is 1.3 and 1.8 mm
    assert (volume * 3 / (4 * np.pi)) ** (1 / 3) == pytest.approx(truth, abs=1.2e-3)


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
    gaussians, cameras = ball(rng, 0.003, 0.0005), around()
    side = np.stack([np.full(4000, 0.09), *rng.uniform(-0.15, 0.15, (2, 4000))], 1)
    plate = discs(side, np.tile([1.0, 0.0, 0.0], (4000, 1)), rng, sigma=0.006)
    both = joined(gaussians, plate)
    label = torch.cat([torch.ones(len(gaussians)), torch.zeros(len(plate))]).int()
    alone, beside = filled(gaussians, cameras), filled(both, cameras, label)
    assert float(beside.volume.sum()) == pytest.approx(float(alone.volume.sum()), rel=0.02)


def test_the_ground_is_closed_under_the_body(rng):
    """A floor with waves of 5 mm, bare under a ball of 5 cm: how deep points lie below it, and what is above."""
    body = discs(*sphere(4000, RADIUS, rng), rng, sigma=0.003)
    wave = lambda x: 0.005 * np.sin(40 * x[:, 0]) - RADIUS
    floor = rng.uniform([-0.15, -0.15, 0], [0.15, 0.15, 0], (12000, 3))
    floor = floor[np.linalg.norm(floor[:, :2], axis=1) > 0.8 * RADIUS]
    floor[:, 2] = wave(floor)
    below = discs(floor, np.tile([0.0, 0.0, 1.0], (len(floor), 1)), rng, sigma=0.004)
    both, label = joined(body, below), (torch.arange(4000 + len(floor)) < 4000).int()
    cameras = [c for c in around(48) if c.centre[2] > 0.05]
    box = dict(lower=np.full(3, -RADIUS), upper=np.full(3, RADIUS), spacing=SPACING, opacity=0.1, log=Log(None))
    behind = ground(both, label, cameras, **box).behind
    x = rng.uniform([-0.08, -0.08, -RADIUS - 0.02], [0.08, 0.08, -RADIUS + 0.02], (2000, 3))
    # about a spacing as a rule, and never more than two: the waves go on under the ball where nothing shows them
    error = np.abs(behind(x) - (wave(x) - x[:, 2]))
    assert np.quantile(error, 0.9) < 1.25 * SPACING and error.max() < 2 * SPACING
    assert ground(body, torch.ones(4000).int(), cameras, **box) is None
    # a sheet in the air, seen from both sides, is no ground
    sheet = discs(
        floor * [1, 1, 0] + [0, 0, RADIUS + 0.02], np.tile([0.0, 0.0, 1.0], (len(floor), 1)), rng, sigma=0.004
    )
    assert ground(joined(body, sheet), label, around(48), **box) is None


def test_nothing_is_filled_where_the_cameras_see_past_the_body(rng):
    gaussians, cameras = ball(rng, 0.0, 0.0003), around()
    truth = radius_in_pictures(gaussians, cameras)
    body = filled(gaussians, cameras, solid=Round(radius=1.3 * RADIUS))
    # a particle lies at the centroid of its cell; a tenth of the cameras may err
    assert float(body.position.norm(dim=1).max()) < truth + 0.5 * SPACING
    assert float(body.volume.double().sum()) == pytest.approx(4 / 3 * np.pi * truth**3, rel=0.1)


def test_a_body_ends_below_the_ground_and_keeps_what_is_above(rng):
    """A ball half sunk into a shelf and half over its edge, of which an inside test says that all of it is there."""
    point, normal = sphere(9000, RADIUS, rng)
    free = (point[:, 0] > 0) | (point[:, 2] > 0)
    shelf = rng.uniform([-0.15, -0.15, 0], [0, 0.15, 0], (12000, 3))
    shelf = shelf[np.linalg.norm(shelf, axis=1) > RADIUS]
    up = np.tile([0.0, 0.0, 1.0], (len(shelf), 1))
    both = joined(discs(point[free], normal[free], rng, sigma=0.002), discs(shelf, up, rng, sigma=0.003))
    label = (torch.arange(len(both)) < int(free.sum())).int()
    cameras = [c for c in around(48) if c.centre[2] > 0.02]
    body = filled(both, cameras, label, solid=Round(radius=RADIUS))
    x, volume = body.position.double().numpy(), body.volume.double()
    # the shelf is in doubt by half of the way to where it is seen; a spacing is left, and the surface is known to one;
    # at its edge it bends down
    buried = (x[:, 0] < -3 * SPACING) & (x[:, 2] < -0.5 * cKDTree(shelf).query(x)[0] - 2 * SPACING)
    assert not buried.any()
    # half a ball; what the ground would take from it is none of it
    above = torch.from_numpy(x[:, 2] > 0)
    assert float(volume[above].sum()) == pytest.approx(2 / 3 * np.pi * RADIUS**3, rel=0.06)


def test_distances_are_those_of_the_surface(rng):
    """... to three quarters of a pixel in the mean, and one for most."""
    gaussians, cameras = ball(rng, 0.0, 0.0003), around()
    truth = radius_in_pictures(gaussians, cameras)
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
