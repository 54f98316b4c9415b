"""A photograph carried along by a displacement of its pixels.

u(x) says where pixel x of the photograph goes. The picture asks the other way, where each of its pixels y comes from,

    y = x + u(x)   ->   x = y + v(y),    v(y) = -u(y + v(y))             (fixed point, a few steps)

and takes the colour there by cubic interpolation. Converges for |grad u| < 1, that is unless the motion tears.
"""

import numpy as np
from jaxtyping import Float, UInt8

STEPS = 8


def carried(photograph: UInt8[np.ndarray, "h w 3"], u: Float[np.ndarray, "h w 2"]) -> UInt8[np.ndarray, "h w 3"]:
    """The photograph with every pixel x at x + u(x) [px]; pixels that do not move keep their exact colour."""
    import cv2

    v = inverse(u)
    y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
    return cv2.remap(photograph, x + v[..., 0], y + v[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def inverse(u: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """v with v(y) = -u(y + v(y)) [px]."""
    import cv2

    y, x = np.mgrid[: u.shape[0], : u.shape[1]].astype(np.float32)
    v = -u
    for _ in range(STEPS):
        v = -cv2.remap(u, x + v[..., 0], y + v[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return v
