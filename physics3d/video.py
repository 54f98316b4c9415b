"""Videos: uint8 frames [t, h, w, 3], written and read as mp4 by the ffmpeg that imageio-ffmpeg brings."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from physics3d.artifact import AbstractArtifact


@dataclass(frozen=True, kw_only=True)
class Video(AbstractArtifact):
    """Frames of one or more cameras at the same instants."""

    frames: tuple[UInt8[Tensor, "t h w 3"], ...]  # one tensor per camera, sRGB
    fps: float  # frames per second [1/s]
    names: tuple[str, ...]  # one per camera

    def check(self) -> None:
        if not self.frames or len(self.frames) != len(self.names):
            raise ValueError(
                f"Video.frames has {len(self.frames)} cameras, names {len(self.names)}; both must be equal and > 0"
            )
        if any(f.dtype != torch.uint8 or f.ndim != 4 or f.shape[-1] != 3 or f.shape[0] == 0 for f in self.frames):
            raise ValueError("Video.frames must be non-empty uint8 tensors [t, h, w, 3]")
        if not self.fps > 0:
            raise ValueError(f"Video.fps is {self.fps}; it must be positive")


def to_uint8(image: Tensor) -> Tensor:
    """Float colour in 0..1 -> uint8, rounding to nearest."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu()


def ffmpeg() -> str:
    """Path of the ffmpeg program. Raises RuntimeError with the remedy if there is none."""
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise RuntimeError(
            "no ffmpeg found: run `make setup` (imageio-ffmpeg brings one) or set IMAGEIO_FFMPEG_EXE to yours"
        ) from error


def write_mp4(path: Path, frames: UInt8[Tensor, "t h w 3"], fps: float) -> None:
    """Encode frames as H.264; odd sizes lose their last row or column, because yuv420p has none."""
    import imageio.v2 as imageio

    ffmpeg()
    array = np.asarray(frames)
    h, w = (array.shape[1] // 2) * 2, (array.shape[2] // 2) * 2
    path.parent.mkdir(parents=True, exist_ok=True)
    with imageio.get_writer(
        path, fps=fps, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
    ) as out:
        for frame in array[:, :h, :w]:
            out.append_data(frame)  # type: ignore[attr-defined]


def read_mp4(path: Path) -> tuple[UInt8[Tensor, "t h w 3"], float]:
    """Decode a video -> (frames, fps). Raises ValueError naming the file if it cannot be read."""
    import imageio.v2 as imageio

    ffmpeg()
    if not path.is_file():
        raise ValueError(f"no video at {path}; check the path in the scene's configuration")
    try:
        with imageio.get_reader(path) as reader:
            fps = float(reader.get_meta_data()["fps"])  # type: ignore[attr-defined]
            frames = np.stack([np.asarray(frame) for frame in reader])  # type: ignore[attr-defined]
    except Exception as error:
        raise ValueError(f"cannot read the video {path}: {error}") from error
    return torch.from_numpy(frames), fps


def reduced(frames: UInt8[Tensor, "t h w 3"], height: int, width: int) -> UInt8[Tensor, "t height width 3"]:
    """Frames with fewer pixels, each the mean of what it covers."""
    if tuple(frames.shape[1:3]) == (height, width):
        return frames.contiguous()
    parts = [
        torch.nn.functional.interpolate(part.permute(0, 3, 1, 2).float(), (height, width), mode="area")
        for part in frames.split(16)
    ]
    return (torch.cat(parts).permute(0, 2, 3, 1) + 0.5).to(torch.uint8).contiguous()


def contact_sheet(frames: UInt8[Tensor, "t h w 3"], *, columns: int = 6, count: int = 12) -> UInt8[Tensor, "H W 3"]:
    """`count` frames evenly spaced in time, laid out in a grid: a video one can look at as a picture."""
    count = min(count, len(frames))
    columns = min(columns, count)
    picks = frames[torch.linspace(0, len(frames) - 1, count).round().long()]
    rows = -(-count // columns)
    t, h, w, _ = picks.shape
    sheet = torch.full((rows * columns, h, w, 3), 255, dtype=torch.uint8)
    sheet[:t] = picks
    return sheet.reshape(rows, columns, h, w, 3).permute(0, 2, 1, 3, 4).reshape(rows * h, columns * w, 3)


def space_time_slice(frames: UInt8[Tensor, "t h w 3"], *, row: int | None = None, column: int | None = None) -> Tensor:
    """One line of pixels over time: uint8 [h, t, 3] for a column, [t, w, 3] for a row. Shows motion as a curve."""
    if (row is None) == (column is None):
        raise ValueError("space_time_slice needs exactly one of row and column")
    return frames[:, row] if row is not None else frames[:, :, column].transpose(0, 1)
