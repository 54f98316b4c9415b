"""COLMAP: <path>/images and <path>/sparse/0 with cameras, images and points3D, as .bin or .txt.

A point of the source is seen at X_c = R(q) X + t, q = (w, x, y, z). Distortion is not modelled here: SIMPLE_RADIAL and
RADIAL cameras are taken as pinholes while it moves no pixel by more than half a pixel, and refused above that. rigs and
frames of COLMAP >= 3.12 are not needed and not read. colmap.github.io/format.html.
"""

import fnmatch
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from physics3d.checks import Colour, Direction, Every, Factor, Positive, Text
from physics3d.gaussians.cameras import Camera
from physics3d.scenes.axes import Axes, rigid_inverse
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.photographs import held_out, mattes, read_photograph, require_folder, triple

# model id in binary files -> name and names of the parameters
MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
}
PARAMETERS = dict(MODELS.values())
LARGEST_SHIFT = 0.5  # of a pixel by ignored distortion [px]


@dataclass(frozen=True, kw_only=True)
class ColmapSource(AbstractSource):
    name: Text
    path: Text  # the folder that holds sparse/0 and images
    up: Direction  # up in COLMAP's arbitrary coordinates; often near (0, -1, 0)
    scale: Positive  # metres per COLMAP unit [m]; measure one known length
    only: Text = "*"  # pattern of the image names to use, e.g. "viewm0/*"; points then come from these images only
    held_out_every: Every = 8  # every so many images are kept for evaluation; 0: none
    resolution: Factor | None = None  # factor on both image sides, in (0, 1]
    background: Colour = (1.0, 1.0, 1.0)  # put behind images with alpha, 0..1
    single_object: bool = False  # one object on a plain background: nothing to segment

    def files(self) -> tuple[str, ...]:
        model = self._read()
        root = Path(self.path)
        return (*(str(f) for f in model.files), *(str(root / "images" / view.name) for view in self._chosen(model)))

    def __call__(self, *, log) -> Capture:
        model = self._read()
        axes = Axes(up=triple("up", self.up), scale=self.scale)
        axes.check()
        folder = require_folder(Path(self.path) / "images", "folder of images")
        views = self._chosen(model)
        images, alphas, cameras, names = [], [], [], []
        for view in log.progress(views, "reading images"):
            path = folder / view.name
            image, alpha, size = read_photograph(
                path, background=triple("background", self.background), resolution=self.resolution
            )
            if view.lens not in model.lenses:
                raise ValueError(f"{path}: its camera {view.lens} is not in {model.files[0]}; the model is incomplete")
            camera = _camera(model.lenses[view.lens], view, path, size, axes)
            images.append(image)
            alphas.append(alpha)
            cameras.append(camera.scaled(self.resolution) if self.resolution else camera)
            names.append(view.name)
        axes.report(cameras, log)
        seen = np.isin(model.point_view, [view.id for view in views])
        kept = np.unique(model.point_index[seen])
        points = axes.points(torch.from_numpy(model.xyz[kept])).float() if len(kept) else None
        capture = Capture(
            name=self.name,
            images=tuple(images),
            cameras=tuple(cameras),
            names=tuple(names),
            held_out=held_out(len(images), self.held_out_every),
            alphas=mattes(names, alphas),
            background=triple("background", self.background),
            points=points,
            point_colors=torch.from_numpy(model.rgb[kept].astype(np.float32) / 255) if len(kept) else None,
            single_object=self.single_object,
        )
        capture.check()
        return capture

    def _chosen(self, model: "_Model") -> "list[_View]":
        views = sorted((v for v in model.views if fnmatch.fnmatch(v.name, self.only)), key=lambda v: v.name)
        if not views:
            raise ValueError(
                f"no image of {model.files[1]} matches only={self.only!r}; it has {len(model.views)} images"
            )
        return views

    def _read(self) -> "_Model":
        sparse = require_folder(Path(self.path) / "sparse" / "0", "COLMAP model (sparse/0)")
        for ending, reader in ((".bin", _read_binary), (".txt", _read_text)):
            files = tuple(sparse / f"{part}{ending}" for part in ("cameras", "images", "points3D"))
            if all(f.is_file() for f in files):
                return reader(files)
        raise ValueError(f"{sparse} needs cameras, images and points3D, all as .bin or all as .txt")


@dataclass(frozen=True)
class _Lens:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _View:
    id: int
    name: str
    lens: int  # id of the camera
    quaternion: tuple[float, ...]  # w, x, y, z
    translation: tuple[float, ...]


@dataclass
class _Model:
    files: tuple[Path, ...]
    lenses: dict[int, _Lens] = field(default_factory=dict)
    views: list[_View] = field(default_factory=list)
    xyz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    rgb: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    point_index: np.ndarray = field(
        default_factory=lambda: np.zeros(0, np.int64)
    )  # one entry per observation of a point
    point_view: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


def _read_text(files: tuple[Path, ...]) -> _Model:
    model = _Model(files)
    try:
        file = files[0]
        for words in _lines(file):
            if words[1] in PARAMETERS and len(words) != 4 + len(PARAMETERS[words[1]]):
                raise ValueError(f"camera {words[0]} has {len(words) - 4} parameters, {words[1]} needs another number")
            model.lenses[int(words[0])] = _Lens(words[1], int(words[2]), int(words[3]), tuple(map(float, words[4:])))
        file = files[1]
        lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
        for line in lines[::2]:  # the second line of each pair lists key points, and may be empty
            if line.strip():
                w = line.split(maxsplit=9)
                model.views.append(
                    _View(int(w[0]), w[9], int(w[8]), tuple(map(float, w[1:5])), tuple(map(float, w[5:8])))
                )
        file = files[2]
        xyz, rgb, index, view = [], [], [], []
        for i, words in enumerate(_lines(file)):
            if len(words) < 8 or len(words) % 2:
                raise ValueError(f"line of point {i + 1} is cut short")
            xyz.append([float(w) for w in words[1:4]])
            rgb.append([int(w) for w in words[4:7]])
            track = [int(w) for w in words[8::2]]
            index += [i] * len(track)
            view += track
    except (IndexError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read {file}: {error}; the file is damaged or not COLMAP's text format") from error
    _set_points(model, xyz, rgb, index, view)
    return model


def _lines(file: Path) -> list[list[str]]:
    return [line.split() for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]


def _read_binary(files: tuple[Path, ...]) -> _Model:
    model = _Model(files)
    try:
        file = files[0]
        data, at = file.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            lens, kind, width, height = struct.unpack_from("<iiQQ", data, at)
            if kind not in MODELS:
                raise ValueError(
                    f"camera {lens} has model {kind}, known are {MODELS}; run colmap image_undistorter first"
                )
            name, parameters = MODELS[kind]
            model.lenses[lens] = _Lens(name, width, height, struct.unpack_from(f"<{len(parameters)}d", data, at + 24))
            at += 24 + 8 * len(parameters)
        file = files[1]
        data, at = file.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            number, *pose, lens = struct.unpack_from("<i7di", data, at)
            end = data.index(b"\0", at + 64)
            name = data[at + 64 : end].decode()
            (observations,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * observations
            model.views.append(_View(number, name, lens, tuple(pose[:4]), tuple(pose[4:])))
        file = files[2]
        data, at = file.read_bytes(), 8
        xyz, rgb = [], []
        index: list[int] = []
        view: list[int] = []
        for i in range(struct.unpack_from("<Q", data)[0]):
            _, x, y, z, r, g, b, _, length = struct.unpack_from("<Q3d3BdQ", data, at)
            xyz.append((x, y, z))
            rgb.append((r, g, b))
            track = struct.unpack_from(f"<{2 * length}i", data, at + 51)
            index += [i] * length
            view += track[::2]
            at += 51 + 8 * length
    except (struct.error, ValueError) as error:  # UnicodeDecodeError is a ValueError
        raise ValueError(f"cannot read {file}: {error}; the file is cut short or not COLMAP's binary format") from error
    _set_points(model, xyz, rgb, index, view)
    return model


def _set_points(model: _Model, xyz: list, rgb: list, index: list, view: list) -> None:
    if not model.views:
        raise ValueError(f"{model.files[1]} lists no images")
    model.xyz = np.asarray(xyz, np.float64).reshape(-1, 3)
    model.rgb = np.asarray(rgb, np.uint8).reshape(-1, 3)
    if not np.isfinite(model.xyz).all():
        bad = int((~np.isfinite(model.xyz)).sum())
        raise ValueError(f"{model.files[2]}: {bad} coordinates are NaN or infinite; drop those points")
    model.point_index, model.point_view = np.asarray(index, np.int64), np.asarray(view, np.int64)


def _camera(lens: _Lens, view: _View, path: Path, size: tuple[int, int], axes: Axes) -> Camera:
    """The camera of one image of `size` (width, height). Raises ValueError naming the image."""
    if (lens.width, lens.height) != size:
        raise ValueError(
            f"{path} has {size[0]} x {size[1]} pixels, COLMAP's camera {view.lens} says {lens.width} x {lens.height}; "
            "camera file and images disagree, resize one of them"
        )
    if lens.model not in PARAMETERS:
        raise ValueError(
            f"{path}: camera model {lens.model} is not one of {list(PARAMETERS)}; run colmap image_undistorter"
        )
    p = dict(zip(PARAMETERS[lens.model], lens.parameters))
    fx, fy = (p["f"], p["f"]) if "f" in p else (p["fx"], p["fy"])
    corner = math.hypot(max(p["cx"], lens.width - p["cx"]) / fx, max(p["cy"], lens.height - p["cy"]) / fy)
    shift = fx * abs(p.get("k1", 0) * corner**3 + p.get("k2", 0) * corner**5)
    if shift > LARGEST_SHIFT:
        raise ValueError(f"{path}: distortion moves the corner by {shift:.2g} px; run colmap image_undistorter first")
    w, x, y, z = (torch.tensor(view.quaternion, dtype=torch.float64) / math.hypot(*view.quaternion)).tolist()
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )
    M[:3, 3] = torch.tensor(view.translation, dtype=torch.float64)
    rigid_inverse(M, str(path))
    camera = Camera(
        width=lens.width,
        height=lens.height,
        fx=fx,
        fy=fy,
        cx=p["cx"],
        cy=p["cy"],
        world_to_camera=axes.world_to_camera(M),
    )
    camera.check(str(path))
    return camera
