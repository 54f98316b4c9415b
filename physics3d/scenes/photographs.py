"""Reading photographs: colour over a background, the matte kept aside, fewer pixels on request.

C = alpha C_file + (1 - alpha) background          (on the encoded values, as renderers and mattes usually mean it)
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor


def read_photograph(
    path: Path, *, background: tuple[float, float, float], resolution: float | None
) -> tuple[UInt8[Tensor, "h w 3"], UInt8[Tensor, "h w"] | None, tuple[int, int]]:
    """Read one picture -> (image, matte or None where the file has no alpha, (width, height) of the file in pixels).

    `resolution` is the factor on both sides, 0 < resolution <= 1 (None: as it is); pixels are averaged over boxes.
    Raises ValueError naming the file if it is missing or broken.
    """
    from PIL import Image

    check_resolution(resolution)
    if not path.is_file():
        raise ValueError(f"the camera file names the image {path}, which does not exist; restore it or drop its entry")
    try:
        with Image.open(path) as file:
            picture = file.convert("RGBA" if "A" in file.getbands() or "transparency" in file.info else "RGB")
    except Exception as error:  # PIL raises OSError, SyntaxError, zlib.error, DecompressionBombError ...
        raise ValueError(f"cannot read the image {path}: {error}; the file is broken, replace it") from error
    size = picture.size
    array: np.ndarray = np.asarray(picture, np.float32)
    alpha = None
    if array.shape[-1] == 4:
        matte = array[..., 3:] / 255
        array = array[..., :3] * matte + 255 * (1 - matte) * np.asarray(background, np.float32)
        alpha = _shrink(matte[..., 0] * 255, resolution)
    return _shrink(array, resolution), alpha, size


def check_resolution(resolution: float | None) -> None:
    """Raise ValueError unless `resolution` is None or a factor in (0, 1]."""
    if resolution is not None and not 0 < resolution <= 1:
        raise ValueError(f"resolution is {resolution}; it is the factor on both sides of an image, in (0, 1], or null")


def triple(name: str, value: Sequence[float]) -> tuple[float, float, float]:
    """Three finite numbers as a tuple, whatever sequence a configuration gave. Raises ValueError naming the field."""
    numbers = [float(v) for v in value]
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"{name} is {value}; give three numbers")
    return numbers[0], numbers[1], numbers[2]


def mattes(names: list[str], alphas: list[Tensor | None]) -> tuple[Tensor, ...]:
    """One matte per image, or none at all. Raises ValueError naming the first image that has none when others do."""
    present = [a for a in alphas if a is not None]
    if present and len(present) < len(alphas):
        odd = names[next(i for i, a in enumerate(alphas) if a is None)]
        raise ValueError(f"{odd} has no alpha channel but other images have one; give all images a matte or none")
    return tuple(present)


def held_out(count: int, every: int) -> tuple[int, ...]:
    """Indices 0, every, 2 every, ... (as 3DGS does); none if `every` is 0. Raises ValueError if nothing is left."""
    if every < 0 or (every == 1 and count):
        raise ValueError(f"held_out_every is {every}; take 0 (hold out none) or at least 2, e.g. 8")
    return tuple(range(0, count, every)) if every else ()


def require_folder(path: Path, what: str) -> Path:
    """Raises ValueError naming the folder if it is not there."""
    if not path.is_dir():
        raise ValueError(
            f"no {what} at {path}; check the path in the scene's configuration (DATA=... on the command line)"
        )
    return path


def _shrink(array: np.ndarray, resolution: float | None) -> Tensor:
    """Box average to the size that Camera.scaled(resolution) has; float [h, w] or [h, w, 3] in 0..255 -> uint8."""
    from PIL import Image

    if resolution is not None and resolution != 1:
        h, w = array.shape[:2]
        size = max(1, round(w * resolution)), max(1, round(h * resolution))
        planes = [array] if array.ndim == 2 else [array[..., i] for i in range(array.shape[-1])]
        planes = [
            np.asarray(Image.fromarray(np.ascontiguousarray(p)).resize(size, Image.Resampling.BOX)) for p in planes
        ]
        array = planes[0] if array.ndim == 2 else np.stack(planes, -1)
    return torch.from_numpy((np.clip(array, 0, 255) + 0.5).astype(np.uint8))
