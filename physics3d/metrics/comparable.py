"""What may be compared with a reference: the same excitation, cameras and instants, at one size."""

from dataclasses import fields

import numpy as np
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.scenes.base import Take
from physics3d.video import Video, reduced


def same(simulated: tuple[AbstractBoundary, ...], filmed: tuple[AbstractBoundary, ...] | None) -> bool:
    """Whether both were set in motion alike, to a thousandth of every number; an unknown cause is like no other."""
    if filmed is None or [type(b) for b in simulated] != [type(b) for b in filmed]:
        return False
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for a, b in zip(simulated, filmed) for f in fields(a)]
    words = (str, type(None))
    return all(
        a == b if isinstance(a, words) or isinstance(b, words) else np.allclose(a, b, rtol=1e-3) for a, b in pairs
    )


def matched(name: str, video: Video, take: Take, cameras: tuple[int, ...]) -> list[Tensor]:
    """The clips of `video` in the order of `cameras`. Raises ValueError if they cannot be those of the take."""
    video.check()
    if len(video.frames) == len(cameras):
        clips = list(video.frames)
    elif len(video.frames) == len(take.cameras):
        clips = [video.frames[i] for i in cameras]
    else:
        raise ValueError(
            f"video {name} has {len(video.frames)} cameras, take {take.name} {len(take.cameras)} of which "
            f"{len(cameras)} are to be evaluated; render those cameras"
        )
    if abs(video.fps / take.fps - 1) > 0.01:
        raise ValueError(
            f"video {name} has {video.fps:g} frames per second, take {take.name} {take.fps:g}; "
            "set simulate.fps to the take's"
        )
    return clips


def shrink(reference: Tensor, clips: dict[str, list[Tensor]], index: int, count: int) -> Tensor:
    """The reference at the size of the clips, averaged over pixels; ValueError if their shapes disagree."""
    sizes = {tuple(row[index].shape[1:3]) for row in clips.values()}
    (h, w), own = next(iter(sizes)), tuple(reference.shape[1:3])
    if len(sizes) > 1 or h > own[0] or w > own[1] or abs(h * own[1] / (w * own[0]) - 1) > 0.02:
        raise ValueError(
            f"videos of {[f'{w} x {h}' for h, w in sizes]} px cannot be compared with a reference of {own[1]} x "
            f"{own[0]} px; render all at one scale <= 1 with the reference's camera"
        )
    return reduced(reference[:count], h, w)
