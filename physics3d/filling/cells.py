"""The inside -> one particle per lattice cell, at the centroid of the part inside, V_p = its measure [m^3].

Cells on the boundary are measured by SUBDIVISION^3 samples; those of less than a quarter give their volume to the
nearest particle, so that sum V_p is the volume of the inside. What every cell holds of it, those included, is known as
pieces of matter, with its second moment and with what it touches.
"""

from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from physics3d.matter import Matter, of_samples

LEAST_FRACTION = 0.25  # a cell filled less than this is no particle of its own
SUBDIVISION = 4  # samples along each side of a boundary cell


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
    full, boundary = (full & ~boundary).reshape(-1), boundary.reshape(-1)

    part = (np.indices((SUBDIVISION,) * 3).reshape(3, -1).T + 0.5) / SUBDIVISION
    fine = centre[boundary, None, :] + spacing * (part - 0.5)
    found = inside(fine.reshape(-1, 3)).reshape(fine.shape[:2])
    filled = found.any(1)
    found, cut = found[filled], cell[boundary][filled]
    fraction = found.mean(1)
    centroid = np.einsum("ck,cki->ci", found, fine[filled]) / found.sum(1, keepdims=True)

    own = fraction >= LEAST_FRACTION
    position = np.concatenate([centre[full], centroid[own]])
    volume = np.concatenate([np.ones(int(full.sum())), fraction[own]])
    owner = np.full(len(cut), -1)
    owner[own] = full.sum() + np.arange(int(own.sum()))
    if len(position) and not own.all():
        distance, nearest = cKDTree(position).query(centroid[~own])
        near = distance < 2 * spacing
        np.add.at(volume, nearest[near], fraction[~own][near])
        owner[np.flatnonzero(~own)[near]] = nearest[near]
    taken = owner >= 0
    matter = of_samples(
        np.concatenate([cell[full], cut[taken]]),
        part,
        np.concatenate([np.ones((int(full.sum()), len(part)), bool), found[taken]]),
        origin,
        spacing,
        np.concatenate([np.arange(int(full.sum())), owner[taken]]),
    )
    return position, volume * spacing**3, matter
