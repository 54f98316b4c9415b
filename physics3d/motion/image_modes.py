"""Image modes (Davis et al. 2015): how far one gets without physics. The bar for everything that has some.

The flow of the part of a clip that was seen, from its last frame, is a few shapes times a free decay (`shapes.py`,
`decay.py`); the decay goes on, and the last frame seen is carried along (`carry.py`):

    u(t, x) = sum_k phi_k(x) sum_j g_j [s_jk(t) - s_jk(t_r)]             t_r: the frame that is carried

with the gains g_j of `decay.py`. Where the thing has come to rest, every term is noise or has died out, u = 0, and the
prediction is the still picture.

One take tells of the others: `of_another_take` keeps shapes, frequencies and dampings and fits the start alone.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.cores import spread
from physics3d.motion.carry import carried, inverse
from physics3d.motion.decay import Decay, with_start
from physics3d.motion.flow import flow, flow_from, trust
from physics3d.motion.release import free_decay
from physics3d.motion.shapes import moving, shapes, signals

SMOOTH = 1.5  # of the displacement, less than the patches of the flow [px]


@dataclass(frozen=True, kw_only=True)
class ImageModes:
    photograph: UInt8[Tensor, "h w 3"]  # the last frame seen
    reference: int  # its index: frames are counted from the first frame seen
    fps: float  # [1/s]
    shape: Float[np.ndarray, "k h w 2"]  # [px per px rms]
    signal: Float[np.ndarray, "t k"]  # measured, of the frames seen [px rms]
    decay: Decay | None  # None: nothing moves
    release: int  # first frame of the free decay

    def displacement(self, frame: int) -> Float[np.ndarray, "h w 2"]:
        """Where the pixels of the photograph are in that frame, which may lie beyond what was seen [px]."""
        import cv2

        if self.decay is None:
            return np.zeros((*self.photograph.shape[:2], 2), np.float32)
        here, there = self.decay.terms(np.array([frame, self.reference]) / self.fps).transpose(1, 0, 2)
        s = (self.decay.gain()[:, None] * (here - there)).sum(0)
        return cv2.GaussianBlur(np.tensordot(s.astype(np.float32), self.shape, 1), (0, 0), SMOOTH)

    def frames(self, indices: range) -> UInt8[Tensor, "t h w 3"]:
        """The predicted pictures."""
        picture = self.photograph.numpy()
        return torch.from_numpy(np.stack(spread(lambda i: carried(picture, self.displacement(i)), indices)))


def image_modes(seen: UInt8[Tensor, "t h w 3"], fps: float, *, count: int = 6, most: int = 5) -> ImageModes:
    """Image modes of what was seen of a clip. Raises ValueError for fewer than 8 frames."""
    if len(seen) < 8:
        raise ValueError(f"{len(seen)} frames were seen; image modes need at least 8")
    last = len(seen) - 1
    u = flow(seen, reference=last)
    where = moving(u)
    if where is None:
        nothing = np.zeros((len(seen), 0)), np.zeros((0, *u.shape[1:]), np.float32)
        return ImageModes(
            photograph=seen[-1], reference=last, fps=fps, signal=nothing[0], shape=nothing[1], decay=None, release=0
        )
    found = shapes(u, trust(seen, u, reference=last), where, count=count)
    decay, release = free_decay(found.signal, fps, most=most)
    return ImageModes(
        photograph=seen[-1],
        reference=last,
        fps=fps,
        shape=found.shape,
        signal=found.signal,
        decay=decay,
        release=release,
    )


def of_another_take(modes: ImageModes, seen: UInt8[Tensor, "t h w 3"], *, first: int = 0) -> ImageModes:
    """The same thing in another recording by the same camera: the start alone is fitted, from frame `first` on.

    Raises ValueError if `modes` has no motion, or for frames of another size.
    """
    if modes.decay is None:
        raise ValueError("the take to learn from does not move; give one in which the thing swings")
    if seen.shape[1:] != modes.photograph.shape:
        raise ValueError(
            f"frames of {tuple(seen.shape[1:3])} px, the take learned from has {tuple(modes.photograph.shape[:2])}"
        )
    last = len(seen) - 1
    between = flow_from(modes.photograph, seen)[-1]
    shape = np.stack([at(s, inverse(between)) for s in modes.shape])
    u = flow(seen, reference=last)
    s = signals(u, trust(seen, u, reference=last), shape)
    decay = with_start(modes.decay, s, modes.fps, first=first)
    return ImageModes(
        photograph=seen[-1], reference=last, fps=modes.fps, shape=shape, signal=s, decay=decay, release=first
    )


def at(field: Float[np.ndarray, "h w 2"], v: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """field(y + v(y)), 0 outside."""
    import cv2

    y, x = np.mgrid[: v.shape[0], : v.shape[1]].astype(np.float32)
    return cv2.remap(field, x + v[..., 0], y + v[..., 1], cv2.INTER_LINEAR)
