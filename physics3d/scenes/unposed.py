"""Your own photographs of a thing, or a video around it, without cameras: structure from motion finds them.

Metres, z up. What no photograph can tell is guessed, said, and can be corrected: the size of things (`camera_distance`)
and which way is up (`up`, in the axes of the first run).
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from physics3d.checks import Colour, Direction, Every, Length, Pixels, Seed, Text, require_fields
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.sfm import Solved, solve

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")


@dataclass(frozen=True, kw_only=True)
class UnposedSource(AbstractSource):
    name: Text
    path: Text  # folder of photographs, or a video file
    camera_distance: Length  # of the cameras from what they look at, in the middle [m]; sets the size of everything
    # taken from a video: the sharpest of each of so many stretches; a folder is used whole
    frames: Annotated[int, Ge(3), Le(100_000)] = 60
    longest_side: Annotated[Pixels, Ge(64)] = 1200  # photographs are reduced to this [px]
    up: Direction = (0.0, 0.0, 1.0)  # correction: what is up, in the axes that were guessed
    held_out_every: Every = 8  # every so many images are kept for evaluation; 0: none
    background: Colour = (1.0, 1.0, 1.0)
    single_object: bool = False  # one object on a plain background: nothing to segment
    seed: Seed = 0

    def files(self) -> tuple[str, ...]:
        path = Path(self.path)
        return (str(path),) if path.suffix.lower() in VIDEOS else tuple(str(p) for p in _photographs(path))

    def __call__(self, *, log) -> Capture:
        """Raises ValueError for settings out of range, no or too few photographs, or when they cannot be placed."""
        self.check()
        path = Path(self.path)
        video = path.suffix.lower() in VIDEOS
        with tempfile.TemporaryDirectory(prefix="physics3d_") as work:
            images = Path(work) / "images"
            images.mkdir()
            if video:
                _frames(path, images, self.frames, self.longest_side, log)
            else:
                _copies(_photographs(path), images, self.longest_side, log)
            solved = solve(
                images, Path(work), ordered=video, camera_distance=self.camera_distance, seed=self.seed, log=log
            )
            self._report(solved, log)
            capture = ColmapSource(
                name=self.name,
                path=str(solved.folder),
                up=self.up,
                scale=1.0,
                held_out_every=self.held_out_every,
                background=self.background,
                single_object=self.single_object,
            )(log=log)
        said = f"scale and up are guesses: cameras {self.camera_distance:g} m away"
        return replace(capture, note=f"{len(solved.placed)} photographs placed by structure from motion; {said}")

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "source")

    def _report(self, solved: Solved, log) -> None:
        total = len(solved.placed) + len(solved.lost)
        log.info(f"{len(solved.placed)} of {total} photographs placed, reprojection error {solved.error:.2f} px")
        log.metric("photographs_placed", len(solved.placed))
        log.metric("reprojection_error_px", solved.error)
        if solved.lost:
            log.warn(f"not placed, left out: {', '.join(solved.lost[:12])}{', ...' if len(solved.lost) > 12 else ''}")
        log.info(
            "assumed: up is the normal of the largest level plane, which is the floor at z = 0"
            if solved.floor
            else "assumed: the cameras were held upright on average; no floor was found, z = 0 is what they look at"
        )
        log.info(
            f"assumed: the cameras are {self.camera_distance:g} m from what they look at; multiply camera_distance by "
            "(true length / length in the model) if sizes are wrong"
        )


def _photographs(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ValueError(
            f"no folder of photographs and no video ({', '.join(VIDEOS)}) at {folder}; "
            "give it: make run SCENE=photos DATA=<folder or video>"
        )
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in PHOTOGRAPHS)
    if not found:
        raise ValueError(f"{folder} holds no photographs ({', '.join(PHOTOGRAPHS)}); convert HEIC to JPEG first")
    return found


def _copies(photographs: list[Path], target: Path, longest_side: int, log) -> None:
    """Turned upright as their EXIF says, reduced, as JPEG that keeps the EXIF focal length."""
    from PIL import Image, ImageOps

    for path in log.progress(photographs, "reading photographs"):
        try:
            with Image.open(path) as file:
                picture = ImageOps.exif_transpose(file).convert("RGB")
        except Exception as error:  # PIL raises OSError, SyntaxError, zlib.error, DecompressionBombError ...
            raise ValueError(f"cannot read the image {path}: {error}; the file is broken, replace it") from error
        picture.thumbnail((longest_side, longest_side), Image.Resampling.LANCZOS)
        copy = target / f"{path.stem}.jpg"
        if copy.exists():
            raise ValueError(f"two photographs of {path.parent} are called {path.stem}; rename one")
        picture.save(copy, quality=97, exif=picture.getexif())


def _frames(video: Path, target: Path, count: int, longest_side: int, log) -> None:
    """The sharpest frame (variance of the Laplacian) of each of `count` equal stretches."""
    import cv2

    if not video.is_file():
        raise ValueError(f"no video at {video}; give it: make run SCENE=photos DATA=<folder or video>")
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    best: dict[int, float] = {}
    for i in log.progress(range(total), "choosing frames"):
        good, frame = reader.read()
        if not good:
            break
        factor = longest_side / max(frame.shape[:2])
        if factor < 1:
            frame = cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        stretch = i * min(count, total) // total
        sharp = float(np.var(cv2.Laplacian(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), cv2.CV_32F)))
        if sharp > best.get(stretch, -1.0):
            best[stretch] = sharp
            cv2.imwrite(str(target / f"frame_{stretch:04d}.jpg"), frame, [cv2.IMWRITE_JPEG_QUALITY, 97])
    reader.release()
    if not best:
        raise ValueError(f"cannot read a frame of {video}; convert it to MP4 (H.264), or extract photographs")
