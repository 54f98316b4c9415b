"""Your own photographs of a thing, or a video around it, without cameras: structure from motion finds them.

Metres, z up. What no photograph can tell is guessed, said, and can be corrected: the size of things (`camera_distance`)
and which way is up (`up`, in the axes of the first run). `Capture.floor` is 0 where a floor was found, None where not.
"""

import re
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from physics3d.checks import Colour, Direction, Every, Length, Name, Pixels, Seed, Text, require_fields
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.frames import VIDEOS, sharpest_frames
from physics3d.scenes.photographs import triple
from physics3d.scenes.pictures import PHOTOGRAPHS, TURN, UNREAD, photographs_in, read_picture
from physics3d.scenes.sfm import Solved, solve

NARROW = 30.0  # angle around the thing below which it is warned [deg]


@dataclass(frozen=True, kw_only=True)
class UnposedSource(AbstractSource):
    name: Name
    path: Text  # folder of photographs, or a video file
    camera_distance: Length  # of the cameras from what they look at, in the middle [m]; sets the size of everything
    # taken from a video: the sharpest of each of so many stretches; a folder is used whole
    frames: Annotated[int, Ge(3), Le(100_000)] = 60
    longest_side: Annotated[Pixels, Ge(64)] = 1200  # photographs are reduced to this [px]
    up: Direction = (0.0, 0.0, 1.0)  # correction: what is up, in the axes that were guessed
    held_out_every: Every = 8  # every so many images are kept for evaluation; 0: none
    background: Colour = (1.0, 1.0, 1.0)  # put behind photographs with alpha, 0..1
    single_object: bool = False  # one object on a plain background: nothing to segment
    seed: Seed = 0

    def files(self) -> tuple[str, ...]:
        path = Path(self.path)
        return (str(path),) if is_video(path) else tuple(str(p) for p in photographs_below(path))

    def __call__(self, *, log) -> Capture:
        """Raises ValueError for settings out of range, no or too few photographs, or when they cannot be placed."""
        self.check()
        path = Path(self.path)
        with tempfile.TemporaryDirectory(prefix="physics3d_") as work:
            images = Path(work) / "images"
            images.mkdir()
            background = triple("background", self.background)
            called = gather(
                path, images, frames=self.frames, longest_side=self.longest_side, background=background, log=log
            )
            solved = solve(
                images,
                Path(work),
                ordered=is_video(path),
                camera_distance=self.camera_distance,
                seed=self.seed,
                log=log,
            )
            report(solved, self.camera_distance, log)
            capture = ColmapSource(
                name=self.name,
                path=str(solved.folder),
                up=self.up,
                scale=1.0,
                held_out_every=self.held_out_every,
                background=self.background,
                single_object=self.single_object,
            )(log=log)
        names = tuple(called.get(name, name) for name in capture.names)
        floor = floor_of(solved, self.up)
        return replace(capture, names=names, note=told(solved, self.camera_distance, floor), floor=floor)

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "source")


def gather(
    path: Path,
    target: Path,
    *,
    frames: int,
    longest_side: int,
    background: tuple[float, float, float],
    log,
    without: Path | None = None,
) -> dict[str, str]:
    """Copies of a folder's photographs, or the sharpest frames of a video, in `target`, no side longer than told [px].

    Copy -> the user's name of it. Raises ValueError if there is nothing to read.
    """
    if is_video(path):
        sharpest_frames(path, target, frames, longest_side, log)
        return {}
    return _copies(path, target, longest_side, background, log, without=without)


def report(solved: Solved, camera_distance: float, log) -> None:
    """Say what was placed, how well, and what was assumed."""
    total = len(solved.placed) + len(solved.lost)
    log.info(f"{len(solved.placed)} of {total} photographs placed, reprojection error {solved.error:.2f} px")
    log.metric("photographs_placed", len(solved.placed))
    log.metric("reprojection_error_px", solved.error)
    log.metric("camera_span_deg", solved.span)
    if solved.lost:
        lost, first = [PurePath(name).name for name in solved.lost], PurePath(solved.placed[0]).name
        log.warn(f"not placed, left out: {', '.join(lost[:12])}{', ...' if len(lost) > 12 else ''}")
        if min(lost) < first:
            log.warn(f"photograph 0 is {first} now: a prompt in `view: 0` is of that one")
    if solved.span < NARROW:
        log.warn(
            f"the cameras span only {solved.span:.0f} degrees around what they look at: depth is uncertain, and "
            "what is behind was never seen; walk further around it"
        )
    log.info(
        "assumed: up is the normal of the largest level plane, which is the floor at z = 0"
        if solved.floor
        else "assumed: the cameras were held upright on average; no floor was found, z = 0 is what they look at"
    )
    log.info(
        f"assumed: the cameras are {camera_distance:g} m from what they look at; multiply camera_distance by "
        "(true length / length in the model) if sizes are wrong"
    )


def floor_of(solved: Solved, up: Sequence[float]) -> float | None:
    """Height of the floor [m]; None where none was found, or where `up` turned it away."""
    return 0.0 if solved.floor and tuple(up) == (0.0, 0.0, 1.0) else None


def told(solved: Solved, camera_distance: float, floor: float | None) -> str:
    """What is said at the start of every run."""
    said = f"{len(solved.placed)} photographs placed by structure from motion; scale and up are guesses: cameras "
    return said + f"{camera_distance:g} m away; " + ("the floor is z = 0" if floor == 0 else "no floor is known")


def photographs_below(folder: Path, log=None, *, without: Path | None = None) -> list[Path]:
    """The photographs of a folder; where it holds none itself, of its subfolders. What is not read is said.

    Nothing in the subfolder `without` counts. Raises ValueError if there are none.
    """
    if not folder.is_dir():
        raise ValueError(
            f"no folder of photographs and no video ({', '.join(VIDEOS)}) at {folder}; "
            "give it: make run SCENE=photos DATA=<folder or video>"
        )
    shown = [p for p in sorted(folder.rglob("*")) if not _hidden(p.relative_to(folder))]
    if without is not None:
        shown = [p for p in shown if not p.is_relative_to(without)]
    below = [p for p in shown if p.is_dir()]
    found = photographs_in(folder)
    deeper = [p for d in below for p in photographs_in(d)]
    if found and deeper and log is not None:
        log.warn(f"{len(deeper)} photographs in subfolders of {folder} are left out; give the subfolder, or move them")
    found = found or deeper
    taken = set(found) | set(deeper)
    files = [p for p in shown if p.is_file()]
    others = Counter(p.suffix.lower() or "no ending" for p in files if p not in taken)
    unread = {ending: count for ending, count in others.items() if ending in UNREAD}
    if not found:
        there = ", ".join(f"{count} {ending}" for ending, count in sorted(others.items())) or "nothing"
        remedy = "convert HEIC and raw photographs to JPEG first" if unread else "give a folder of JPEG or PNG files"
        if any(ending in VIDEOS for ending in others):
            remedy = "of a video, give the file itself"
        raise ValueError(f"{folder} holds no photographs ({', '.join(PHOTOGRAPHS)}), but {there}; {remedy}")
    if unread and log is not None:
        counts = ", ".join(f"{count} {ending}" for ending, count in unread.items())
        log.warn(f"{counts} beside the {len(found)} photographs cannot be read and are left out; convert them to JPEG")
    return found


def _hidden(path: Path) -> bool:
    """Files and folders that systems leave: ._IMG.jpg, __MACOSX, @eaDir."""
    return any(part.startswith((".", "__MACOSX", "@")) for part in path.parts)


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEOS if not path.exists() else path.is_file()


def _copies(
    folder: Path,
    target: Path,
    longest_side: int,
    background: tuple[float, float, float],
    log,
    *,
    without: Path | None = None,
) -> dict[str, str]:
    """Turned as their EXIF says, reduced, as JPEG that keeps the EXIF focal length; with alpha as PNG.

    Under alpha 0 a copy has the background's colour: structure from motion does not look at alpha, and what an editor
    left there stands for nothing. Returns the names of the copies, which hold no blanks, and of what they are copies.
    """
    from PIL import Image

    called: dict[str, str] = {}
    with_matte, with_none = [], []
    remarks: Counter[str] = Counter()
    for path in log.progress(photographs_below(folder, log, without=without), "reading photographs"):
        picture = read_picture(path).shown()
        remarks.update(picture.remarks)
        matte = picture.alpha
        if matte is None:
            with_none.append(path.name)
        elif matte.min() < 1:
            with_matte.append(path.name)
        name = re.sub(r"\s", "_", "__".join(path.relative_to(folder).with_suffix("").parts))
        name += ".jpg" if matte is None else ".png"
        if name in called:
            raise ValueError(f"two photographs are called nearly the same: {called[name]} and {path.name}; rename one")
        called[name] = path.relative_to(folder).as_posix()
        layers = picture.color if matte is None else np.concatenate([picture.color, 255 * matte[..., None]], -1)
        copy = Image.fromarray((layers + 0.5).astype(np.uint8))
        copy.thumbnail((longest_side, longest_side), Image.Resampling.LANCZOS)
        if matte is not None:
            array = np.array(copy)
            array[array[..., 3] == 0, :3] = np.round(255 * np.asarray(background)).astype(np.uint8)
            copy = Image.fromarray(array)
        copy.save(target / name, quality=97, exif=_without_turn(path))
    if with_matte and with_none:
        raise ValueError(
            f"{with_none[0]} has no alpha channel, but {with_matte[0]} has one that hides something; give all "
            "photographs a matte or none"
        )
    for remark, count in remarks.items():
        log.info(f"{count} of {len(called)} photographs are {remark}")
    return called


def _without_turn(path: Path):
    """The EXIF of a photograph, which holds its focal length, without the turn that its copy no longer needs."""
    from PIL import Image

    try:
        with Image.open(path) as file:
            exif = file.getexif()
    except Exception:  # no format of Pillow's: read by OpenCV
        return Image.Exif()
    exif.pop(TURN, None)
    return exif
