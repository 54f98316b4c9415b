"""Photographs whose cameras are known -> a Capture: what all formats of camera files have in common.

A format says which pictures there are, through which lens and from where each was taken, in its own units and axes, and
which points it knows. Where `up` or `scale` are left open they are guessed from the cameras (`ground.py`) and said.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from physics3d.checks import Colour, Direction, Every, Factor, Name, Positive, Text, require_fields
from physics3d.gaussians.cameras import Camera
from physics3d.scenes.axes import Axes
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.ground import FLAT, aim, floor_plane, level
from physics3d.scenes.lens import Lens
from physics3d.scenes.photographs import held_out, mattes, read_photograph, triple


@dataclass(frozen=True, kw_only=True)
class Posed:
    """One picture that exists and its camera; nothing is read yet."""

    path: Path
    name: str
    lens: Callable[[int, int], Lens]  # for a width and a height [px]
    size: tuple[int, int] | None  # width and height that the camera file speaks of [px]
    world_to_camera: Float64[Tensor, "4 4"]  # OpenCV axes, source units
    mask: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Points:
    xyz: Float64[np.ndarray, "m 3"]  # source units
    rgb: Float32[np.ndarray, "m 3"]  # 0..1


@dataclass(frozen=True, kw_only=True)
class AbstractPosedSource(AbstractSource):
    name: Name
    path: Text
    up: Direction | None = None  # in the source's axes; None: how the cameras were held, or the floor's
    scale: Positive | None = None  # metres per unit [m]; None: so that the cameras are 1 m from what they look at
    held_out_every: Every = 8  # every so many images are kept for evaluation; 0: none
    resolution: Factor | None = None  # factor on both image sides, in (0, 1]
    background: Colour = (1.0, 1.0, 1.0)  # put behind images with alpha or mask, 0..1
    single_object: bool = False  # one object on a plain background: nothing to segment

    def read(self, log) -> tuple[list[Posed], Points | None]:
        """Photographs in the order of their names, and points where the format has them.

        Raises ValueError for what the camera file lacks or has wrong.
        """
        raise NotImplementedError

    def __call__(self, *, log) -> Capture:
        require_fields(self, "source")
        background = triple("background", self.background)
        photographs, known = self.read(log)
        _require_several_places(photographs)
        axes, floor = self._axes(photographs, known, log)
        images, alphas, cameras, names = [], [], [], []
        remarks: Counter[str] = Counter()
        for photograph in log.progress(photographs, "reading images"):
            read = read_photograph(
                photograph.path,
                lens=photograph.lens,
                size=photograph.size,
                background=background,
                resolution=self.resolution,
                mask=photograph.mask,
            )
            remarks.update(read.remarks)
            images.append(read.image)
            alphas.append(read.alpha)
            cameras.append(pinhole(read.lens, axes.world_to_camera(photograph.world_to_camera), str(photograph.path)))
            names.append(photograph.name)
        for remark, count in remarks.items():
            log.info(f"{count} of {len(images)} images are {remark}")
        if any(p.mask for p in photographs):
            log.info("masks are taken as mattes: what is black in them is replaced by the background")
        axes.report(cameras, log)
        capture = Capture(
            name=self.name,
            images=tuple(images),
            cameras=tuple(cameras),
            names=tuple(names),
            held_out=held_out(len(images), self.held_out_every),
            alphas=mattes(names, alphas),
            background=background,
            points=None if known is None else axes.points(torch.from_numpy(known.xyz)).float(),
            point_colors=None if known is None else torch.from_numpy(known.rgb).float(),
            single_object=self.single_object,
            floor=floor,
        )
        capture.check()
        where(capture, log)
        return capture

    def _axes(self, photographs: list[Posed], known: Points | None, log) -> tuple[Axes, float | None]:
        """The axes, guessed as far as they are left open, and the height of a floor found in doing so [m]."""
        if self.up is not None and self.scale is not None:
            return Axes(up=triple("up", self.up), scale=self.scale), None
        M = torch.stack([p.world_to_camera for p in photographs]).numpy()
        R, t = M[:, :3, :3], M[:, :3, 3]
        points = None if known is None else known.xyz
        seen = aim(R, t, points)
        if self.scale is not None:
            scale = self.scale
        elif seen is not None:
            scale = 1 / seen.distance
        else:
            raise ValueError(
                "scale is not given, and the cameras look at no common place to guess it from; set scene.source.scale, "
                "metres per unit of the camera file"
            )
        if self.up is not None:
            up, plane = triple("up", self.up), None
        else:
            held = level(R)
            plane = None
            if seen is not None and points is not None:
                plane = floor_plane(points, held, seen.middle, FLAT * seen.distance, seed=0)
            up = triple("up", (held if plane is None else plane[:3]).tolist())
            basis = "how the cameras were held" if plane is None else "the normal of the largest level plane of points"
            log.warn(f"up is not given: taken from {basis}, [{up[0]:.3f}, {up[1]:.3f}, {up[2]:.3f}] (scene.source.up)")
        if self.scale is None:
            log.warn(
                f"scale is not given: {scale:.4g} metres per unit puts the cameras 1 m from what they look at; measure "
                "one length and set scene.source.scale"
            )
        if plane is None:
            return Axes(up=up, scale=scale), None
        floor = float(-scale * plane[3])
        log.info(f"assumed: that plane is the floor, z = {floor:.3f} m")
        return Axes(up=up, scale=scale), floor


def _require_several_places(photographs: list[Posed]) -> None:
    """Raises ValueError if all cameras of several pictures are at one place, from which nothing has a depth."""
    M = torch.stack([p.world_to_camera for p in photographs])
    centres = -(M[:, :3, :3].mT @ M[:, :3, 3:])[..., 0]
    if len(photographs) > 1 and (centres - centres[0]).abs().max() <= 1e-9 * (1 + centres[0].abs().max()):
        raise ValueError(
            f"all {len(photographs)} cameras are at {centres[0].tolist()}, from where nothing has a depth; the camera "
            "must move between pictures"
        )


def fixed(lens: Lens) -> Callable[[int, int], Lens]:
    """For `Posed.lens`, of a lens that the camera file gives whole."""
    return lambda width, height: lens


def pinhole(lens: Lens, world_to_camera: Float64[Tensor, "4 4"], name: str) -> Camera:
    """A camera of a lens without distortion [m]. Raises ValueError naming the picture."""
    camera = Camera(
        width=lens.width,
        height=lens.height,
        fx=lens.fx,
        fy=lens.fy,
        cx=lens.cx,
        cy=lens.cy,
        world_to_camera=world_to_camera,
    )
    camera.check(name)
    return camera


def where(capture: Capture, log) -> None:
    """Say where the thing is, for whoever sets `excitation.centre`, boundaries and prompts."""
    M = torch.stack([c.world_to_camera for c in capture.cameras]).numpy()
    points = None if capture.points is None else capture.points.double().numpy()
    seen = aim(M[:, :3, :3], M[:, :3, 3], points)
    if seen is None:
        log.info("the cameras look at no common place; set excitation.centre by hand")
        return
    middle = ", ".join(f"{m:z.3f}" for m in seen.middle)
    log.info(
        f"the cameras look at [{middle}] m (e.g. for excitation.centre), from {seen.distance:.3g} m in the middle, "
        f"over {seen.span:.0f} degrees"
    )
