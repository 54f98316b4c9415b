"""Takes from files: clips of a thing that moves, filmed by a camera on a stand, by someone who did not write down what
pushed it, when, or where the camera stood.

What such a clip says by itself is read and checked here, in seconds. What it does not say stays open: the camera, until
it is registered with the photographs (`FilmedTake.seen_by`), and the excitation, which is None: from the frame of the
release the motion is free, and learning finds the state it starts from.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, UInt8
from torch import Tensor

from physics3d.checks import Ascending, Unit
from physics3d.gaussians.cameras import Camera
from physics3d.motion.clip import SIDE, read_clip
from physics3d.motion.decay import Decay
from physics3d.motion.usable import check_clip
from physics3d.scenes.base import Take
from physics3d.scenes.unposed import VIDEOS
from physics3d.video import reduced

Second = Annotated[float, Ge(0), Le(100_000), Unit("s")]
Pieces = Mapping[str, Annotated[tuple[Second, Second], Ascending()]]  # name of a clip -> from when to when it is used
FRAMES = 240  # that are used of a clip: eight seconds of a telephone, in 4 GB
ALIKE = 0.7  # correlation of two pictures of one view; measured: 0.94 or more, other things 0.35 or less
COARSE = 48  # longer side of the pictures that are compared [px]
FLAT = 2.0  # standard deviation of a picture that tells nothing [grey levels]


@dataclass(frozen=True, kw_only=True)
class FilmedTake:
    """A take whose camera is to be found."""

    name: str
    role: str  # "learn" or "evaluate"
    fps: float  # [1/s]
    video: UInt8[Tensor, "t h w 3"]
    where: Bool[np.ndarray, "h w"]  # what moves
    release: int  # first frame from which the motion is a free decay
    rest: int  # the frame nearest to rest
    decay: Decay  # frequencies and dampings, of what moves, at first sight

    def seen_by(self, camera: Camera) -> Take:
        """The take of a camera that is now known. Raises ValueError if its pictures have another size."""
        h, w = self.video.shape[1:3]
        if (camera.height, camera.width) != (h, w):
            raise ValueError(
                f"take {self.name} has frames of {w} x {h} px, the camera {camera.width} x {camera.height}; scale it"
            )
        return Take(
            name=self.name,
            role=self.role,
            fps=self.fps,
            cameras=(camera,),
            videos=(self.video,),
            excitation=None,
            release=self.release,
            posed=self.rest,
            at_rest=True,
        )


def require_same_view(take: FilmedTake, photograph: UInt8[Tensor, "H W 3"], *, clip: str, key: str) -> None:
    """Raises ValueError, naming the clip and the `key` that chooses the photograph, unless the frame of rest shows, in
    its middle, what the photograph shows: by the correlation of their greys, whatever exposure and contrast are."""
    h, w = take.video.shape[1:3]
    H, W = photograph.shape[:2]
    s = min(w / W, h / H)
    across, down = round(s * W), round(s * H)
    top, left = (h - down) // 2, (w - across) // 2
    frame = take.video[take.rest, top : top + down, left : left + across]
    size = tuple(max(1, round(COARSE * side / max(down, across))) for side in (down, across))
    a, b = (reduced(picture[None], *size).double().mean(-1).ravel() for picture in (frame, photograph))
    a, b = a - a.mean(), b - b.mean()
    if min(float(a.std()), float(b.std())) < FLAT:
        return
    alike = float(a @ b / (a.norm() * b.norm()))
    if alike < ALIKE:
        raise ValueError(
            f"{clip}: it does not show what the photograph of {key} shows (their correlation is {alike:.2f}, of one "
            f"view {ALIKE:g} or more); make the clip from the picture of `make still`, or name its photograph by {key}"
        )


def clip_files(path: Path, pattern: str = "*") -> list[Path]:
    """The clip itself, or the clips of a folder whose names fit, in their order. Raises ValueError if there is none."""
    if path.is_dir():
        clips = (p for p in path.iterdir() if p.suffix.lower() in VIDEOS and p.is_file() and p.name[0] != ".")
        found = sorted(p for p in clips if fnmatchcase(p.name, pattern))
        if not found:
            named = "" if pattern == "*" else f" {pattern}"
            raise ValueError(f"{path} holds no clip{named} ({', '.join(VIDEOS)}); put one there")
        alike = [p.name for p in found if [q.stem for q in found].count(p.stem) > 1]
        if alike:
            raise ValueError(f"{path} holds {' and '.join(alike)}, whose takes would have one name; rename all but one")
        return found
    if not path.is_file():
        raise ValueError(f"no clip at {path}; check the path")
    return [path]


def filmed_takes(
    path: Path,
    *,
    log,
    pattern: str = "*",
    fps: float | None = None,
    pieces: Pieces = MappingProxyType({}),
    longest_side: int = SIDE,
    box: tuple[float, float, float, float] | None = None,
) -> list[FilmedTake]:
    """A clip, or a folder of clips of one thing: the first is learned from, the others are predicted. Of those that
    `pieces` names, without their endings, a part is used.

    Raises ValueError in one line, before anything costs minutes, for a clip that cannot be read or used (see
    `motion/clip.py` and `motion/usable.py`), and RuntimeError where there is no ffmpeg.
    """
    takes, files = [], clip_files(path, pattern)
    unknown = sorted(set(pieces) - {file.stem for file in files})
    if unknown:
        names = ", ".join(file.stem for file in files)
        raise ValueError(f"source.pieces names {unknown[0]}, which is none of the clips; take {names}")
    for number, file in enumerate(files):
        clip = read_clip(file, fps=fps, piece=pieces.get(file.stem), longest_side=longest_side, most=FRAMES)
        for note in clip.notes:
            log.info(f"{file.name}: {note}")
        found = check_clip(clip, box=box)
        log.info(f"{file.name}: {len(clip.frames)} frames at {clip.fps:g} fps; {found.said()}")
        for doubt in found.doubts:
            log.warn(f"{file.name}: {doubt}")
        takes.append(
            FilmedTake(
                name=file.stem,
                role="evaluate" if number else "learn",
                fps=clip.fps,
                video=clip.frames,
                where=found.where,
                release=found.release,
                rest=found.rest,
                decay=found.decay,
            )
        )
    return takes
