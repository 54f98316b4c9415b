"""One frame as binary glTF 2.0 with KHR_gaussian_splatting (ratified by Khronos in 2026), for viewers and web pages.

The Gaussians are a primitive of points with the attributes POSITION, KHR_gaussian_splatting:ROTATION (unit quaternions
x y z w), :SCALE (standard deviations as they are, not logarithms), :OPACITY (0..1) and :SH_DEGREE_l_COEF_n (3DGS's
coefficients and signs, display-referred sRGB). COLOR_0, linear and with opacity, is for viewers that draw points only.

glTF is y up. The turn from z up, (x, y, z) -> (x, z, -y), is done to the numbers, harmonics included, not by a node:
viewers may leave out turning the harmonics of a node.

A .glb file is a header (magic, version, length) and two chunks, each with length and kind: JSON, padded with blanks,
and the arrays, padded with zeros, to multiples of four bytes (glTF 2.0 specification, sec. 4).
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physics3d.export.turn import turned
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.sh import C0

EXTENSION = "KHR_gaussian_splatting"
Z_UP_TO_Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FLOAT, POINTS = 5126, 0  # glTF's numbers for float32 and for a primitive of points
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def glb_size(count: int, harmonics: int) -> int:
    """Of a file with so many Gaussians and coefficients per channel [byte]."""
    return 8000 + count * 4 * (3 + 4 + 4 + 3 + 1 + 3 * harmonics)


def write_glb(path: Path, gaussians: Gaussians) -> None:
    """Write one frame, z up, as .glb, y up. Raises ValueError if it is not sound, OSError on a full disk."""
    gaussians.check()
    arrays = _attributes(turned(gaussians, Z_UP_TO_Y_UP))
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for name, array in arrays.items():
        kind = KINDS[array.shape[1] if array.ndim == 2 else 1]
        accessor: dict[str, Any] = {"bufferView": len(views), "componentType": FLOAT, "count": len(array), "type": kind}
        if name == "POSITION":  # of which alone glTF demands the bounds
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes})
        accessors.append(accessor)
        offset += array.nbytes
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(arrays)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "physics3d"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "gaussians", "mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", offset, b"BIN\0"))  # float32 only: a multiple of four
        for array in arrays.values():
            file.write(array.tobytes())


def _attributes(g: Gaussians) -> dict[str, np.ndarray]:
    """Name of a vertex attribute -> its little-endian float32 values, one row per Gaussian."""
    srgb = (0.5 + C0 * g.sh[:, 0]).clamp(0, 1)
    linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    values = {
        "POSITION": g.mean,
        "COLOR_0": torch.cat([linear, g.opacity[:, None]], 1),
        f"{EXTENSION}:ROTATION": torch.nn.functional.normalize(g.quaternion, dim=1)[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": g.log_scale.exp(),
        f"{EXTENSION}:OPACITY": g.opacity,
    }
    for k in range(g.sh.shape[1]):
        degree = int(k**0.5)
        values[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = g.sh[:, k]
    return {name: np.ascontiguousarray(value.detach().cpu().numpy(), "<f4") for name, value in values.items()}
