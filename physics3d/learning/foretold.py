"""Pictures of what is to come: a frame that was seen, carried along by the motion of the body.

    y = x + u(t_k, x),     v(t, y) = J(x) (q(t) - q(t_k)) [px]

x is a pixel of the picture in which the body is where its Gaussians are, y where it is seen in frame k, at t_k. Of the
frames seen that one is taken in which, by the motion, the body is nearest to where it will be: a large swing turns and
bends the picture of a thing as no small displacement does, moves its shadow, and does so again a period later. The
photograph keeps its sharpness, and a body that has come to rest its last picture.

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
    frames: UInt8[Tensor, "k h w 3"],
    sight: Sight,
    motion: Moving,
    flow: Float[np.ndarray, "k h w 2"],
    *,
    at: Float[np.ndarray, " k"],
    times: Float[np.ndarray, " n"],
) -> UInt8[Tensor, "n h w 3"]:
    """Pictures at `times` [s] from `frames` at the times `at`, where the `flow` has taken the pixels of the sight."""
    import cv2

    there, places = (np.stack([motion.at(float(t)) for t in ts]) for ts in (at, times))
    picks = [_nearest(sight, there, place) for place in places]
    backs = {k: inverse(flow[k]) for k in set(picks)}
    y, x = np.mgrid[: flow.shape[1], : flow.shape[2]].astype(np.float32)

    def picture(k: int, place: Float[np.ndarray, " m"]) -> UInt8[np.ndarray, "h w 3"]:
        u = sight.displacement(place - there[k])
        v = cv2.remap(u, x + backs[k][..., 0], y + backs[k][..., 1], cv2.INTER_LINEAR)
        return carried(frames[k].numpy(), cv2.GaussianBlur(v, (0, 0), SMOOTH))

    return torch.from_numpy(np.stack(spread(picture, picks, places)))


def _nearest(sight: Sight, there: Float[np.ndarray, "k m"], place: Float[np.ndarray, " m"]) -> int:
    """The last of those of `there` that are seen nearest to `place`."""
    away = ((there - place) @ sight.gram * (there - place)).sum(1)
    return len(away) - 1 - int(np.argmin(away[::-1]))


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
