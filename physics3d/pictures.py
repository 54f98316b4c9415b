"""Pictures that a person looks at: colours as bytes, pictures side by side, a video as one picture."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

STRIP = 14  # height of a line of letters [px]


def to_uint8(image: Tensor) -> Tensor:
    """Float colour in 0..1 -> uint8, rounding to nearest."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu()


def contact_sheet(frames: UInt8[Tensor, "t h w 3"], *, columns: int = 6, count: int = 12) -> UInt8[Tensor, "H W 3"]:
    """`count` frames evenly spaced in time, laid out in a grid: a video one can look at as a picture."""
    picks = evenly(frames, count)
    columns = min(columns, len(picks))
    rows = -(-len(picks) // columns)
    t, h, w, _ = picks.shape
    sheet = torch.full((rows * columns, h, w, 3), 255, dtype=torch.uint8)
    sheet[:t] = picks
    return sheet.reshape(rows, columns, h, w, 3).permute(0, 2, 1, 3, 4).reshape(rows * h, columns * w, 3)


def titled(frames: UInt8[Tensor, "t h w 3"], title: str) -> UInt8[Tensor, "t k w 3"]:
    """Each frame below a white strip that says what it is: for videos that stand above or beside each other."""
    from PIL import Image, ImageDraw

    t, _, w, _ = frames.shape
    strip = Image.new("RGB", (w, STRIP), "white")
    ImageDraw.Draw(strip).text((2, 1), title, fill="black")
    letters = torch.from_numpy(np.array(strip)).to(frames.device)
    return torch.cat([letters.expand(t, -1, -1, -1), frames], 1)


def difference(a: UInt8[Tensor, "*t h w 3"], b: UInt8[Tensor, "*t h w 3"]) -> UInt8[Tensor, "*t h w 3"]:
    """How far two pictures are apart: white where they are not, in bytes throughout."""
    return 255 - (torch.maximum(a, b) - torch.minimum(a, b))


def evenly(frames: UInt8[Tensor, "t h w 3"], count: int) -> UInt8[Tensor, "n h w 3"]:
    """So many frames, or as many as there are, evenly spaced in time."""
    return frames[torch.linspace(0, len(frames) - 1, min(count, len(frames))).round().long()]


def space_time_slice(frames: UInt8[Tensor, "t h w 3"], *, row: int | None = None, column: int | None = None) -> Tensor:
    """One line of pixels over time: uint8 [h, t, 3] for a column, [t, w, 3] for a row. Shows motion as a curve."""
    if (row is None) == (column is None):
        raise ValueError("space_time_slice needs exactly one of row and column")
    return frames[:, row] if row is not None else frames[:, :, column].transpose(0, 1)


def tiled(images: Sequence[UInt8[np.ndarray, "h w 3"]], columns: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures in rows, each in the corner of a white cell as large as the largest."""
    height, width = (max(i.shape[k] for i in images) + 4 for k in (0, 1))
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for k, image in enumerate(images):
        v, u = k // columns * height, k % columns * width
        sheet[v : v + image.shape[0], u : u + image.shape[1]] = image
    return sheet
