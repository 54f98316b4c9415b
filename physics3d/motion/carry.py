"""A photograph carried along by a displacement of its pixels.

u(x) says where pixel x of the photograph goes. The picture asks the other way, where each of its pixels y comes from,

    y = x + u(x)   ->   x = y + v(y),    v(y) = -u(y + v(y))             (fixed point, a few steps)

and takes the colour there by cubic interpolation. Converges for |grad u| < 1, that is unless the motion tears. It tears
at the outline of what moves before what stands, and a thing that moves by more than its width arrives where u is 0. So
the steps start where something arrives from what arrives there, and of two things from the one that has moved farther:
what moves is before what stands. What is uncovered starts from -u(y), and shows what is beyond the thing.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from physics3d.motion.flow import size

STEPS = 8
MOVED = 0.5  # less needs no start of its own [px]


def carried(photograph: UInt8[np.ndarray, "h w *c"], u: Float[np.ndarray, "h w 2"]) -> UInt8[np.ndarray, "h w *c"]:
    """The photograph, grey or not, with every pixel x at x + u(x) [px]; pixels that do not move keep their colour."""
    import cv2

    v = inverse(u)
    y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
    return cv2.remap(photograph, x + v[..., 0], y + v[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def moved(where: Bool[np.ndarray, "h w"], u: Float[np.ndarray, "h w 2"]) -> Bool[np.ndarray, "h w"]:
    """Where the pixels `where` of the photograph are seen once every pixel x is at x + u(x) [px]."""
    import cv2

    v = inverse(u)
    y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
    return cv2.remap(where.astype(np.float32), x + v[..., 0], y + v[..., 1], cv2.INTER_LINEAR) > 0.5


def inverse(u: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """v with v(y) = -u(y + v(y)) [px]."""
    import cv2

    y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
    v = _arrivals(u)
    for _ in range(STEPS):
        v = -cv2.remap(u, x + v[..., 0], y + v[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return v


def _arrivals(u: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """-u of the pixel that arrives at each, and where none does the pixel's own -u. Where the motion tears, what lies
    in between would be drawn out over the gap: it does not arrive."""
    v, far = -u, size(u)
    torn = sum(slope**2 for part in (u[..., 0], u[..., 1]) for slope in np.gradient(part)) > 1
    i, j = np.nonzero((far > MOVED) & ~torn)
    farthest_last = np.argsort(far[i, j], kind="stable")
    i, j = i[farthest_last], j[farthest_last]
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):  # the four pixels that it lies between
        y = np.floor(i + u[i, j, 1]).astype(int) + down
        x = np.floor(j + u[i, j, 0]).astype(int) + right
        seen = (y >= 0) & (y < len(u)) & (x >= 0) & (x < u.shape[1])
        v[y[seen], x[seen]] = -u[i[seen], j[seen]]
    return v
