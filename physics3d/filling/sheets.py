"""A thin surface -> one particle per spacing^2 of it, and the area that each stands for: petals, leaves."""

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

# random sequential packing of discs leaves 1.44 diameter^2 to each: this diameter gives one spacing^2; neighbours are
# less than two of them apart
APART = 2 / np.sqrt(1.44)  # [spacings]


def sheet(point: np.ndarray, normal: np.ndarray, spacing: float, detail: float) -> tuple[np.ndarray, np.ndarray]:
    """Thin surface, samples half of `detail` apart -> particles [s, 3] about a spacing apart, and the area [s] [m^2]
    that each stands for."""
    if len(point) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    tree = cKDTree(point)
    radius = APART / 2 * spacing
    free, chosen = np.ones(len(point), bool), []
    # the first of every voxel of half a spacing: among denser ones, in this order, they would lie closer to each other
    for i in np.unique(np.floor(point / (spacing / 2)).astype(np.int64), axis=0, return_index=True)[1]:
        if free[i]:
            chosen.append(i)
            free[tree.query_ball_point(point[i], radius)] = False
    position = point[chosen]
    _, owner = cKDTree(position).query(point)
    area = np.bincount(owner, weights=sample_area(point, normal, detail, tree), minlength=len(position))
    lonely = area <= 0  # fewer than three samples close by: a thread; it counts as a square of one sample
    return position, np.where(lonely, (detail / 2) ** 2, area)


def disc_moment(normal: np.ndarray, area: np.ndarray, thickness: float) -> np.ndarray:
    """Second moments [s, 3, 3] m^2, per volume, of plates: normals [s, 3], areas [s] m^2, one thickness [m]."""
    across = normal[:, :, None] * normal[:, None, :]
    return thickness**2 / 12 * across + area[:, None, None] / 12 * (np.eye(3) - across)


def sample_area(point: np.ndarray, normal: np.ndarray, detail: float, tree: cKDTree) -> np.ndarray:
    """Area [m^2] of each sample, half of `detail` apart: a third of the Delaunay triangles around it, among neighbours
    in its layer."""
    area = np.zeros(len(point))
    _, neighbours = tree.query(point, k=min(20, len(point)), distance_upper_bound=1.5 * detail)
    tangent = np.linalg.svd(normal[:, None, :])[2][:, 1:, :]
    for i, row in enumerate(neighbours):
        row = row[row < len(point)]
        offset = point[row] - point[i]
        flat = np.abs(offset @ normal[i]) < 0.5 * detail  # other layers have their own area
        planar = offset[flat] @ tangent[i].T
        if len(planar) < 3:
            continue
        try:
            corners = planar[Delaunay(planar).simplices]
        except QhullError:  # all on a line
            continue
        here = (np.abs(corners) < 1e-12).all(2).any(1)
        a, b, c = (corners[here, k] for k in range(3))
        sides = np.stack([np.linalg.norm(a - b, axis=1), np.linalg.norm(b - c, axis=1), np.linalg.norm(c - a, axis=1)])
        u, v = b - a, c - a
        triangle = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
        area[i] = triangle[sides.max(0) < 1.5 * detail].sum() / 3
    return area
