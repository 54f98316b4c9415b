"""Laws of pieces of matter: what a body weighs and how it resists bending is kept, and gaps stay gaps."""

import math

import numpy as np
import pytest
import torch
from modes_bodies import turned_beam

from physics3d.filling.cells import solid_cells
from physics3d.matter import Matter, in_blocks, of_particles, points
from physics3d.modes import lattice

THICK, LONG = 0.012, 0.24  # of a square bar [m]


def moments(matter: Matter, axes: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """(Volume [m^3], centroid [m], second moments about it [m^5] along the columns of `axes`) of a body."""
    x, weight, _ = points(matter)
    centroid = weight @ x / weight.sum()
    y = (x - centroid) @ axes
    return float(weight.sum()), centroid, np.einsum("n,ni,nj->ij", weight, y, y)


@pytest.mark.parametrize("degrees", [0, 15, 30, 45])
@pytest.mark.parametrize("shift", [0.0, 0.37, 0.61])
def test_a_bar_two_cells_across_has_its_second_moments_wherever_it_lies(degrees, shift):
    """b^4/12 per length. 3 %: 64 samples to an eighth of a cell; a lattice of samples is up to a fifth wrong."""
    a = math.radians(degrees)
    axes = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
    *_, matter = turned_beam(LONG, THICK, "square", degrees, 0.006, shift)
    volume, _, second = moments(matter, axes)
    assert volume == pytest.approx(LONG * THICK**2, rel=0.02)
    assert np.diag(second)[1:] == pytest.approx(LONG * THICK**4 / 12, rel=0.03)


@pytest.mark.parametrize("cells", [4, 12])
def test_eighths_and_cells_know_the_same_body(cells):
    """A ball of small and of many cells; its volume and second moment, 8 pi r^5/15 over two axes."""
    radius = 0.01 * cells / 2
    corners = radius * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    position, volume, matter = solid_cells(lambda x: np.linalg.norm(x, axis=1) < radius, corners, 0.01)
    assert (matter.spacing > 1.5 * matter.size) == (cells == 4)  # it has eighths where it is small
    whole, _, second = moments(matter, np.eye(3))
    assert whole == pytest.approx(volume.sum(), rel=1e-12)
    assert whole == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.01)
    assert np.trace(second) == pytest.approx(4 / 5 * math.pi * radius**5, rel=0.015)
    owned = np.bincount(matter.owner.numpy(), weights=matter.volume.numpy(), minlength=len(position))
    np.testing.assert_allclose(owned, volume, rtol=1e-12)  # pieces weigh what their particles weigh


def test_blocks_keep_moments_and_do_not_close_gaps():
    """Two plates 4.5 mm apart from middle to middle, and blocks of 6 mm that meet both."""
    grid = np.stack(np.meshgrid(np.arange(12), np.arange(9), [0, 1, 4], indexing="ij"), -1).reshape(-1, 3)
    x = torch.from_numpy(0.0015 * grid.astype(float))
    single = of_particles(x, torch.full((len(x),), 0.0015**3, dtype=torch.float64))
    blocks, number = in_blocks(single, 0.006)
    for before, after in zip(moments(single, np.eye(3)), moments(blocks, np.eye(3))):
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-18)
    assert len(blocks.position) < len(single.position) / 5
    upper = grid[:, 2] == 4
    assert not set(number[upper]) & set(number[~upper])
    above = np.isin(np.arange(len(blocks.position)), number[upper])
    links = blocks.links.numpy()
    assert (above[links[:, 0]] == above[links[:, 1]]).all() and len(links)
    assert len(set(blocks.owner.tolist())) == len(blocks.owner)


@pytest.mark.parametrize("shift", np.linspace(0, 1, 7))
@pytest.mark.parametrize("wide", [0.3, 0.05])
def test_a_gap_narrower_than_a_cell_stays_a_gap(shift, wide):
    """Two plates 5 mm apart, wherever the cells of 10 mm lie: no piece and no link has to do with both. Small plates
    have eighths for pieces, wide ones whole cells."""
    spacing, thick, gap = 0.01, 0.008, 0.005
    low = shift * spacing

    def inside(x: np.ndarray) -> np.ndarray:
        z = x[:, 2] - low
        across = (np.abs(x[:, :2]) < wide / 2).all(1)
        return across & (((z > 0) & (z < thick)) | ((z > thick + gap) & (z < 2 * thick + gap)))

    # corners that do not move with the plates, so that these lie anywhere in the lattice
    corners = np.array([[-wide / 2, -wide / 2, 0.0], [wide / 2, wide / 2, 4 * spacing]])
    flat = np.stack(np.meshgrid(*[np.linspace(-wide / 2, wide / 2, round(wide / spacing) * 2 + 1)] * 2), -1)
    faces = np.array([0, thick, thick + gap, 2 * thick + gap]) + low
    surface = [np.insert(flat.reshape(-1, 2), 2, face, axis=1) for face in faces]
    *_, matter = solid_cells(inside, np.concatenate([corners, *surface]), spacing)
    z, half = matter.position[:, 2].numpy() - low, np.sqrt(3 * matter.moment[:, 2, 2].numpy())
    upper = z > thick + gap / 2
    # samples are a quarter of a piece apart, and a piece is as much wider or narrower
    slack = spacing / 8 + 1e-9
    assert (z[upper] - half[upper] > thick + gap - slack).all() and (z[~upper] + half[~upper] < thick + slack).all()
    links = matter.links.numpy()
    assert len(links) and (upper[links[:, 0]] == upper[links[:, 1]]).all()
    assert matter.volume.sum() == pytest.approx(2 * thick * wide**2, rel=0.1)


def test_what_holds_a_body_asks_only_functions_that_hold_matter():
    """Wherever a face lies among the knots: one just before a knot lies in a cell without a point of the body."""
    edge, count = 0.004, 6
    x = (torch.arange(count, dtype=torch.float64) + 0.5) * edge
    body = of_particles(torch.stack([x, 0 * x, 0 * x], 1), torch.full((count,), edge**3, dtype=torch.float64))
    at, weight, piece = points(body)
    centre = body.position.numpy()
    face = np.array([[0.0, y, z] for y in (-1, 1) for z in (-1, 1)]) * edge / np.sqrt(12)  # its left end
    for H in np.linspace(1.2, 2.4, 25) * edge:  # knots are everywhere between the end and the first points
        places, which = np.concatenate([at, centre[:1]]), np.append(piece, 0)
        splines = lattice.splines(places, which, body.links.numpy(), count, H)
        values, _ = splines.at(face, np.zeros(4, int), continued_from=np.repeat(centre[:1], 4, 0))
        held = splines.at(at, piece)[0].T @ weight
        assert (held[np.unique(values.nonzero()[1])] > 0).all()
        # and what is continued is the field itself, if that is affine
        expected = np.concatenate([np.ones((4, 1)), face], 1)
        np.testing.assert_allclose(values @ splines.affine(), expected, rtol=0, atol=1e-12)
