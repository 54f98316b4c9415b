"""Laws of what a body stands on: it is closed under the body, which ends there."""

import numpy as np
import pytest
import torch
from analytic_bodies import annulus, discs, joined, sphere, together, wall
from scipy.spatial import cKDTree
from seen_bodies import RADIUS, SPACING, Round, around, filled

from physics3d.filling.ground import ground
from physics3d.log import Log


@pytest.fixture
def rng():
    return np.random.default_rng(0)


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


def test_a_stem_enters_the_ground_with_its_whole_section(rng):
    """A cylinder that ends at the ground, which is bare around it: what holds it there finds it as wide as above.

    Rounded off, as a surface closes by itself, it had 0.4 of its area 3 to 5 mm below the ground, whose place is known
    to a spacing of 6 mm.
    """
    radius, height = 0.012, 0.1
    point, normal = together(wall(4000, radius, 0.0, height, rng), annulus(500, 0.0, radius, height, rng))
    floor = rng.uniform([-0.1, -0.1, 0], [0.1, 0.1, 0], (12000, 3))
    floor = floor[np.linalg.norm(floor[:, :2], axis=1) > 1.4 * radius]
    up = np.tile([0.0, 0.0, 1.0], (len(floor), 1))
    both = joined(discs(point, normal, rng), discs(floor, up, rng, sigma=0.002))
    label = (torch.arange(len(both)) < len(point)).int()
    cameras = [c for c in around(48) if c.centre[2] > 0.05]
    matter = filled(both, cameras, label).matter
    x, volume = matter.position.numpy(), matter.volume.numpy()
    section = lambda low, high: float(volume[(x[:, 2] > low) & (x[:, 2] < high)].sum()) / (high - low)  # area [m^2]
    # one layer of pieces of 3 mm; a quarter is a pixel of 1.6 mm around the rim
    assert section(-0.005, -0.002) > 0.75 * section(0.02, 0.08)
