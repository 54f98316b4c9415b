"""Pictures that stand still: what every prediction of a motion has to beat. The first half of a clip is seen.

frame 0             what was said to be rest before anyone looked; a straw man where the thing starts aside
last frame seen     the honest one
mean                of the first half: a blur that squared errors like
"""

import torch
from jaxtyping import UInt8
from torch import Tensor

FIRST, LAST, MEAN = "frame 0, frozen", "last frame seen, frozen", "mean of the first half"


def stills(video: UInt8[Tensor, "t h w 3"], *, seen: int) -> dict[str, UInt8[Tensor, "n h w 3"]]:
    """Name -> clip of the frames from `seen` on, all of them views of one picture. Raises ValueError unless
    0 < seen < t."""
    if not 0 < seen < len(video):
        raise ValueError(f"seen is {seen} of {len(video)} frames; leave some to be predicted, e.g. {len(video) // 2}")
    mean = torch.zeros(video.shape[1:], dtype=torch.float64)
    for frame in video[:seen]:
        mean += frame
    pictures = {FIRST: video[0], LAST: video[seen - 1], MEAN: (mean / seen + 0.5).to(torch.uint8)}
    count = len(video) - seen
    return {name: picture.expand(count, *picture.shape) for name, picture in pictures.items()}
