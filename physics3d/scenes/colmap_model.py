"""The files of a COLMAP model: cameras, images and points3D, as .bin or .txt. colmap.github.io/format.html.

A point is seen at X_c = R(q) X + t, q = (w, x, y, z). rigs and frames of COLMAP >= 3.12 are not needed and not read.
"""

import os
import struct
from collections.abc import Container
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from physics3d.scenes.named import read_text

OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
PERSPECTIVE = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": OPENCV,
    "FULL_OPENCV": (*OPENCV, "k3", "k4", "k5", "k6"),
}
# in binary files: number of the model -> name, number of parameters
MODELS = {i: (name, len(PERSPECTIVE[name])) for i, name in enumerate(PERSPECTIVE) if i < 5}
MODELS |= {
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip


@dataclass(frozen=True)
class ColmapCamera:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    id: int
    name: str
    camera: int  # id
    quaternion: tuple[float, ...]  # w, x, y, z
    translation: tuple[float, ...]


@dataclass
class ColmapModel:
    files: tuple[Path, ...]  # cameras, images, points3D
    cameras: dict[int, ColmapCamera] = field(default_factory=dict)
    images: list[ColmapImage] = field(default_factory=list)
    xyz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    rgb: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    # one entry per observation of a point: its index, and the id of the image
    point_index: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    point_image: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


def read_model(root: Path) -> ColmapModel:
    """The model in `root`/sparse/0, or as COLMAP's undistorter writes it in `root`/sparse, or in `root` itself.

    Raises ValueError naming the file, and the line of a text file, that is missing, damaged or of another format.
    """
    for folder in (root / "sparse" / "0", root / "sparse", root):
        for ending, reader in ((".bin", _read_binary), (".txt", _read_text)):
            files = tuple(folder / f"{part}{ending}" for part in ("cameras", "images", "points3D"))
            if all(f.is_file() for f in files):
                return reader(files)
    raise ValueError(
        f"no COLMAP model in {root / 'sparse' / '0'} or {root / 'sparse'}: it needs cameras, images and points3D, all "
        "as .bin or all as .txt; check the path in the scene's configuration (DATA=... on the command line)"
    )


def _read_text(files: tuple[Path, ...]) -> ColmapModel:
    model = ColmapModel(files)
    file, number = files[0], 0
    ids: set[int] = set()
    try:
        for number, line in _lines(file):  # noqa: B007 the error below names the line
            w = line.split()
            if w[1] in PERSPECTIVE and len(w) != 4 + len(PERSPECTIVE[w[1]]):
                raise ValueError(f"{w[1]} has {len(PERSPECTIVE[w[1]])} parameters, here are {len(w) - 4}")
            _require_new("camera", int(w[0]), model.cameras)
            model.cameras[int(w[0])] = ColmapCamera(w[1], int(w[2]), int(w[3]), tuple(map(float, w[4:])))
        file, number = files[1], 0
        lines = iter(_lines(file, blank=True))
        for number, line in lines:
            if not line.strip():
                continue
            w = line.split(maxsplit=9)
            pose = tuple(map(float, w[1:8]))
            _require_new("image", int(w[0]), ids)
            ids.add(int(w[0]))
            model.images.append(ColmapImage(int(w[0]), w[9].strip(), int(w[8]), pose[:4], pose[4:]))
            number, second = next(lines, (number, ""))  # may be empty
            if not _is_key_points(second):
                raise ValueError(
                    "here should be the key points of the image in the line above (X, Y, POINT3D_ID, ..., or an empty "
                    "line): COLMAP gives two lines to each image, write an empty one after each"
                )
        file, number = files[2], 0
        xyz, rgb, index, seen = [], [], [], []
        for i, (number, line) in enumerate(_lines(file)):  # noqa: B007
            w = line.split()
            if len(w) < 8 or len(w) % 2:
                raise ValueError("the line is cut short")
            xyz.append([float(x) for x in w[1:4]])
            rgb.append([int(x) for x in w[4:7]])
            track = [int(x) for x in w[8::2]]
            index += [i] * len(track)
            seen += track
    except (IndexError, ValueError) as error:  # UnicodeDecodeError is a ValueError
        raise ValueError(
            f"cannot read {file}, line {number}: {error}; the file is damaged or not COLMAP's text format"
        ) from error
    _set_points(model, xyz, rgb, index, seen)
    return model


def _lines(file: Path, *, blank: bool = False) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments and (unless asked for) empty ones."""
    numbered = enumerate(read_text(file).splitlines(), 1)
    return [(n, line) for n, line in numbered if not line.startswith("#") and (blank or line.strip())]


def _require_new(what: str, number: int, known: Container[int]) -> None:
    """Points say by these numbers where they are seen, and images by which camera they were taken."""
    if number in known:
        raise ValueError(f"{what} {number} is there twice, and each needs a number of its own")


def _require_end(data: bytes, at: int) -> None:
    """What a number of entries announces is all that a binary file holds."""
    if at > len(data):
        raise ValueError("it ends within its last entry")
    if at < len(data):
        raise ValueError(f"{len(data) - at} bytes are left after its last entry")


def _is_key_points(line: str) -> bool:
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(float(w) == int(w) for w in words[2::3])
    except ValueError:
        return False


def _read_binary(files: tuple[Path, ...]) -> ColmapModel:
    model = ColmapModel(files)
    file = files[0]
    ids: set[int] = set()
    try:
        data, at = file.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            camera, kind, width, height = struct.unpack_from("<iiQQ", data, at)
            if kind not in MODELS:
                raise ValueError(f"camera {camera} has model number {kind}, known are 0 to {max(MODELS)}")
            name, count = MODELS[kind]
            parameters = struct.unpack_from(f"<{count}d", data, at + 24)
            _require_new("camera", camera, model.cameras)
            model.cameras[camera] = ColmapCamera(name, width, height, parameters)
            at += 24 + 8 * count
        _require_end(data, at)
        file = files[1]
        data, at = file.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            number, *pose, camera = struct.unpack_from("<i7di", data, at)
            end = data.index(b"\0", at + 64)
            name = os.fsdecode(data[at + 64 : end])
            (observations,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * observations
            _require_new("image", number, ids)
            ids.add(number)
            model.images.append(ColmapImage(number, name, camera, tuple(pose[:4]), tuple(pose[4:])))
        _require_end(data, at)
        file = files[2]
        data, at = file.read_bytes(), 8
        xyz, rgb = [], []
        index: list[int] = []
        seen: list[int] = []
        for i in range(struct.unpack_from("<Q", data)[0]):
            _, x, y, z, r, g, b, _, length = struct.unpack_from("<Q3d3BdQ", data, at)
            xyz.append((x, y, z))
            rgb.append((r, g, b))
            track = struct.unpack_from(f"<{2 * length}i", data, at + 51)
            index += [i] * length
            seen += track[::2]
            at += 51 + 8 * length
        _require_end(data, at)
    except (struct.error, ValueError, OverflowError) as error:
        raise ValueError(f"cannot read {file}: {error}; the file is damaged or not COLMAP's binary format") from error
    _set_points(model, xyz, rgb, index, seen)
    return model


def _set_points(model: ColmapModel, xyz: list, rgb: list, index: list, seen: list) -> None:
    if not model.images:
        raise ValueError(f"{model.files[1]} lists no images")
    model.xyz = np.asarray(xyz, np.float64).reshape(-1, 3)
    if not np.isfinite(model.xyz).all():
        bad = int((~np.isfinite(model.xyz)).sum())
        raise ValueError(f"{model.files[2]}: {bad} coordinates are NaN or infinite; drop those points")
    colors = np.asarray(rgb).reshape(-1, 3)
    if len(colors) and not 0 <= colors.min() <= colors.max() <= 255:
        raise ValueError(f"{model.files[2]}: colours are {colors.min()} to {colors.max()}; they must lie in 0..255")
    model.rgb = colors.astype(np.uint8)
    model.point_index, model.point_image = np.asarray(index, np.int64), np.asarray(seen, np.int64)
