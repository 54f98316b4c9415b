"""Pictures of what is to come: the last frame seen, carried along by the motion of the body.

    y = x + u(t_l, x),     v(t, y) = J(x) (q(t) - q(t_l)) [px]

x is a pixel of the picture in which the body is where its Gaussians are, y where it is seen in the last frame, at t_l.
The photograph keeps its sharpness, and a body that has come to rest its picture.
"""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.learning.free_motion import FreeMotion
from physics3d.learning.identify import Swing
from physics3d.learning.seen_modes import Sight
from physics3d.motion.carry import carried, inverse

SMOOTH = 1.5  # of the displacement [px]

Moving = FreeMotion | Swing  # a motion whose amplitudes are known at any time


def foretold(
    photograph: UInt8[Tensor, "h w 3"],
    sight: Sight,
    motion: Moving,
    moved: Float[np.ndarray, "h w 2"],
    *,
    last: float,
    times: Float[np.ndarray, " n"],
) -> UInt8[Tensor, "n h w 3"]:
    """Pictures at `times` [s] from the `photograph` at time `last`, in which the flow `moved` has taken the pixels of
    the sight."""
    import cv2

    back = inverse(moved)
    y, x = np.mgrid[: back.shape[0], : back.shape[1]].astype(np.float32)
    here, picture, frames = motion.at(last), photograph.numpy(), []
    for t in times:
        u = sight.displacement(motion.at(float(t)) - here).astype(np.float32)
        v = cv2.remap(u, x + back[..., 0], y + back[..., 1], cv2.INTER_LINEAR)
        frames.append(torch.from_numpy(carried(picture, cv2.GaussianBlur(v, (0, 0), SMOOTH))))
    return torch.stack(frames)
