"""Whether a camera moved at all: without parallax between its pictures they say nothing of depth.

Two pictures from one place differ by a rotation R and by what zooming does to the focal length, whatever they show:

    x' = K' R K^-1 x,      K = diag(f, f, 1) about the middle of the picture

Structure from motion finds some depth in them all the same (a fixed camera and a plant in the wind gave 7 degrees). So
of each pair of pictures the matches are counted that this explains to `EXPLAINED`; the rest has moved against it.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

EXPLAINED = 2e-3  # of the longer side of a picture
ENOUGH = 30  # matches of a pair that is asked
MOST = 150  # matches of a pair that are looked at
FOCAL = 1.2  # where the search for f begins, of the longer side


def explained(a: Float64[np.ndarray, "n 2"], b: Float64[np.ndarray, "n 2"], size: float) -> float:
    """Share of the matches a[i], b[i] that a camera in one place explains.

    Coordinates are from the middle of the pictures [px]; `size` is their longer side [px].
    """
    import cv2
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    # most of the matches that one plane or one place explains: the start, free of what moves by itself
    _, inside = cv2.findHomography(a, b, cv2.RANSAC, size * EXPLAINED)
    kept = inside.ravel() > 0 if inside is not None else np.ones(len(a), bool)
    if kept.sum() < 8:
        return 0.0

    def error(p: np.ndarray, which: np.ndarray) -> np.ndarray:
        f, g = size * np.exp(p[3:])
        rays = np.concatenate([a[which] / f, np.ones((which.sum(), 1))], 1) @ Rotation.from_rotvec(p[:3]).as_matrix().T
        return (g * rays[:, :2] / np.maximum(rays[:, 2:], 1e-3) - b[which]) / (size * EXPLAINED)

    start = np.array([0.0, 0.0, 0.0, np.log(FOCAL), np.log(FOCAL)])
    fit = least_squares(lambda p: error(p, kept).ravel(), start, loss="soft_l1", max_nfev=60)
    return float((np.linalg.norm(error(fit.x, np.ones(len(a), bool)), axis=1) < 1).mean())


def share_explained(pairs: Iterable[tuple[np.ndarray, np.ndarray]], size: float) -> float | None:
    """The share that a camera in one place explains, of the pair of which it explains least but for a tenth.

    None if no pair has enough matches to tell.
    """
    shares = []
    for a, b in pairs:
        if len(a) >= ENOUGH:
            pick = np.linspace(0, len(a) - 1, min(len(a), MOST)).round().astype(int)
            shares.append(explained(a[pick].astype(np.float64), b[pick].astype(np.float64), size))
    return float(np.quantile(shares, 0.1)) if shares else None
