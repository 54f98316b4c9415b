"""A capture: all that is known about a scene before anything is computed. Metres, z up, whatever the source used."""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.boundaries.base import AbstractBoundary
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians


@dataclass(frozen=True, kw_only=True)
class Footage:
    """How long a take is."""

    name: str
    role: str
    frames: int
    fps: float  # [1/s]


@dataclass(frozen=True, kw_only=True)
class Outline:
    """What can be said of a capture before it is read; None: only reading it tells."""

    name: str = "the capture"
    names: tuple[str, ...] | None = None  # of the photographs
    mattes: bool | None = None
    takes: tuple[Footage, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class Take:
    """One recorded motion, seen by one or more fixed cameras at the same instants.

    Frame 0 is the rest state where the excitation is known. Where it is not, nobody knows the state at any frame: from
    frame `release` on the motion is free, and its start is to be found.
    """

    name: str
    role: str  # "learn" or "evaluate"
    fps: float  # [1/s]
    cameras: tuple[Camera, ...]
    videos: tuple[
        Tensor, ...
    ]  # uint8 [t, h, w, 3], one per camera, composited on Capture.background where there is a matte
    excitation: tuple[AbstractBoundary, ...] | None = ()  # what set it in motion (a poke); None: unknown. Gravity and
    # floors are in the World
    release: int = 0  # first frame from which nothing but the World acts, where the excitation is unknown
    seen: int | None = None  # so many first frames are learned from where the excitation is unknown; None: half of them
    # frame in which the thing is where its Gaussians are, where the excitation is unknown; None: that of the first take
    posed: int | None = None
    at_rest: bool = False  # whether it is at rest there
    held_out_cameras: tuple[int, ...] = ()  # cameras used by evaluation only, although the take is learned from

    @property
    def footage(self) -> Footage:
        return Footage(name=self.name, role=self.role, frames=len(self.videos[0]), fps=self.fps)


@dataclass(frozen=True, kw_only=True)
class Capture(AbstractArtifact):
    """All that is known about a scene before anything is computed. Metres, z up."""

    name: str
    images: tuple[Tensor, ...]  # uint8 [h, w, 3]; sizes may differ; composited on `background` where there is alpha
    cameras: tuple[Camera, ...]  # one per image
    names: tuple[str, ...]  # one per image: the file it came from, or a synthetic name
    held_out: tuple[int, ...] = ()  # images never trained on
    alphas: tuple[Tensor, ...] = ()  # uint8 [h, w], one per image or none: the matte of the object
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)  # colour behind everything, 0..1
    points: Tensor | None = None  # [m, 3] [m], from structure from motion
    point_colors: Tensor | None = None  # [m, 3] in 0..1
    takes: tuple[Take, ...] = ()
    gaussians: Gaussians | None = None  # a trained model, if the capture is one: reconstruction is then left out
    single_object: bool = False  # one object on a plain background: segmentation is then left out
    moves: Tensor | None = None  # bool, one per Gaussian, where the source knows what moves: likewise left out
    truth: dict[str, float] = field(default_factory=dict)  # material parameters, SI, named as in the material
    truth_source: str = ""  # where `truth` comes from, and how far to trust it
    floor: float | None = None  # height of the ground that things stand on [m]; None: none is known
    note: str = ""  # said at the start of every run, e.g. that this is a synthetic twin

    def check(self) -> None:
        n = len(self.images)
        if n == 0 and self.gaussians is None:
            raise ValueError(f"capture {self.name}: no images; check the folder in the scene's configuration")
        if not len(self.cameras) == len(self.names) == n:
            raise ValueError(
                f"capture {self.name}: {n} images, {len(self.cameras)} cameras, {len(self.names)} names; must be equal"
            )
        if self.alphas and len(self.alphas) != n:
            raise ValueError(f"capture {self.name}: {len(self.alphas)} alphas for {n} images; give one each or none")
        for name, image, camera in zip(self.names, self.images, self.cameras):
            camera.check(name)
            if image.dtype != torch.uint8 or tuple(image.shape) != (camera.height, camera.width, 3):
                raise ValueError(
                    f"{name}: image is {tuple(image.shape)} {image.dtype}, its camera says "
                    f"{camera.height} x {camera.width}; camera file and images disagree"
                )
        if n and len(set(self.held_out)) >= n:
            raise ValueError(f"capture {self.name}: all {n} images are held out; leave some to train on")
        if self.points is not None:
            require_finite(f"capture {self.name}: points", self.points)
        if self.moves is not None and (self.gaussians is None or len(self.moves) != len(self.gaussians)):
            raise ValueError(f"capture {self.name}: moves needs one value for each of its Gaussians")
        if self.floor is not None and not math.isfinite(self.floor):
            raise ValueError(f"capture {self.name}: floor is {self.floor}; give its height in metres, or None")
        for take in self.takes:
            if take.role not in ("learn", "evaluate") or len(take.cameras) != len(take.videos):
                raise ValueError(
                    f"take {take.name}: role {take.role!r} must be learn or evaluate, with one video per camera"
                )
            if not all(0 <= take.release < len(video) for video in take.videos):
                raise ValueError(f"take {take.name}: release is {take.release}, not one of its frames")

    @property
    def outline(self) -> Outline:
        takes = tuple(take.footage for take in self.takes)
        return Outline(name=self.name, names=self.names, mattes=bool(self.alphas), takes=takes)

    def seen_from(self, view: int | str | None, *, key: str) -> Camera:
        """The camera of a photograph by index or name; of the first one if `view` is None. Raises ValueError, naming
        `key`, if there is no such photograph."""
        if isinstance(view, str) and view not in self.names:
            raise ValueError(f"{key} is {view!r}; the photographs are {', '.join(self.names[:8])}, ...")
        number = self.names.index(view) if isinstance(view, str) else view or 0
        if number >= len(self.cameras):
            raise ValueError(f"{key} is {view}; the capture has views 0 to {len(self.cameras) - 1}")
        return self.cameras[number]

    def take(self, role: str) -> Take | None:
        """The first take of that role, or None."""
        return next((t for t in self.takes if t.role == role), None)


class AbstractSource:
    """A frozen dataclass whose fields are paths and options, and whose call returns a Capture.

    Raises ValueError (naming file and remedy) on a missing folder, no images, a broken image, or cameras and images
    that disagree. `files()` lists what is read, so that the pipeline can fingerprint the content.
    """

    def files(self) -> tuple[str, ...]:
        """Every file that the capture depends on; none for a scene made by code."""
        raise NotImplementedError

    @property
    def outline(self) -> Outline:
        """What is known without reading anything: stages that cannot take it are refused before the work begins."""
        return Outline()

    def __call__(self, *, log) -> Capture:
        raise NotImplementedError
