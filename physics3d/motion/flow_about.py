"""Dense flow where it is known roughly how things move.

The picture is carried along by that guess g (`carry.py`), and what is left is found by DIS (`flow.py`) and added:

    u(t, x) = g(t, x) + r(t, x + g(t, x)),     r: from the carried picture to frame t

A thing that is thin then has its ground where it is in the frame, in every patch and at every scale. A guess that is a
fifth too small will do; it should go on for the reach of a patch beyond the outline, or it tears within one.
"""

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.cores import spread
from physics3d.motion.carry import carried
from physics3d.motion.flow import dense, greys

REACH = 8.0  # of the patches of the flow [px]


def flow_about(
    guess: Float[np.ndarray, "t h w 2"], picture: UInt8[Tensor, "h w 3"], video: UInt8[Tensor, "t h w 3"]
) -> Float[np.ndarray, "t h w 2"]:
    """Displacement of what is seen at each pixel of the picture, from there to frame t, near the `guess` [px]."""
    import cv2

    here = greys(picture[None])[0]
    y, x = np.mgrid[: here.shape[0], : here.shape[1]].astype(np.float32)

    def about(g: Float[np.ndarray, "h w 2"], frame: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
        left = dense().calc(carried(here, g), frame, None)
        return g + cv2.remap(left, x + g[..., 0], y + g[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return np.stack(spread(about, guess.astype(np.float32), greys(video)))
