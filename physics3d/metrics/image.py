"""Likeness of two clips, frame against frame: PSNR, SSIM, MS-SSIM (colour in 0..1).

PSNR is that of the mean squared error of the whole clip [dB], infinite for identical clips; SSIM (Wang et al. 2004)
and MS-SSIM (Wang et al. 2003, at each scale half as many pixels along each side as at the one before) are means over
frames and colours,

    l = (2 mx my + c1)/(mx^2 + my^2 + c1),     c = (2 sxy + c2)/(sx^2 + sy^2 + c2)
    SSIM = mean l c,     MS-SSIM = mean(l c)_5^b_5 prod_{k < 5} mean(c)_k^b_k

with means m and covariances s in a Gaussian window of 1.5 px. As in torchmetrics, whose numbers these are, pictures are
continued by reflection, and the mean of c leaves out where the window meets that.

All three reward a picture that stands still: read them beside the frozen first frame and the measures of `motion.py`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.cores import spread

WINDOW, RADIUS = 1.5, 5  # standard deviation and reach [px]
C1, C2 = 0.01**2, 0.03**2
SHARES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # b_k, finest scale first
MS_SSIM_SIDE = 176  # [px] five scales of an 11 px window


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """Of every frame with its reference."""

    error: list[float]  # mean squared, of colours in 0..1
    ssim: list[float]
    ms_ssim: list[float] | None  # None: five scales do not fit
    why: str  # ... and why not

    @property
    def psnr(self) -> float:
        """Of the whole clip [dB]."""
        return decibel(mean(self.error))

    @property
    def psnr_per_frame(self) -> list[float]:
        """Of every frame [dB], at most 100."""
        return [min(100.0, decibel(error)) for error in self.error]


def likeness(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> Likeness:
    """All of these at once, frames spread over the cores. Raises ValueError for unequal shapes."""
    check_pair(video, reference)
    h, w = video.shape[1:3]
    fits = min(h, w) >= MS_SSIM_SIDE
    told = per_frame(video, reference, lambda a, b: (squared_error(a, b), *_similarity(a, b, fits)))
    return Likeness(
        error=[error for error, _, _ in told],
        ssim=[fine for _, fine, _ in told],
        ms_ssim=[many for _, _, many in told] if fits else None,
        why="" if fits else f"MS-SSIM needs both sides >= {MS_SSIM_SIDE} px, the pictures are {w} x {h}",
    )


def psnr(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> float:
    """10 log10(1/MSE) [dB] over all pixels of all frames. Raises ValueError for unequal shapes."""
    check_pair(video, reference)
    return decibel(mean(per_frame(video, reference, squared_error)))


def ssim(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> float:
    """Mean over frames. Raises ValueError for unequal shapes."""
    return mean(likeness(video, reference).ssim)


def ms_ssim(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> tuple[float | None, str]:
    """(mean over frames, "") or (None, reason) where five scales do not fit. ValueError for unequal shapes."""
    found = likeness(video, reference)
    return None if found.ms_ssim is None else mean(found.ms_ssim), found.why


def check_pair(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> None:
    """Raise ValueError if the two are not clips of equal shape."""
    if video.dtype != torch.uint8 or reference.dtype != torch.uint8 or video.ndim != 4 or video.shape[-1] != 3:
        raise ValueError(
            f"clips must be uint8 [t, h, w, 3], not {video.dtype} {tuple(video.shape)} and {reference.dtype}"
        )
    if video.shape != reference.shape or len(video) == 0:
        raise ValueError(
            f"cannot compare a clip {tuple(video.shape)} with a reference {tuple(reference.shape)}; render the same "
            "frames and pixels, or shrink both to the smaller"
        )


def decibel(mse: float) -> float:
    return math.inf if mse == 0 else -10 * math.log10(mse)


def mean(values: list[float]) -> float:
    return sum(values) / len(values)


def per_frame(video: Tensor, reference: Tensor, measure: Callable[[np.ndarray, np.ndarray], Any]) -> list[Any]:
    """`measure` of every pair of frames, spread over the cores."""
    return spread(measure, video.cpu().numpy(), reference.cpu().numpy())


def squared_error(a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h w 3"]) -> float:
    """Mean over pixels and colours, in 0..1."""
    import cv2

    return cv2.norm(np.ascontiguousarray(a), np.ascontiguousarray(b), cv2.NORM_L2SQR) / a.size / 255**2


def _similarity(a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h w 3"], fits: bool) -> tuple[float, float]:
    """(SSIM, MS-SSIM, or NaN if it is not wanted) of two pictures."""
    x, y = (picture.astype(np.float32) / 255 for picture in (a, b))
    whole, contrast = _structure(x, y)
    fine, product = whole, max(contrast, 0.0) ** SHARES[0]
    if not fits:
        return fine, math.nan
    for share in SHARES[1:]:
        x, y = _halved(x), _halved(y)
        whole, contrast = _structure(x, y)
        product *= max(whole if share is SHARES[-1] else contrast, 0.0) ** share
    return fine, product


def _structure(x: Float[np.ndarray, "h w 3"], y: Float[np.ndarray, "h w 3"]) -> tuple[float, float]:
    """(mean of l c, mean of c) of two pictures at one scale."""
    import cv2

    side = 2 * RADIUS + 1
    blur = lambda z: cv2.GaussianBlur(z, (side, side), WINDOW, borderType=cv2.BORDER_REFLECT_101)
    d = x - y  # 2 sxy = sx^2 + sy^2 - sd^2: pictures that are the same have exactly 1
    mx, my, xx, yy, dd = (blur(z) for z in (x, y, x * x, y * y, d * d))
    mxx, myy = mx * mx, my * my
    varied = np.maximum(xx - mxx, 0) + np.maximum(yy - myy, 0) + np.float32(C2)
    contrast = 1 - np.maximum(dd - (mx - my) ** 2, 0) / varied
    whole = (2 * mx * my + np.float32(C1)) / (mxx + myy + np.float32(C1)) * contrast
    inside = contrast[RADIUS:-RADIUS, RADIUS:-RADIUS]
    return float(whole.mean(dtype=float)), float(inside.mean(dtype=float)) if inside.size else 0.0


def _halved(x: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "H W 3"]:
    """Means over 2 x 2 pixels; an odd row or column at the end is left out."""
    h, w = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
    return (x[0:h:2, 0:w:2] + x[1:h:2, 0:w:2] + x[0:h:2, 1:w:2] + x[1:h:2, 1:w:2]) / 4
