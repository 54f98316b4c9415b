"""A photograph as its camera saw it: turned, matted, undistorted, fewer pixels on request.

C = alpha C_file + (1 - alpha) background          (on the encoded values, as renderers and mattes usually mean it)

The size that a camera file gives says which way round a picture belongs whose EXIF asks for a turn: COLMAP solves
cameras for pictures as they are stored, others for pictures as they are shown. A picture of the same shape but with
other pixels is a reduced copy, and its camera is reduced with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from physics3d.scenes.lens import Lens, undistorted
from physics3d.scenes.pictures import Picture, read_picture

SAME_SCALE = 0.02  # a picture with a side within this of what its camera file gives was cropped, not reduced


@dataclass(frozen=True, kw_only=True)
class Photograph:
    image: UInt8[Tensor, "h w 3"]
    alpha: UInt8[Tensor, "h w"] | None  # the matte; None where neither file nor mask has one
    lens: Lens  # of these pixels, without distortion
    remarks: tuple[str, ...]  # what was done to it that the user should know


def read_photograph(
    path: Path,
    *,
    lens: Callable[[int, int], Lens],
    size: tuple[int, int] | None,
    background: tuple[float, float, float],
    resolution: float | None,
    mask: Path | None = None,
) -> Photograph:
    """Read one picture.

    `lens` gives the lens for a width and a height; `size` is the (width, height) that the camera file speaks of, None
    where it does not say. `resolution` is the factor on both sides, 0 < resolution <= 1 (None: as it is); pixels are
    averaged over boxes. `mask` is a picture that is black where the photograph shows nothing of the object.
    Raises ValueError naming the file if it is missing or broken, or does not fit its camera or its mask.
    """
    check_resolution(resolution)
    picture, remarks = _fitting(read_picture(path), size, path)
    camera = lens(*(size or picture.size)).resized(*picture.size)
    camera.check(str(path))
    color, alpha = picture.color, picture.alpha
    if mask is not None:
        shown = _mask(mask, picture, path)
        alpha = shown if alpha is None else alpha * shown
    planes = [color]
    if alpha is not None:
        matte = alpha[..., None]
        planes = [color * matte + 255 * (1 - matte) * np.asarray(background, np.float32), 255 * alpha]
    if camera.skew or any((*camera.radial, *camera.denominator, *camera.tangential)):
        remarks = (*remarks, "undistorted")
    remarks = (*picture.remarks, *remarks)
    planes, pinhole = undistorted(planes, camera, str(path))
    shrunk = [_shrink(plane, resolution) for plane in planes]
    return Photograph(
        image=shrunk[0],
        alpha=shrunk[1] if len(shrunk) > 1 else None,
        lens=pinhole.resized(shrunk[0].shape[1], shrunk[0].shape[0]),
        remarks=remarks,
    )


def _fitting(picture: Picture, size: tuple[int, int] | None, path: Path) -> tuple[Picture, tuple[str, ...]]:
    """The picture the way round that its camera means, and what to say of it. Raises ValueError if none fits."""
    stored, shown = picture.size, picture.shown_size
    if picture.turn == 1 and (size is None or stored == size):
        return picture, ()
    as_stored = size is not None and (stored == size or _reduced(stored, size))
    as_shown = size is not None and (shown == size or _reduced(shown, size))
    if picture.turn == 1 and as_stored:
        return picture, ("of another size than their camera file says, so the camera is scaled",)
    if as_stored and not as_shown:
        return picture, ("used as stored, without their EXIF turn: their cameras have that size",)
    if as_shown and not as_stored:
        return picture.shown(), ("turned as their EXIF says",)
    if size is None or as_stored:
        raise ValueError(
            f"{path} carries the EXIF turn {picture.turn}, and the camera file does not tell whether its camera is for "
            "the picture as stored (COLMAP's are) or as shown; remove the turn from the file, or turn the pixels"
        )
    either = f" ({shown[0]} x {shown[1]} as shown)" if shown != stored else ""
    raise ValueError(
        f"{path} has {stored[0]} x {stored[1]} pixels{either}, its camera says {size[0]} x {size[1]}; "
        "camera file and images disagree, resize one of them"
    )


def _reduced(have: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether a picture has the shape of `size` but for a rounding of a pixel, and another scale."""
    same_shape = abs(have[0] * size[1] - have[1] * size[0]) <= max(size)
    return same_shape and all(abs(h / s - 1) > SAME_SCALE for h, s in zip(have, size))


def _mask(path: Path, picture: Picture, of: Path) -> Float32[np.ndarray, "h w"]:
    """0 where the mask is black, 1 where it is white; a mask of zeros and ones means the same."""
    mask = read_picture(path)
    if mask.size != picture.size:
        raise ValueError(
            f"the mask {path} has {mask.size[0]} x {mask.size[1]} pixels, its image {of} {picture.size[0]} x "
            f"{picture.size[1]}; they must agree"
        )
    grey = mask.color.mean(-1)
    return grey / (1.0 if 0 < grey.max() <= 1 else 255.0)


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
    """One matte per image, or none at all: mattes that hide nothing anywhere, as screenshots have, are none.

    Raises ValueError naming the first image that has none when others do.
    """
    present = [a for a in alphas if a is not None]
    if all(bool((a == 255).all()) for a in present):
        return ()
    if present and len(present) < len(alphas):
        odd = names[next(i for i, a in enumerate(alphas) if a is None)]
        raise ValueError(
            f"{odd} has no alpha channel or mask but other images have one; give all images a matte or none"
        )
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
