"""What the doubt of a surface leaves open: beams and bars whose stiffness is known by heart."""

import math

import numpy as np
import pytest
import torch

from physics3d.filling.doubt import UNIFORM, doubt_of, faces, widths
from physics3d.log import Log
from physics3d.matter import Matter, of_particles

EDGE = 0.002


def lattice(inside, half) -> Matter:
    """Cubes of edge EDGE whose centres are inside, within a box of these half widths."""
    steps = [np.arange(-h + EDGE / 2, h, EDGE) for h in half]
    x = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    x = x[inside(x)]
    return of_particles(torch.from_numpy(x), torch.full((len(x),), EDGE**3, dtype=torch.float64))


def plate(thickness: float, length: float = 0.08, width: float = 0.04) -> Matter:
    return lattice(lambda x: x[:, 0] < 9, (length / 2, width / 2, thickness / 2))


def rod(radius: float) -> Matter:
    return lattice(lambda x: np.hypot(x[:, 1], x[:, 2]) < radius, (0.06, radius, radius))


def bent(matter: Matter, curvature: float = 1e-3) -> tuple[torch.Tensor, torch.Tensor]:
    """F and velocity of pure bending about y to first order: strain of -curvature z along x, of no Poisson's ratio."""
    x, _, z = matter.position.T
    F = torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3).clone()
    F[:, 0, 0] -= curvature * z
    F[:, 0, 2] -= curvature * x
    F[:, 2, 0] += curvature * x
    u = torch.stack([-curvature * x * z, 0 * x, curvature * x**2 / 2], 1)
    return F[None], u[None]


def stretched(matter: Matter) -> tuple[torch.Tensor, torch.Tensor]:
    """F and velocity of a bar that is stretched along x."""
    F = torch.diag(torch.tensor([1 + 1e-4, 1.0, 1.0], dtype=torch.float64)).expand(len(matter.position), 3, 3)
    return F[None], 1e-4 * matter.position[None] * torch.tensor([1.0, 0.0, 0.0])


def around(matter: Matter, side=lambda n: np.full(len(n), True)) -> np.ndarray:
    """Places on the boundary whose outward direction is taken."""
    x, n, _ = faces(matter)
    return x[side(n)]


@pytest.mark.parametrize("thickness", [0.012, 0.02])
def test_a_plate_is_in_doubt_by_three_times_its_faces_when_it_bends_and_once_when_it_is_stretched(thickness):
    matter, delta = plate(thickness), 0.0003
    x, n, area = faces(matter)
    flat = np.abs(n[:, 2]) > 0.99  # its faces, not its edges, which are narrow
    doubt = doubt_of(matter, x, np.where(np.abs(n[:, 2]) > 0.5, delta, 0.0), EDGE, Log(None))
    assert area[flat].sum() == pytest.approx(2 * 0.08 * 0.04, rel=0.15)  # without the rows at the edges
    args = matter.position, matter.volume
    # K goes with t^3, and both faces move. Cubes of EDGE see 1 - (EDGE/t)^2 of the second moment
    bending = 6 * delta / thickness / (1 - (EDGE / thickness) ** 2)
    assert widths(doubt, *args, *bent(matter)).stiffness == pytest.approx(bending, rel=0.06)
    along = widths(doubt, *args, *stretched(matter))
    # the rows of pieces at the edges, 15 % of a face, are in doubt by their narrow face as well, sqrt(2) as large
    assert along.stiffness == pytest.approx(2 * delta / thickness, rel=0.08)
    assert along.mass == pytest.approx(2 * delta / thickness, rel=0.15)  # most of |v|^2 is at two of these edges
    assert along.unshown == 0


def test_a_rod_is_in_doubt_by_four_times_its_radius_when_it_bends():
    radius, delta = 0.012, 0.0003
    matter = rod(radius)
    x, n, _ = faces(matter)
    doubt = doubt_of(matter, x, np.where(np.abs(n[:, 0]) < 0.5, delta, 0.0), EDGE, Log(None))
    # a circle of six cubes' radius is made of steps: areas of pieces are right to a few per cent
    assert widths(doubt, matter.position, matter.volume, *bent(matter)).stiffness == pytest.approx(
        4 * delta / radius, rel=0.12
    )


def test_what_no_photograph_shows_is_as_uncertain_as_it_is_deep(tmp_path):
    thickness, length, width = 0.012, 0.16, 0.12
    matter = plate(thickness, length, width)
    log = Log(tmp_path)
    above = around(matter, lambda n: n[:, 2] > -0.5)  # all but what looks down
    half = doubt_of(matter, above, np.zeros(len(above)), EDGE, log)
    found = widths(half, matter.position, matter.volume, *bent(matter))
    bending = 3 * UNIFORM / (1 - (EDGE / thickness) ** 2)
    # but for a strip along the edges, whose nearest surface that is shown is the edge
    strip = 1 - (1 - 2 * thickness / length) * (1 - 2 * thickness / width)
    assert bending * (1 - strip) < found.stiffness < bending * 1.06
    assert found.unshown == 1
    said = (tmp_path / "log.txt").read_text()
    assert "no photograph shows" in said and "photograph it from below" in said
    assert math.exp(1.645 * found.stiffness) > 2**3  # a plate twice as thick as it is stays within the interval


def test_nothing_is_left_open_where_everything_is_shown_exactly(tmp_path):
    matter = rod(0.012)
    x = around(matter)
    doubt = doubt_of(matter, x, np.zeros(len(x)), EDGE, Log(tmp_path))
    assert bool(doubt.shown.all())
    found = widths(doubt, matter.position, matter.volume, *bent(matter))
    assert (found.stiffness, found.mass) == (0, 0)
    assert not (tmp_path / "log.txt").exists() or "photograph" not in (tmp_path / "log.txt").read_text()
