"""Videos: uint8 frames [t, h, w, 3], written and read as mp4 by the ffmpeg that imageio-ffmpeg brings.

ffmpeg is called here, not through imageio, which looks at neither its exit status nor its messages: a full disk would
leave half a video that nobody is told of.
"""

import shutil
import subprocess
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


def ffmpeg() -> str:
    """Path of the ffmpeg program. Raises RuntimeError with the remedy if there is none."""
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
        found = shutil.which(program)
        if found is None:
            raise RuntimeError(f"{program} is no program")
        return found
    except (ImportError, RuntimeError) as error:
        raise RuntimeError(
            f"no ffmpeg found ({' '.join(str(error).split())}); run `make setup` (imageio-ffmpeg brings one) or set "
            "IMAGEIO_FFMPEG_EXE to yours"
        ) from error


def run_ffmpeg(arguments: list[str], frames: bytes = b"", folder: Path | None = None) -> bytes:
    """Call ffmpeg in `folder` with `frames` as its input -> its output. Raises RuntimeError with what it says."""
    command = [ffmpeg(), "-hide_banner", "-loglevel", "error", *arguments]
    done = subprocess.run(command, input=frames, capture_output=True, cwd=folder)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["it said nothing"]
        full = next((line for line in lines if "No space left" in line), lines[-1])
        raise RuntimeError(f"ffmpeg failed with status {done.returncode}: {full.strip()}")
    return done.stdout


def write_mp4(path: Path, frames: UInt8[Tensor, "t h w 3"], fps: float) -> None:
    """Encode frames as H.264; odd sizes lose their last row or column, because yuv420p has none.

    Raises ValueError for frames that make no video, RuntimeError if ffmpeg fails; then no file is left.
    """
    t, h, w = frames.shape[:3]
    h, w = h // 2 * 2, w // 2 * 2
    if not (t and h and w and 0 < fps < float("inf")):
        raise ValueError(
            f"{path.name}: {t} frames of {frames.shape[2]} x {frames.shape[1]} px at {fps:g} per second make no video; "
            "at least 1 frame, 2 x 2 px and a positive rate are needed (a larger render.scale?)"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    target = str(path.absolute())  # no name is then an option or a protocol of ffmpeg
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{w}x{h}", "-r", f"{fps:.9g}", "-i", "-"]
    coding = ["-an", "-c:v", "libx264", "-crf", "10", "-pix_fmt", "yuv420p", "-y", target]
    try:
        run_ffmpeg([*source, *coding], np.ascontiguousarray(np.asarray(frames)[:, :h, :w]).tobytes())
        # some versions end with status 0 although the last blocks did not fit on the disk: count what arrived
        told = run_ffmpeg(["-i", target, "-map", "0:v:0", "-c", "copy", "-f", "framecrc", "-"])
        packets = sum(not line.startswith(b"#") for line in told.splitlines())
        if packets != t:
            raise RuntimeError(f"{path} holds {packets} of {t} frames; is the disk full?")
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def read_mp4(path: Path) -> tuple[UInt8[Tensor, "t h w 3"], float]:
    """Decode a video, turned as it says -> (frames, fps). Raises ValueError naming the file if it cannot be read to its
    end.

    Frames are evenly spaced in time: those of a variable rate (telephones, browsers) are taken at their mean rate.
    """
    if not path.is_file():
        raise ValueError(f"no video at {path}; check the path in the scene's configuration")
    import imageio_ffmpeg

    ffmpeg()
    target = str(path.absolute())
    try:
        opened = imageio_ffmpeg.read_frames(target)
        told = next(opened)
        opened.close()
        w, h = told["size"]
        count, seconds = imageio_ffmpeg.count_frames_and_secs(target)
        even = abs(told["fps"] * seconds - count) <= max(2, 0.05 * count)
        fps = float(told["fps"]) if even else round(count / seconds, 3)
        rate = ["-fps_mode", "passthrough"] if even else ["-vf", f"fps={fps}"]
        decoded = run_ffmpeg(["-xerror", "-i", target, "-f", "rawvideo", "-pix_fmt", "rgb24", *rate, "-"])
        array = np.frombuffer(bytearray(decoded), np.uint8).reshape(-1, h, w, 3)
        if not len(array):
            raise ValueError("it holds no frames")
    except (OSError, RuntimeError, ValueError, StopIteration) as error:
        why = (str(error).strip().splitlines() or [type(error).__name__])[-1]  # ffmpeg says first who it is
        raise ValueError(f"cannot read the video {path}: {' '.join(why.split())[:200]}") from error
    return torch.from_numpy(array), fps


def reduced(frames: UInt8[Tensor, "t h w 3"], height: int, width: int) -> UInt8[Tensor, "t height width 3"]:
    """Frames with fewer pixels, each the mean of what it covers."""
    if tuple(frames.shape[1:3]) == (height, width):
        return frames.contiguous()
    parts = [
        torch.nn.functional.interpolate(part.permute(0, 3, 1, 2).float(), (height, width), mode="area")
        for part in frames.split(16)
    ]
    return (torch.cat(parts).permute(0, 2, 3, 1) + 0.5).to(torch.uint8).contiguous()
