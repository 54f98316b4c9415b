"""Something to take hold of: what is drawn with splats cannot be hit by a pointer, meshes can.

An octahedron on each of some particles, of a material whose every pixel is cut away (glTF's alpha mode MASK, below its
cutoff): neither its colour nor its depth is drawn, and a pointer finds it all the same.
"""

import json
import struct

import numpy as np
from jaxtyping import Float, Int

CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.uint16)
FLOATS, SHORTS = 5126, 5123  # glTF's names of numbers


def invisible(size: float) -> bytes:
    """A binary glTF of one octahedron, `size` from its centre to its corners."""
    corners, faces = (CORNERS * np.float32(size)).tobytes(), FACES.tobytes()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": len(corners), "target": 34962},
        {"buffer": 0, "byteOffset": len(corners), "byteLength": len(faces), "target": 34963},
    ]
    accessors = [
        {"bufferView": 0, "componentType": FLOATS, "count": 6, "type": "VEC3", "min": [-size] * 3, "max": [size] * 3},
        {"bufferView": 1, "componentType": SHORTS, "count": FACES.size, "type": "SCALAR"},
    ]
    material = {"alphaMode": "MASK", "alphaCutoff": 0.5, "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]}}
    told = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [material],
        "buffers": [{"byteLength": len(corners) + len(faces)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(told).encode()
    text += b" " * (-len(text) % 4)
    data = corners + faces
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def spread(position: Float[np.ndarray, "p 3"], chosen: Int[np.ndarray, " n"], most: int) -> Int[np.ndarray, " m"]:
    """At most `most` of the `chosen` particles, evenly in their order along a curve through space."""
    if len(chosen) <= most:
        return chosen
    x = position[chosen]
    cell = ((x - x.min(0)) / np.maximum(np.ptp(x, axis=0).max(), 1e-30) * 1023).astype(np.int64)
    code = sum(((cell[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    order = np.argsort(code, kind="stable")
    return np.sort(chosen[order[np.linspace(0, len(order) - 1, most).round().astype(np.int64)]])
