"""A clip as a person has it: whatever ffmpeg decodes (H.264, HEVC, ...), upright, at a constant rate, reduced.

What the file says and what was assumed is kept in words. Times of the frames come from the container: the rate is
their number over their span, and a clip with a variable rate (phones drop frames in the dark) is resampled to it by
ffmpeg. Rotation in the metadata is applied by ffmpeg. High dynamic range (PQ, HLG) is read as if it were sRGB, and
said.
"""

import re
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from physics3d.video import ffmpeg

SIDE = 640  # longest side that is kept unless told otherwise [px]
UNEVEN = 0.02  # of the mean distance of frames: more is a variable rate
LARGEST = 2_000_000_000  # bytes of decoded frames
BARE = ("h264", "hevc", "m4v", "mpegvideo", "obu", "vc1", "cavsvideo")  # streams whose frames have no times


@dataclass(frozen=True, kw_only=True)
class Clip:
    path: Path
    frames: UInt8[Tensor, "t h w 3"]
    fps: float  # frames per second [1/s]
    size: tuple[int, int]  # (width, height) of the file, upright [px]
    notes: tuple[str, ...] = ()  # what was assumed or changed, one sentence each


def read_clip(
    path: Path,
    *,
    fps: float | None = None,
    longest_side: int | None = SIDE,
    start: float = 0.0,
    stop: float | None = None,
) -> Clip:
    """Frames between `start` and `stop` [s], no side longer than `longest_side` px, at `fps` (None: as filmed).

    Raises ValueError in one line: no such file, unreadable, damaged, no video in it, fewer than two frames, rate
    unknown, too large to hold; RuntimeError if there is no ffmpeg.
    """
    program = ffmpeg()
    if not path.is_file():
        raise ValueError(f"no clip at {path}; check the path")
    if fps is not None and not 0 < fps < 1000:
        raise ValueError(f"fps is {fps:g}; give frames per second above 0, or leave it out")
    path = path.absolute()  # no name is then an option or a protocol of ffmpeg
    header, times = _header(program, path), _times(program, path)
    notes = _cut_short(header, times)
    container = re.search(r"Input #0, ([^,]+)", header)
    if container is not None and container[1] in BARE:
        times = times[:0]
    rate = fps
    if rate is None:
        if len(times) < 2:
            if len(_decoded(program, ["-i", str(path)], [], path)) < 2:
                raise ValueError(f"{path.name}: 1 frame; that is a picture, a motion needs a clip")
            raise ValueError(f"{path.name}: the rate is unknown, its frames have no times; say it: fps=30")
        rate = (len(times) - 1) / (times[-1] - times[0])
        rate = round(rate) if abs(rate - round(rate)) < 0.01 else rate
        gaps = np.diff(times)
        if np.abs(gaps - gaps.mean()).max() > UNEVEN * gaps.mean() + 1.1e-3:  # some containers count in ms
            slow, fast = 1 / gaps.max(), 1 / max(gaps.min(), 1e-6)
            notes.append(f"variable frame rate ({slow:.3g} to {fast:.3g} 1/s), read at {rate:.4g} 1/s")
    turned = re.search(r"rotation of (-?\d+(?:\.\d+)?) degrees", header)
    if turned and float(turned[1]):
        notes.append(f"turned by {float(turned[1]):g} degrees, as its metadata asks")
    if re.search(r"arib-std-b67|smpte2084", header):
        notes.append("high dynamic range, read as if it were sRGB: colours are pale, motion is not touched")
    filters = [f"fps={rate:.6f}"]
    if longest_side is not None:
        factor = f"min(1\\,{longest_side}/max(iw\\,ih))"
        filters.append(f"scale=w='trunc(iw*{factor}+0.5)':h='trunc(ih*{factor}+0.5)':flags=area")
    cut = ["-ss", f"{start:g}"] if start else []
    cut += ["-to", f"{stop:g}"] if stop is not None else []
    frames = _decoded(program, [*cut, "-i", str(path)], filters, path)
    if len(frames) < 2:
        raise ValueError(f"{path.name}: {len(frames)} frame; that is a picture, a motion needs a clip")
    w, h = _size(header, frames)
    if (h, w) != frames.shape[1:3]:
        notes.append(f"reduced from {w} x {h} to {frames.shape[2]} x {frames.shape[1]} px")
    return Clip(path=path, frames=frames, fps=float(rate), size=(w, h), notes=tuple(notes))


def _header(program: str, path: Path) -> str:
    """What ffmpeg says of the file. Raises ValueError if it is none that it can read."""
    told = _run([program, "-hide_banner", "-nostdin", "-i", str(path)]).stderr
    if "Video:" not in told:
        lines = [line.strip() for line in told.splitlines() if line.strip() and "At least one output" not in line]
        what = "there is no video in it" if "Stream #" in told else lines[-1] if lines else "no reason given"
        raise ValueError(f"cannot read the clip {path.name}: {what}; give a file that a player shows")
    return told


def _cut_short(header: str, times: np.ndarray) -> list[str]:
    """A note where the file says that it lasts longer than its frames do: some containers are read up to their cut."""
    said = re.search(r"Duration: (\d+):(\d+):(\d+(?:\.\d+)?)", header)
    if said is None or len(times) < 2:
        return []
    hours, minutes, seconds = (float(part) for part in said.groups())
    whole, there = 3600 * hours + 60 * minutes + seconds, (times[-1] - times[0]) * len(times) / (len(times) - 1)
    if there > 0.8 * whole:
        return []
    return [f"{there:.2f} s of frames, where the file says that it lasts {whole:.2f} s: it may be cut short"]


def _times(program: str, path: Path) -> np.ndarray:
    """Times of the frames in order [s], from the packets: nothing is decoded."""
    command = ["-v", "error", "-nostdin", "-i", str(path), "-map", "0:v:0", "-c", "copy", "-f", "framecrc", "-"]
    listed = _run([program, *command]).stdout
    base = re.search(r"#tb 0: (\d+)/(\d+)", listed)
    stamps = re.findall(r"^0,\s*\S+,\s*(-?\d+),", listed, re.MULTILINE)
    if base is None:
        return np.zeros(0)
    return np.unique([int(s) for s in stamps]) * int(base[1]) / int(base[2])


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, errors="replace")


def _decoded(program: str, source: list[str], filters: list[str], path: Path) -> Tensor:
    """Frames as ffmpeg hands them on: PPM pictures, each of which knows its size."""
    command = [program, "-v", "error", "-xerror", "-nostdin", *source, "-map", "0:v:0"]
    command += ["-vf", ",".join(filters)] if filters else []
    command += ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]
    frames, total = [], 0
    with tempfile.TemporaryFile() as said, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said) as process:
        assert process.stdout is not None
        while process.stdout.readline().strip() == b"P6":
            w, h = (int(n) for n in process.stdout.readline().split())
            process.stdout.readline()
            total += w * h * 3
            if total > LARGEST:
                process.kill()
                raise ValueError(f"{path.name}: more than {LARGEST / 1e9:g} GB of frames; cut the clip, or reduce it")
            data = process.stdout.read(w * h * 3)
            if len(data) == w * h * 3:
                frames.append(np.frombuffer(data, np.uint8).reshape(h, w, 3))
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    if frames and process.returncode:
        why = re.sub(r"\[\S+ @ \w+\] ", "", lines[0]) if lines else f"ffmpeg ended with status {process.returncode}"
        raise ValueError(
            f"{path.name} is damaged after {len(frames)} frames ({why}); copy it again, or cut a whole piece out of it"
        )
    if not frames:
        why = lines[-1] if lines else "no frame in it"
        raise ValueError(f"cannot read the clip {path.name}: {why}; give a file that a player shows")
    return torch.from_numpy(np.stack(frames))


def _size(header: str, frames: Tensor) -> tuple[int, int]:
    """(width, height) of the file, turned as the frames are."""
    found = re.search(r"Video:.*?\b(\d{2,5})x(\d{2,5})\b", header)
    h, w = frames.shape[1:3]
    if found is None:
        return w, h
    a, b = int(found[1]), int(found[2])
    return (b, a) if (a > b) != (w > h) and w != h else (a, b)
