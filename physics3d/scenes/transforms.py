"""transforms.json: NeRF-synthetic (Blender; one opening angle, often RGBA) and the OPENCV_PINHOLE kind of nerfstudio.

    {"camera_angle_x": rad, "frames": [{"file_path": "./train/r_0", "transform_matrix": 4x4}]}
    {"fl_x": px, "fl_y": px, "cx": px, "cy": px, "w": px, "h": px, "frames": [...]}     (each may also stand in a frame)

transform_matrix is camera-to-world with OpenGL camera axes (x right, y up, z backward). A path without an ending means
.png. Points of structure from motion are taken from points3D.npz (xyz, rgb) beside the file where it exists.
Mildenhall et al. 2020; docs.nerf.studio, "data conventions".
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from physics3d.checks import Colour, Direction, Every, Factor, Positive, Text
from physics3d.gaussians.cameras import Camera
from physics3d.scenes.axes import OPENGL_TO_OPENCV, Axes, rigid_inverse
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.photographs import held_out, mattes, read_photograph, triple

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True, kw_only=True)
class TransformsSource(AbstractSource):
    name: Text
    path: Text  # the .json file, or the folder that holds transforms.json
    up: Direction  # up in the file's coordinates; NeRF-synthetic has (0, 0, 1)
    scale: Positive  # metres per unit of the file [m]
    held_out_every: Every = 8  # every so many images are kept for evaluation; 0: none
    resolution: Factor | None = None  # factor on both image sides, in (0, 1]
    background: Colour = (1.0, 1.0, 1.0)  # put behind images with alpha, 0..1
    single_object: bool = False  # one object on a plain background: nothing to segment

    def files(self) -> tuple[str, ...]:
        file, content = self._read()
        images = [str(_image_path(file, frame)) for frame in content["frames"]]
        points = file.parent / "points3D.npz"
        return (str(file), *sorted(images), *([str(points)] if points.is_file() else []))

    def __call__(self, *, log) -> Capture:
        file, content = self._read()
        axes = Axes(up=triple("up", self.up), scale=self.scale)
        axes.check()
        frames = sorted(content["frames"], key=lambda frame: str(_image_path(file, frame)))
        images, alphas, cameras, names = [], [], [], []
        for frame in log.progress(frames, "reading images"):
            path = _image_path(file, frame)
            name = str(path.relative_to(file.parent)) if path.is_relative_to(file.parent) else str(path)
            image, alpha, size = read_photograph(
                path, background=triple("background", self.background), resolution=self.resolution
            )
            camera = _camera(file, {**content, **frame}, path, size, axes)
            images.append(image)
            alphas.append(alpha)
            cameras.append(camera.scaled(self.resolution) if self.resolution else camera)
            names.append(name)
        axes.report(cameras, log)
        points, colors = _points(file.parent / "points3D.npz", axes)
        capture = Capture(
            name=self.name,
            images=tuple(images),
            cameras=tuple(cameras),
            names=tuple(names),
            held_out=held_out(len(images), self.held_out_every),
            alphas=mattes(names, alphas),
            background=triple("background", self.background),
            points=points,
            point_colors=colors,
            single_object=self.single_object,
        )
        capture.check()
        return capture

    def _read(self) -> tuple[Path, dict]:
        file = Path(self.path)
        if file.is_dir():
            file = file / "transforms.json"
        if not file.is_file():
            raise ValueError(
                f"no camera file at {file}; check the path in the scene's configuration (DATA=... on the command line)"
            )
        try:
            content = json.loads(file.read_text())
            frames = content["frames"]
            _ = [frame["file_path"] + "" for frame in frames]
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
            raise ValueError(
                f"{file} is not a transforms.json with a list of frames and their file_path: {error!r}"
            ) from error
        if not frames:
            raise ValueError(f"{file} lists no images; its frames are empty")
        return file, content


def _image_path(file: Path, frame: dict) -> Path:
    path = file.parent / frame["file_path"]
    return path if path.suffix else path.with_name(path.name + ".png")


def _camera(file: Path, entry: dict, path: Path, size: tuple[int, int], axes: Axes) -> Camera:
    """One camera for an image of `size` (width, height). Raises ValueError naming the image."""
    width, height = size
    if (entry.get("w", width), entry.get("h", height)) != (width, height):
        raise ValueError(
            f"{path} has {width} x {height} pixels, {file.name} says {entry.get('w')} x {entry.get('h')}; "
            "camera file and images disagree, resize one of them"
        )
    bent = {k: entry[k] for k in DISTORTION if entry.get(k)}
    if bent:
        raise ValueError(
            f"{path}: the camera has lens distortion {bent}; undistort the images first (colmap image_undistorter)"
        )
    try:
        fx = float(entry["fl_x"]) if "fl_x" in entry else width / 2 / math.tan(0.5 * float(entry["camera_angle_x"]))
        fy = float(entry.get("fl_y", fx))
        pose = torch.tensor(entry["transform_matrix"], dtype=torch.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"transform_matrix has shape {tuple(pose.shape)}")
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ValueError(
            f"{file}: entry of {path.name} needs fl_x or camera_angle_x and a 4x4 transform_matrix: {error!r}"
        ) from error
    camera = Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=float(entry.get("cx", width / 2)),
        cy=float(entry.get("cy", height / 2)),
        world_to_camera=axes.world_to_camera(rigid_inverse(pose @ OPENGL_TO_OPENCV, str(path))),
    )
    camera.check(str(path))
    return camera


def _points(file: Path, axes: Axes) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    if not file.is_file():
        return None, None
    try:
        with np.load(file, allow_pickle=False) as arrays:
            xyz, rgb = arrays["xyz"].astype(np.float32), arrays["rgb"].astype(np.float32) / 255
    except Exception as error:
        raise ValueError(
            f"cannot read the points {file}: {error}; it must hold xyz [n, 3] and rgb [n, 3] in 0..255"
        ) from error
    if not np.isfinite(xyz).all():
        raise ValueError(f"{file}: {int((~np.isfinite(xyz)).sum())} coordinates are NaN or infinite; drop those points")
    return axes.points(torch.from_numpy(xyz)), torch.from_numpy(rgb)
