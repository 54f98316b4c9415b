"""transforms.json: NeRF-synthetic (Blender; one opening angle, often RGBA), nerfstudio and instant-ngp.

    {"camera_angle_x": rad, "camera_angle_y": rad, "frames": [{"file_path": "./train/r_0", "transform_matrix": 4x4}]}
    {"fl_x": px, "fl_y": px, "cx": px, "cy": px, "w": px, "h": px, "k1": ..., "p1": ..., "frames": [...]}

What describes the lens may also stand in a frame and holds there. transform_matrix is camera-to-world with OpenGL
camera axes (x right, y up, z backward). Pictures are undistorted as they are read: k1, k2, p1, p2 are OpenCV's, k3 and
k4 the factors of r^6 and r^8 (Brown's, as nerfstudio computes them); with "camera_model": "FULL_OPENCV", or with k5 or
k6, k4, k5 and k6 are OpenCV's denominator. A picture's `mask_path` is black where it shows nothing of the object and is
taken as its matte. Points of structure from motion are taken from `ply_file_path`, or from points3D.npz (xyz, rgb)
beside the file. Mildenhall et al. 2020; docs.nerf.studio, "data conventions".
"""

import json
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from physics3d.scenes.axes import OPENGL_TO_OPENCV, rigid_inverse
from physics3d.scenes.lens import Lens
from physics3d.scenes.named import find, present, read_text, require_unique
from physics3d.scenes.posed import AbstractPosedSource, Points, Posed

MODELS = (
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "OPENCV_PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
)
OTHER_CAMERAS = ("is_fisheye", "latlong", "equirectangular", "orthographic", "ftheta_p0")  # instant-ngp's switches
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


@dataclass(frozen=True, kw_only=True)
class TransformsSource(AbstractPosedSource):
    """`path` is the .json file, or the folder that holds transforms.json; NeRF-synthetic has up = (0, 0, 1)."""

    def files(self) -> tuple[str, ...]:
        file, content = self._content()
        frames = _frames(file, content)
        masks = [str(mask) for _, frame in frames if (mask := _mask(file, content, frame)) is not None]
        points = _points_file(file, content)
        images = [str(path) for path, _ in frames]
        return (str(file), *sorted(images), *sorted(set(masks)), *([str(points)] if points is not None else []))

    def read(self, log) -> tuple[list[Posed], Points | None]:
        file, content = self._content()
        posed = []
        for path, frame in _frames(file, content, log):
            entry = {**content, **frame}
            _refuse_other_cameras(entry, path)
            posed.append(
                Posed(
                    path=path,
                    name=str(path.relative_to(file.parent)) if path.is_relative_to(file.parent) else str(path),
                    lens=partial(_lens, file, content, frame, path),
                    size=_size(entry, path),
                    world_to_camera=_pose(file, entry, path),
                    mask=_mask(file, content, frame),
                )
            )
        points = _points_file(file, content)
        return posed, None if points is None else _points(points)

    def _content(self) -> tuple[Path, dict]:
        file = Path(self.path)
        if file.is_dir():
            file = file / "transforms.json"
        if not file.is_file():
            raise ValueError(
                f"no camera file at {file}; check the path in the scene's configuration (DATA=... on the command line)"
            )
        try:
            content = json.loads(read_text(file), object_hook=_without_nulls)
            _ = [frame["file_path"] + "" for frame in content["frames"]]
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(
                f"{file} is not a transforms.json with a list of frames and their file_path: {error!r}"
            ) from error
        if not content["frames"]:
            raise ValueError(f"{file} lists no images; its frames are empty")
        return file, content


def _without_nulls(entry: dict) -> dict:
    """What is null is not said."""
    return {name: value for name, value in entry.items() if value is not None}


def _number(entry: dict, name: str, otherwise: float | None = None) -> float:
    """A number of a camera file; not true or false, which Python takes as 1 and 0."""
    value = entry[name] if otherwise is None else entry.get(name, otherwise)
    if isinstance(value, bool):
        raise ValueError(f"{name} is {value}")
    return float(value)


def _frames(file: Path, content: dict, log=None) -> list[tuple[Path, dict]]:
    """The frames whose picture exists, by name."""
    frames = [(find(file.parent, frame["file_path"]), frame) for frame in content["frames"]]
    require_unique([str(path) for path, _ in frames], file)
    there = present((path for path, _ in frames), file.parent, file, log)
    return sorted(((path, frame) for path, frame in frames if path in there), key=lambda pair: str(pair[0]))


def _mask(file: Path, content: dict, frame: dict) -> Path | None:
    name = frame.get("mask_path") or content.get("mask_path")
    return find(file.parent, name) if name else None


def _refuse_other_cameras(entry: dict, path: Path) -> None:
    model = entry.get("camera_model") or "PINHOLE"
    switches = [name for name in OTHER_CAMERAS if entry.get(name)]
    if str(model).upper() not in MODELS or switches:
        said = f"camera_model {model}" if str(model).upper() not in MODELS else f"{switches[0]}: {entry[switches[0]]}"
        raise ValueError(
            f"{path}: {said} is no perspective camera; known are {', '.join(MODELS)}: convert the pictures"
        )


def _size(entry: dict, path: Path) -> tuple[int, int] | None:
    if "w" not in entry and "h" not in entry:
        return None
    try:
        width, height = _number(entry, "w"), _number(entry, "h")
        if not (width.is_integer() and height.is_integer() and width >= 1 and height >= 1):
            raise ValueError("must be positive whole numbers")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: w and h are {entry.get('w')}, {entry.get('h')}; give both, in pixels") from error
    return int(width), int(height)


def _lens(file: Path, content: dict, frame: dict, path: Path, width: int, height: int) -> Lens:
    """The lens of one frame for a picture of this size. Raises ValueError naming the picture."""
    entry = {**content, **frame}
    try:
        fx = _focal(frame, "x", width) or _focal(content, "x", width)
        fy = _focal(frame, "y", height) or _focal(content, "y", height)
        if fx is None and fy is None:
            raise KeyError("fl_x")
        k = {name: _number(entry, name, 0.0) for name in COEFFICIENTS}
        cx, cy = _number(entry, "cx", width / 2), _number(entry, "cy", height / 2)
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ValueError(
            f"{file}: entry of {path.name} needs fl_x or camera_angle_x, and numbers for the lens: {error!r}"
        ) from error
    rational = str(entry.get("camera_model")).upper() == "FULL_OPENCV" or k["k5"] != 0 or k["k6"] != 0
    return Lens(
        width=width,
        height=height,
        fx=fx if fx is not None else fy or 0.0,
        fy=fy if fy is not None else fx or 0.0,
        cx=cx,
        cy=cy,
        radial=(k["k1"], k["k2"], k["k3"], *(() if rational else (k["k4"],))),
        denominator=(k["k4"], k["k5"], k["k6"]) if rational else (),
        tangential=(k["p1"], k["p2"]),
    )


def _focal(entry: dict, axis: str, pixels: int) -> float | None:
    """Focal length along x or y [px], from fl_x or camera_angle_x; None where neither is given."""
    if f"fl_{axis}" in entry:
        return _number(entry, f"fl_{axis}")
    if f"camera_angle_{axis}" in entry:
        return pixels / 2 / math.tan(0.5 * _number(entry, f"camera_angle_{axis}"))
    return None


def _pose(file: Path, entry: dict, path: Path) -> Float64[Tensor, "4 4"]:
    """World-to-camera with OpenCV axes. Raises ValueError naming the picture."""
    try:
        pose = torch.tensor(entry["transform_matrix"], dtype=torch.float64)
        if pose.shape == (3, 4):
            pose = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)])
        if pose.shape != (4, 4):
            raise ValueError(f"transform_matrix has shape {tuple(pose.shape)}")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: entry of {path.name} needs a 4x4 transform_matrix: {error!r}") from error
    if torch.isfinite(pose).all() and (pose[3] - torch.tensor([0.0, 0.0, 0.0, 1.0])).abs().max() > 1e-6:
        raise ValueError(
            f"{path}: the last row of transform_matrix is {pose[3].tolist()}, not 0 0 0 1; transpose it if it is "
            "written by columns"
        )
    return rigid_inverse(pose @ OPENGL_TO_OPENCV, str(path))


def _points_file(file: Path, content: dict) -> Path | None:
    name = content.get("ply_file_path")
    if name:
        return find(file.parent, name)
    beside = file.parent / "points3D.npz"
    return beside if beside.is_file() else None


def _points(file: Path) -> Points:
    """Points with their colours. Raises ValueError naming the file."""
    if not file.is_file():
        raise ValueError(f"there is no file of points {file}; restore it, or drop ply_file_path")
    try:
        if file.suffix.lower() == ".ply":
            xyz, rgb = _from_ply(file)
        else:
            with np.load(file, allow_pickle=False) as arrays:
                xyz, rgb = arrays["xyz"].astype(np.float64), arrays["rgb"].astype(np.float32) / 255
    except Exception as error:
        raise ValueError(
            f"cannot read the points {file}: {error}; it must hold xyz [n, 3] and rgb [n, 3] in 0..255"
        ) from error
    if not np.isfinite(xyz).all():
        raise ValueError(f"{file}: {int((~np.isfinite(xyz)).sum())} coordinates are NaN or infinite; drop those points")
    return Points(xyz=xyz, rgb=rgb)


def _from_ply(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """xyz and colours in 0..1; grey where the file has no colours."""
    from plyfile import PlyData

    vertex = PlyData.read(str(file))["vertex"].data
    xyz = np.stack([vertex[name].astype(np.float64) for name in ("x", "y", "z")], -1)
    if "red" not in vertex.dtype.names:
        return xyz, np.full(xyz.shape, 0.5, np.float32)
    rgb = np.stack([vertex[name] for name in ("red", "green", "blue")], -1)
    return xyz, (rgb / (255 if rgb.dtype.kind in "ui" else 1)).astype(np.float32)
