"""Pictures of what is to come: the last frame seen, carried along by the motion of the body.

    y = x + u(t_l, x),     v(t, y) = J(x) (q(t) - q(t_l)) [px]

x is a pixel of the picture in which the body is where its Gaussians are, y where it is seen in the last frame, at t_l.
The photograph keeps its sharpness, and a body that has come to rest its picture.

A decay that is fitted to all that was seen goes on for ever; what rubs or touches something stops. So the last half
period that was seen is asked: if there the thing moved by less than half of what the motion says, it has stopped. Of
one amplitude, half a period tells at least a third of what another phase tells: a phase that is wrong is no stop.
"""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.cores import spread
from physics3d.learning.free_motion import FreeMotion
from physics3d.learning.identify import Swing
from physics3d.learning.seen_modes import Sight
from physics3d.motion.carry import carried, inverse

SMOOTH = 1.5  # of the displacement [px]
STOPPED = 0.25  # of the mean square of what a motion says
LEAST = 4  # frames that are asked

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
    here, picture = motion.at(last), photograph.numpy()

    def at(t: float) -> UInt8[np.ndarray, "h w 3"]:
        u = sight.displacement(motion.at(t) - here)
        v = cv2.remap(u, x + back[..., 0], y + back[..., 1], cv2.INTER_LINEAR)
        return carried(picture, cv2.GaussianBlur(v, (0, 0), SMOOTH))

    return torch.from_numpy(np.stack(spread(at, times.tolist())))


def has_stopped(
    sight: Sight,
    swing: Swing,
    flow: Float[np.ndarray, "t h w 2"],
    weight: Float[np.ndarray, "t n"],
    *,
    fps: float,
    release: int,
) -> bool:
    """Whether the thing stands still at the end of the frames seen, though it should swing. `flow` and the `weight` of
    the pixels of the sight are of all those frames; time 0 of the swing is frame `release`."""
    last, loudest = len(flow) - 1, swing.loudest((len(flow) - 1 - release) / fps)
    first = max(release, last - max(LEAST, round(0.5 * fps / swing.modes.frequency[loudest])))
    i, j = sight.pixel.T
    end = swing.at((last - release) / fps)
    told = np.stack([sight.jacobian @ (swing.at((k - release) / fps) - end) for k in range(first, last)])
    seen = flow[first:last, i, j] - flow[last, i, j]
    size = lambda u: float((weight[first:last] * (u**2).sum(-1)).sum())
    return size(seen) < STOPPED * size(told)
