"""One frame as .spz, Niantic's compressed file of Gaussians, version 3 (github.com/nianticlabs/spz, load-spz.cc).

A tenth of the size of a .ply, for telephones and web pages. Under gzip lie a header of 16 bytes and one array after
the other, little endian, a row per Gaussian:

    position   3 x 24 bits   x 2^b, signed; b bits of fraction, as many as the farthest Gaussian leaves
    opacity    1 byte        255 o
    colour     3 bytes       255 (0.15 sh_0 + 0.5)
    size       3 bytes       16 (ln s + 10): 45 um and more, in steps of 6 %
    rotation   4 bytes       the three smaller components of x y z w, 9 bits and a sign each; 2 bits name the largest
    harmonics  3 bytes each  128 sh + 128, coefficient by coefficient

The axes are right, up, back, that is y up as in glTF: the turn from z up is done to the numbers, harmonics included.
"""

import gzip
import math
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.export.gltf import Z_UP_TO_Y_UP
from physics3d.export.turn import turned
from physics3d.gaussians.model import Gaussians

MAGIC, VERSION = 0x5053474E, 3
SMALLEST_THREE = 511 * math.sqrt(2)  # 9 bits for what is at most 1/sqrt(2)
FINEST = 20  # bits of fraction: a micrometre; more would say nothing


def spz_size(count: int, harmonics: int) -> int:
    """What a file with so many Gaussians and coefficients per channel takes at most [byte]."""
    plain = 16 + count * (9 + 1 + 3 + 3 + 4 + 3 * (harmonics - 1))
    return plain + plain // 1000 + 100  # gzip adds five bytes to 64 kB that it cannot make smaller


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write one frame, z up, as .spz, y up. Raises ValueError if it is not sound, or reaches farther than 2000 km,
    OSError on a full disk."""
    gaussians.check()
    g = turned(gaussians, Z_UP_TO_Y_UP)
    position, rest = _numbers(g.mean), _numbers(g.sh[:, 1:]).reshape(len(g), -1)
    bits = _fraction(float(np.abs(position).max(initial=0.0)))
    arrays = (
        _fixed(position, bits),
        _byte(255 * _numbers(g.opacity)),
        _byte(255 * (0.15 * _numbers(g.sh[:, 0]) + 0.5)),
        _byte(16 * (_numbers(g.log_scale) + 10)),
        _smallest_three(_numbers(g.quaternion)[:, [1, 2, 3, 0]]),
        _byte(128 * rest + 128),
    )
    degree = math.isqrt(g.sh.shape[1]) - 1
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(g), degree, bits, 0, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(header + b"".join(array.tobytes() for array in arrays), mtime=0))


def _numbers(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _byte(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _fraction(farthest: float) -> int:
    """Bits behind the point, so that `farthest` [m] fits into 23 bits and a sign."""
    bits = min(FINEST, 22 - math.frexp(farthest)[1])
    if bits < 1:
        raise ValueError(f"a Gaussian lies {farthest:.3g} m away, more than .spz can say; take FORMAT=ply")
    return bits


def _fixed(position: Float[np.ndarray, "g 3"], bits: int) -> UInt8[np.ndarray, "g 9"]:
    """The three lower bytes of each number, the lowest first."""
    whole = np.rint(position * 2.0**bits).astype("<i4")
    return np.ascontiguousarray(whole.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]).reshape(-1, 9)


def _smallest_three(xyzw: Float[np.ndarray, "g 4"]) -> np.ndarray:
    """[g] four bytes each; q and -q are the same rotation, so the largest component is taken for positive."""
    q = xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(q).argmax(1)
    q = q * np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32)
    for i in range(4):
        magnitude = np.clip(np.rint(np.abs(q[:, i]) * SMALLEST_THREE), 0, 511).astype(np.uint32)
        with_it = (packed << 10) | ((q[:, i] < 0).astype(np.uint32) << 9) | magnitude
        packed = np.where(largest == i, packed, with_it)
    return packed.astype("<u4")
