"""A clip as a person has it: whatever ffmpeg decodes (H.264, HEVC, ...), upright, at a constant rate, reduced.

What the file says and what was assumed is kept in words. Times of the frames come from the container: the rate is
their number over their span, and a clip with a variable rate (phones drop frames in the dark) is resampled to it by
ffmpeg. Rotation in the metadata is applied by ffmpeg, pixels that are not square are made so, and of frames whose lines
are of two instants (interlaced) the first is kept. High dynamic range (PQ, HLG) is read as if it were sRGB, and
transparency is left out; both are said.

What a clip of very many frames would cost, in memory and time, is bounded where the caller gives the `most` frames that
he can use: of a fast camera every so many-th frame is taken, as long as SLOWEST are left in a second, and then the
first ones.

A clip may have been filmed at another rate than its file says: slow motion of 240 frames per second is played, and
often stored, at 30. Nothing in the file tells; whoever knows gives `fps`.
"""

import math
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
SLOWEST = 25.0  # frames per second that a bound leaves: three and more of a swing of 8 Hz
LARGEST = 2_000_000_000  # bytes of decoded frames
# streams whose frames have no times
BARE = ("h264", "hevc", "vvc", "m4v", "mpegvideo", "mjpeg", "obu", "vc1", "cavsvideo", "h261", "h263", "dirac")


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
    piece: tuple[float, float] | None = None,
    most: int | None = None,
    first: int = 0,
    count: int | None = None,
) -> Clip:
    """`count` frames from the `first` on (None: all), no side longer than `longest_side` px.

    fps    the rate at which it was filmed [1/s]; None: what the times of its frames say
    piece  from when to when it is used, as a player shows the time [s]; None: all of it
    most   frames that are used of that piece, of which `first` and `count` choose; None: all

    Raises ValueError in one line: no such file, unreadable, damaged, no video in it, fewer than two frames, rate
    unknown, nothing in the piece, too large to hold; RuntimeError if there is no ffmpeg.
    """
    program = ffmpeg()
    if not path.is_file():
        raise ValueError(f"no clip at {path}; check the path")
    if fps is not None and not 0 < fps <= 100_000:
        raise ValueError(f"fps is {fps:g}; give frames per second above 0, or leave it out")
    path = path.absolute()  # no name is then an option or a protocol of ffmpeg
    header, times = _header(program, path), _times(program, path)
    notes = _cut_short(header, times)
    source, stored, uneven = ["-i", str(path)], fps, ""
    container = re.search(r"Input #0, ([^,]+)", header)
    if (container is not None and container[1] in BARE) or len(times) < 2:
        if fps is None and len(_decoded(program, source, [], path)) < 2:
            raise ValueError(f"{path.name}: 1 frame; that is a picture, a motion needs a clip")
        if fps is None:
            raise ValueError(
                f"{path.name}: the rate is unknown, its frames have no times; say it, scene.source.fps=30, or make "
                "an mp4 of it that has them"
            )
        source = ["-r", f"{fps:.6f}", *source]
    else:
        stored, uneven = _rate(times)
        notes += [uneven] if uneven else []
        if fps is not None and abs(fps / stored - 1) > UNEVEN:
            notes.append(f"its file says {stored:.4g} frames per second; filmed at {fps:g}, as fps says")
    assert stored is not None
    interlaced = re.search(r"Video:.*(top|bottom) (coded )?first", header) is not None
    notes += _colours(header) + ["interlaced: one frame is made of each two fields"] * interlaced
    filters = ["bwdif=mode=send_frame:deint=interlaced"] if interlaced else []
    filters.append(f"fps={stored:.6f}")
    filmed, frame_count = stored if fps is None else fps, len(times)
    if piece is not None:
        frame_count = _within(piece, times, path)
        filters.append(f"trim=start={piece[0]:.6f}:end={piece[1]:.6f}")
    every, last, bounded = _bounded(filmed, frame_count, most)
    notes += bounded
    last = last if count is None else min(last or first + count, first + count)
    filters += [f"framestep={every}"] * (every > 1)
    if first or last is not None:
        filters.append(f"trim=start_frame={first}" + (f":end_frame={last}" if last is not None else ""))
    filters.append(_scaling(longest_side))
    frames = _decoded(program, source, filters, path)
    if len(frames) < 2:
        raise ValueError(f"{path.name}: {len(frames)} frame; that is a picture, a motion needs a clip")
    w, h = _size(header, frames)
    shape = re.search(r"SAR (\d+):(\d+)", header)
    if shape is not None and shape[1] != shape[2]:
        notes.append(f"its pixels are {shape[1]}:{shape[2]}, made square")
    if (h, w) != frames.shape[1:3]:
        notes.append(f"reduced from {w} x {h} to {frames.shape[2]} x {frames.shape[1]} px")
    return Clip(path=path, frames=frames, fps=float(filmed / every), size=(w, h), notes=tuple(notes))


def _bounded(fps: float, count: int, most: int | None) -> tuple[int, int | None, list[str]]:
    """(every so many-th frame is used, of those so many first ones or None for all, what there is to say)."""
    if most is None:
        return 1, None, []
    every = max(1, min(math.ceil(count / most), int(fps / SLOWEST)))
    notes = [f"{fps / every:.4g} of its {fps:.4g} frames per second are used, for it has {count}"] if every > 1 else []
    if count > most * every:
        notes.append(
            f"its first {most * every / fps:.3g} s are used, of {count / fps:.3g}; cut it if the motion is later"
        )
    return every, most, notes


def _within(piece: tuple[float, float], times: np.ndarray, path: Path) -> int:
    """How many frames there are in a piece. Raises ValueError for fewer than two, or where frames have no times."""
    if len(times) < 2:
        raise ValueError(f"{path.name}: no piece can be taken of it, its frames have no times; make an mp4 of it")
    since = times - times[0]
    count = int(((since >= piece[0]) & (since < piece[1])).sum())
    if count < 2:
        raise ValueError(
            f"{path.name}: {count} frames from {piece[0]:g} to {piece[1]:g} s; it lasts {since[-1]:.2f} s, name a "
            "piece of that"
        )
    return count


def _rate(times: np.ndarray) -> tuple[float, str]:
    """(frames per second, what there is to say if frames are not evenly spaced)."""
    rate = (len(times) - 1) / (times[-1] - times[0])
    rate = round(rate) if abs(rate - round(rate)) < 0.01 else rate
    gaps = np.diff(times)
    if np.abs(gaps - gaps.mean()).max() <= UNEVEN * gaps.mean() + 1.1e-3:  # some containers count in ms
        return rate, ""
    slow, fast = 1 / gaps.max(), 1 / max(gaps.min(), 1e-6)
    return rate, f"variable frame rate ({slow:.3g} to {fast:.3g} 1/s), read at {rate:.4g} 1/s"


def _colours(header: str) -> list[str]:
    """What is said of turns, of colours and of transparency."""
    notes = []
    turned = re.search(r"rotation of (-?\d+(?:\.\d+)?) degrees", header)
    if turned and float(turned[1]):
        notes.append(f"turned by {float(turned[1]):g} degrees, as its metadata asks")
    if re.search(r"arib-std-b67|smpte2084", header):
        notes.append("high dynamic range, read as if it were sRGB: colours are pale, motion is not touched")
    if re.search(r"Video:.*\b(yuva|gbrap|rgba|argb|bgra|abgr|ya8|ya16)|alpha_mode", header):
        notes.append("it has transparency, which is left out: what lies beneath is seen")
    return notes


def _scaling(longest_side: int | None) -> str:
    """The filter that makes pixels square and sides no longer than that."""
    factor = "1" if longest_side is None else f"min(1\\,{longest_side}/max(iw*sar\\,ih))"
    return f"scale=w='trunc(iw*sar*{factor}+0.5)':h='trunc(ih*{factor}+0.5)':flags=area"


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
    """(width, height) of the file in square pixels, turned as the frames are."""
    found = re.search(r"Video:.*?\b(\d{2,5})x(\d{2,5})\b", header)
    h, w = frames.shape[1:3]
    if found is None:
        return w, h
    shape = re.search(r"SAR (\d+):(\d+)", header)
    a, b = int(found[1]), int(found[2])
    a = a if shape is None else round(a * int(shape[1]) / int(shape[2]))
    return (b, a) if (a > b) != (w > h) and w != h else (a, b)
