"""A thing at rest in photographs, and moving in clips from a stand: cameras of both by one structure from motion.

<path>/IMG_0001.jpg ...     photographs around the thing, or one video around it (`unposed.py` reads them)
<path>/clips/poke.mp4 ...   the thing moving; the first is learned from, the others are predicted (`clips.py`)

Of each clip the frame nearest to rest is placed among the photographs: what stands still in it gives the camera, and
what still moves is an outlier. The lens of the clips is their own, for phones film with another part of the sensor than
they photograph with; clips of one size share it. Its distortion is taken out of their frames.

Those frames are not among the images of the capture, neither trained on nor held out: compression, exposure and white
balance of a video are not those of photographs, and the thing is still some pixels from rest in them.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le

from physics3d.checks import Colour, Direction, Every, Length, Name, Pixels, Rate, Seed, Text, require_fields
from physics3d.motion.clip import read_clip
from physics3d.scenes.axes import Axes
from physics3d.scenes.base import AbstractSource, Capture, Take
from physics3d.scenes.clips import FRAMES, FilmedTake, Pieces, clip_files, filmed_takes
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.frames import VIDEOS
from physics3d.scenes.lens import Lens, undistorted
from physics3d.scenes.photographs import triple
from physics3d.scenes.pictures import photographs_in
from physics3d.scenes.posed import Posed, pinhole
from physics3d.scenes.sfm import Fit, solve
from physics3d.scenes.unposed import floor_of, gather, is_video, photographs_below, report, told

CLIPS = "clips"  # the subfolder of what moves


@dataclass(frozen=True, kw_only=True)
class ThingSource(AbstractSource):
    name: Name
    path: Text  # the folder of photographs, or of one video around the thing, with the subfolder clips
    camera_distance: Length  # of the photographs from what they look at, in the middle [m]; sets the size of everything
    fps: Rate | None = None  # at which the clips were filmed [1/s]; None: what their files say
    pieces: Pieces = field(default_factory=dict)  # of clips that are not used whole, by their names without endings [s]
    # taken from a video: the sharpest of each of so many stretches; photographs are used whole
    frames: Annotated[int, Ge(3), Le(100_000)] = 60
    longest_side: Annotated[Pixels, Ge(64)] = 1200  # photographs are reduced to this [px]
    up: Direction = (0.0, 0.0, 1.0)  # correction: what is up, in the axes that were guessed
    held_out_every: Every = 8  # every so many photographs are kept for evaluation; 0: none
    background: Colour = (1.0, 1.0, 1.0)  # put behind photographs with alpha, 0..1
    seed: Seed = 0

    def files(self) -> tuple[str, ...]:
        clips = clip_files(self._clips())
        around = self._around()
        still = [around] if is_video(around) else photographs_below(around, without=self._clips())
        return tuple(str(p) for p in (*still, *clips))

    def __call__(self, *, log) -> Capture:
        """Raises ValueError for settings out of range, nothing to read, a clip that cannot be learned from (before
        anything is matched), photographs or a clip that cannot be placed; RuntimeError where there is no ffmpeg."""
        require_fields(self, "source")
        self.files()  # what is missing is said before clips are read
        around, clips = self._around(), clip_files(self._clips())
        takes = filmed_takes(self._clips(), log=log, fps=self.fps, pieces=self.pieces)
        with tempfile.TemporaryDirectory(prefix="physics3d_") as work:
            images = Path(work) / "images"
            (images / "photographs").mkdir(parents=True)
            (images / CLIPS).mkdir()
            called = gather(
                around,
                images / "photographs",
                frames=self.frames,
                longest_side=self.longest_side,
                background=triple("background", self.background),
                without=self._clips(),
                log=log,
            )
            stills = dict(self._stills(images / CLIPS, clips, takes))
            solved = solve(
                images,
                Path(work),
                ordered=is_video(around),
                camera_distance=self.camera_distance,
                seed=self.seed,
                log=log,
                stills=stills,
            )
            report(solved, self.camera_distance, log)
            model = ColmapSource(name=self.name, path=str(solved.folder), up=self.up, scale=1.0)
            capture = replace(
                model, only="photographs/*", held_out_every=self.held_out_every, background=self.background
            )(log=log)
            placed = {posed.name: posed for posed in replace(model, only=f"{CLIPS}/*").read(log)[0]}
            axes = Axes(up=triple("up", self.up), scale=1.0)
            found = tuple(
                _seen(take, placed[still], axes, solved.stills[still], log, number=number, clip=clip.name)
                for number, (take, still, clip) in enumerate(zip(takes, stills, clips))
            )
        names = (name.removeprefix("photographs/") for name in capture.names)
        floor = floor_of(solved, self.up)
        capture = replace(
            capture,
            names=tuple(called.get(name, name) for name in names),
            takes=found,
            floor=floor,
            note=f"{told(solved, self.camera_distance, floor)}; nobody knows what pushed it in the clips",
        )
        capture.check()
        return capture

    def _clips(self) -> Path:
        """Raises ValueError if there is no folder of clips."""
        folder = Path(self.path)
        if not folder.is_dir():
            raise ValueError(
                f"no folder at {folder}; give one with photographs of the thing and a subfolder {CLIPS} of it moving: "
                "make run SCENE=thing DATA=<folder>"
            )
        if not (folder / CLIPS).is_dir():
            raise ValueError(
                f"{folder} has no subfolder {CLIPS}; put clips of the thing moving there, filmed from a stand, or take "
                "SCENE=photos for photographs alone"
            )
        return folder / CLIPS

    def _around(self) -> Path:
        """The folder where photographs are, or the video that it holds in their place."""
        folder = Path(self.path)
        videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEOS and not p.name.startswith("."))
        names = ", ".join(p.name for p in videos)
        if videos and photographs_in(folder):
            raise ValueError(
                f"{folder} holds photographs and videos ({names}); clips of the thing moving belong into {CLIPS}, and "
                "a video around it takes the place of the photographs: move one or the other"
            )
        if len(videos) > 1:
            raise ValueError(
                f"{folder} holds {len(videos)} videos ({names}); leave the one that walks around the thing at rest, "
                f"and move those of it moving into {CLIPS}"
            )
        return videos[0] if videos else folder

    def _stills(self, target: Path, clips: list[Path], takes: list[FilmedTake]) -> Iterator[tuple[str, str]]:
        """Write the frame nearest to rest of each clip, as large as photographs are: (the picture, its clip)."""
        from PIL import Image

        for number, (clip, take) in enumerate(zip(clips, takes)):
            first = min(take.rest, len(take.video) - 2)  # a piece of a clip has two frames or more
            two = read_clip(
                clip,
                fps=self.fps,
                piece=self.pieces.get(clip.stem),
                longest_side=self.longest_side,
                most=FRAMES,
                first=first,
                count=2,
            ).frames
            name = f"{number:03d}.png"
            Image.fromarray(two[take.rest - first].numpy()).save(target / name)
            yield f"{target.name}/{name}", clip.name


def _seen(take: FilmedTake, posed: Posed, axes: Axes, fit: Fit, log, *, number: int, clip: str) -> Take:
    """The take as the pinhole camera saw it that was found for it; says how well it was found."""
    h, w = take.video.shape[1:3]
    assert posed.size is not None  # COLMAP knows it
    lens = posed.lens(*posed.size).resized(w, h)
    lens.check(clip)
    error = fit.error * w / posed.size[0]
    log.metric("clip_reprojection_error_px", error, step=number)
    log.info(
        f"{clip}: camera found by {fit.points} points, reprojection error {error:.2f} px of {w} x {h}; the lens sees "
        f"{np.degrees(2 * np.arctan(0.5 * w / lens.fx)):.0f} degrees across"
    )
    straight = pinhole(lens.pinhole(clip), axes.world_to_camera(posed.world_to_camera), clip)
    return replace(take, video=_straightened(take.video, lens, clip)).seen_by(straight)


def _straightened(video: torch.Tensor, lens: Lens, clip: str) -> torch.Tensor:
    """uint8 [t, h, w, 3], as the pinhole of `lens` would have seen it."""
    frames = []
    for frame in video:
        ((straight, *_), _) = undistorted([frame.numpy().astype(np.float32)], lens, clip)
        frames.append(torch.from_numpy((straight + 0.5).astype(np.uint8)))
    return torch.stack(frames)
