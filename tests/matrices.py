"""Matrices of every kind for the tests of tensor functions, and how exactly these have to hold."""

import numpy as np
import scipy.linalg
import warp as wp

TOLERANCE = {wp.float32: 2e-6, wp.float64: 1e-14}  # round-off times the dozen operations of each function


def deformations(rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """H [n, 3, 3] of many sizes, equal stretches, strong compression, large stretch, each also rotated; and how many of
    them are not."""
    special = [
        np.zeros(3),
        [0.5, 0.5, 0],
        [-0.5, -0.5, -0.5],
        [-0.99, 0, 0],
        [19, 0, 0],
        [19, -0.9, -0.9],
        [1e-6, 1e-6, 0],
    ]
    H = [np.diag(s) for s in special] + [scale * rng.standard_normal((3, 3)) for scale in np.logspace(-7, -0.5, 20)]
    H = np.stack([h for h in H if np.linalg.det(np.eye(3) + h) > 0])
    Q = scipy.stats.special_ortho_group(3, seed=0).rvs(len(H))
    return np.concatenate([H, Q @ (np.eye(3) + H) - np.eye(3)]), len(H)


def strains(rng: np.random.Generator) -> np.ndarray:
    """X = F F^T - I [n, 3, 3] of those that are not rotated."""
    H, unrotated = deformations(rng)
    return (H + H.transpose(0, 2, 1) + H @ H.transpose(0, 2, 1))[:unrotated]
