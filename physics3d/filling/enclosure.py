"""In which directions a place is walled in: rays along the 26 directions of a voxel's neighbours, against voxels of a
surface. What is not walled in sees the sky.
"""

import itertools

import numpy as np

DIRECTIONS = np.array(
    [d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
)  # [26, 3], towards voxel neighbours


class Enclosure:
    """For every voxel of size h [m] around the points, in which of the 26 directions a ray meets them."""

    def __init__(self, point: np.ndarray, h: float):
        self.h, self.lower = h, point.min(0) - 1.5 * h
        at = self.voxel(point)
        occupied = np.zeros(at.max(0) + 2, bool)
        occupied[tuple(at.T)] = True
        self.blocked = np.stack([swept(occupied, d) for d in DIRECTIONS])

    def voxel(self, x: np.ndarray) -> np.ndarray:
        return np.floor((x - self.lower) / self.h).astype(np.int64)

    def directions(self, x: np.ndarray) -> np.ndarray:
        """bool [m, 26]: does a ray from x in that direction meet a voxel of the surface?"""
        at, size = self.voxel(x), np.array(self.blocked.shape[1:])
        within = ((at >= 0) & (at < size)).all(1)
        return self.blocked[:, *np.where(within[:, None], at, 0).T].T & within[:, None]  # type: ignore[arg-type, index]

    def share(self, x: np.ndarray) -> np.ndarray:
        """[m] in 0..1: share of the directions in which x is enclosed."""
        return self.directions(x).mean(1)


def swept(occupied: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """OR of `occupied` over v, v + d, v + 2 d, ... by doubling the stride.

    A diagonal step also looks at the voxels it passes between, else it would slip through a surface one voxel thick.
    """
    blocked = occupied.copy()
    for taken in itertools.product(*[(0, d) if d else (0,) for d in direction]):
        blocked |= shifted(occupied, np.array(taken))
    stride = 1
    while stride < max(occupied.shape):
        blocked |= shifted(blocked, direction * stride)
        stride *= 2
    return blocked


def shifted(a: np.ndarray, by: np.ndarray) -> np.ndarray:
    """b[v] = a[v + by], False outside."""
    by = [int(np.clip(d, -n, n)) for d, n in zip(by, a.shape)]  # type: ignore[assignment]
    out = np.zeros_like(a)
    to = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(by, a.shape))
    of = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(by, a.shape))
    out[to] = a[of]
    return out
