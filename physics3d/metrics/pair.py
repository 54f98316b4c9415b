"""Any two videos of one motion, ours or not, made comparable: the real one and a prediction of it.

Frame 0 of both is the same instant. The larger is reduced to the size of the smaller, of the faster those frames are
taken that are nearest to the instants of the slower, and the longer is cut. Whatever was done is said.
"""

from dataclasses import dataclass

import torch
from jaxtyping import UInt8
from torch import Tensor

from physics3d.motion.clip import Clip
from physics3d.video import reduced

ASPECT = 0.02  # two shapes of picture that differ by more do not show the same
LEAST_FRAMES = 8


@dataclass(frozen=True, kw_only=True)
class Pair:
    real: UInt8[Tensor, "t h w 3"]
    predicted: UInt8[Tensor, "t h w 3"]
    fps: float  # [1/s]
    notes: tuple[str, ...]


def paired(real: Clip, predicted: Clip) -> Pair:
    """Raises ValueError, in one line, for shapes of pictures that differ and for fewer than 8 common frames."""
    (h, w), (g, v) = real.frames.shape[1:3], predicted.frames.shape[1:3]
    if abs(w * g / (h * v) - 1) > ASPECT:
        raise ValueError(
            f"{real.path.name} is {w} x {h} px, {predicted.path.name} {v} x {g}: other shapes; cut them alike"
        )
    notes = [f"{clip.path.name}: {note}" for clip in (real, predicted) for note in clip.notes]
    size = (min(h, g), min(w, v))
    if (h, w) != (g, v):
        notes.append(f"sizes {w} x {h} and {v} x {g} px: compared at {size[1]} x {size[0]}")
    fps = min(real.fps, predicted.fps)
    if abs(real.fps / predicted.fps - 1) > 0.001:
        notes.append(f"rates {real.fps:g} and {predicted.fps:g} fps: compared at {fps:g}")
    a, b = (resampled(clip, fps) for clip in (real, predicted))
    count = min(len(a), len(b))
    if len(a) != len(b):
        notes.append(f"lengths {len(a) / fps:.2f} and {len(b) / fps:.2f} s: the first {count / fps:.2f} s are compared")
    if count < LEAST_FRAMES:
        raise ValueError(
            f"{real.path.name} and {predicted.path.name} have {count} frames in common; {LEAST_FRAMES} are the least"
        )
    return Pair(real=reduced(a[:count], *size), predicted=reduced(b[:count], *size), fps=fps, notes=tuple(notes))


def resampled(clip: Clip, fps: float) -> Tensor:
    """The frames nearest to the instants 0, 1/fps, 2/fps, ..."""
    if abs(clip.fps / fps - 1) <= 0.001:
        return clip.frames
    count = int((len(clip.frames) - 1) * fps / clip.fps + 1e-6) + 1
    return clip.frames[(torch.arange(count, dtype=torch.float64) * clip.fps / fps).round().long()]
