"""The inside -> one particle per lattice cell, at the centroid of the part inside, V_p = its measure [m^3].

Cells on the boundary are cut into eighths and measured by samples, one in each of the n^3 equal parts of an eighth,
shifted so that along each axis no two are level (multi-jittered, Chiu, Shirley, Wang 1994; a fixed pattern takes the
place of chance):

    x = (i + (d_j + (d_d_l + 1/2)/n)/n)/n  of the part (i, j, l), y and z in turn,  d a permutation of 0 .. n-1

A face then meets a few samples at a time, wherever it lies. Samples on a lattice meet a face at 45 degrees by whole
rows, which makes the second moment of a bar two cells across wrong by up to a fifth.
Cells of less than a quarter give their volume to the nearest particle, so that sum V_p is the volume of the inside.
What the cells hold, those included, is known as pieces of matter (`matter.py`): of a small body eighths of cells, for
the solver without a grid integrates over them, of a large one cells.
"""

from collections.abc import Callable, Iterator

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from physics3d.matter import Matter, of_samples

LEAST_FRACTION = 0.25  # a cell filled less than this is no particle of its own
DIGITS = np.array([1, 3, 0, 2])  # d: neighbours far apart, no correlation with 0 .. n-1
MOST_PIECES = 7000  # a body whose eighths were more has cells for pieces
AT_ONCE = 2048  # cells measured at a time, of a million samples


def samples() -> np.ndarray:
    """Points [n^3, 3] of the unit cube, that of the part (i, j, l) at place (i n + j) n + l."""
    n = len(DIGITS)
    part = np.indices((n,) * 3).reshape(3, -1)
    shift = [DIGITS[np.roll(part, -a, 0)[1]] + (DIGITS[DIGITS[np.roll(part, -a, 0)[2]]] + 0.5) / n for a in range(3)]
    return ((part + np.stack(shift) / n) / n).T


EIGHTHS = np.indices((2, 2, 2)).reshape(3, -1).T


def solid_cells(
    inside: Callable[[np.ndarray], np.ndarray], surface: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray, Matter]:
    """Centroid [c, 3] [m] and volume [c] [m^3] of the part of every lattice cell that is inside, and its pieces."""
    lower, upper = surface.min(0), surface.max(0)
    count = np.ceil((upper - lower) / spacing).astype(int) + 2
    origin = (lower + upper - count * spacing) / 2
    cell = np.indices(count).reshape(3, -1).T
    centre = origin + (cell + 0.5) * spacing
    full = inside(centre).reshape(count)
    cube = np.ones((3, 3, 3), bool)
    boundary = ndimage.binary_dilation(full, cube) & ~ndimage.binary_erosion(full, cube)
    boundary[tuple(np.floor((surface - origin) / spacing).astype(int).T)] = True
    full, cut = cell[(full & ~boundary).reshape(-1)], cell[boundary.reshape(-1)]

    found = np.concatenate([np.zeros((0, 8, len(samples())), bool), *_measured(inside, cut, origin, spacing)])
    filled = found.any((1, 2))
    found, cut = found[filled], cut[filled]
    whole = (EIGHTHS[:, None] + samples()).reshape(-1, 3) / 2  # samples of a cell
    matter = found.reshape(len(cut), len(whole)).astype(float)
    fraction = matter.mean(1)
    centroid = origin + spacing * (cut + matter @ whole / matter.sum(1, keepdims=True))

    own = fraction >= LEAST_FRACTION
    position = np.concatenate([origin + (full + 0.5) * spacing, centroid[own]])
    volume = np.concatenate([np.ones(len(full)), fraction[own]])
    owner = np.full(len(cut), -1)
    owner[own] = len(full) + np.arange(int(own.sum()))
    if len(position) and not own.all():
        distance, nearest = cKDTree(position).query(centroid[~own])
        near = distance < 2 * spacing
        np.add.at(volume, nearest[near], fraction[~own][near])
        owner[np.flatnonzero(~own)[near]] = nearest[near]
    taken = owner >= 0
    cells, owners = np.concatenate([full, cut[taken]]), np.concatenate([np.arange(len(full)), owner[taken]])
    found = np.concatenate([np.ones((len(full), *found.shape[1:]), bool), found[taken]])
    if 8 * len(cells) <= MOST_PIECES:
        eighths = (2 * cells[:, None] + EIGHTHS).reshape(-1, 3)
        pieces = of_samples(
            eighths, samples(), found.reshape(-1, len(samples())), origin, spacing / 2, owners.repeat(8)
        )
    else:
        n = len(DIGITS)
        order = np.lexsort(np.floor(whole * 2 * n).astype(int).T[::-1])  # by the parts of the whole cell
        pieces = of_samples(cells, whole[order], found.reshape(-1, len(whole))[:, order], origin, spacing, owners)
    return position, volume * spacing**3, pieces


def _measured(
    inside: Callable[[np.ndarray], np.ndarray], cell: np.ndarray, origin: np.ndarray, spacing: float
) -> Iterator[np.ndarray]:
    """Which samples of the eighths of every cell are inside [.., 8, n^3], some cells at a time."""
    offset = (EIGHTHS[:, None] + samples()) / 2
    for some in np.array_split(cell, max(1, -(-len(cell) // AT_ONCE))):
        at = origin + spacing * (some[:, None, None] + offset)
        yield inside(at.reshape(-1, 3)).reshape(at.shape[:3])
