"""Likeness of two clips, frame against frame: PSNR, SSIM, MS-SSIM (torchmetrics; colour in 0..1).

PSNR is that of the mean squared error of the whole clip [dB], infinite for identical clips; SSIM (Wang et al. 2004)
and MS-SSIM (Wang et al. 2003) are means over frames. All three reward a picture that stands still: read them beside
the frozen first frame and the measures of `motion.py`.
"""

import math

import torch
from jaxtyping import UInt8
from torch import Tensor

MS_SSIM_SIDE = 176  # [px] five scales of an 11 px window
CHUNK = 8  # frames at a time, bounds the memory


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


def psnr(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> float:
    """10 log10(1/MSE) [dB] over all pixels of all frames. Raises ValueError for unequal shapes."""
    check_pair(video, reference)
    total = sum(float(((a.double() - b.double()) ** 2).sum()) for a, b in zip(video, reference))
    return decibel(total / video.numel() / 255**2)


def psnr_per_frame(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> list[float]:
    """10 log10(1/MSE) [dB] of every frame, at most 100. Raises ValueError for unequal shapes."""
    check_pair(video, reference)
    errors = [float(((a.double() - b.double()) ** 2).mean()) / 255**2 for a, b in zip(video, reference)]
    return [min(100.0, decibel(error)) for error in errors]


def decibel(mse: float) -> float:
    return math.inf if mse == 0 else -10 * math.log10(mse)


def ssim(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> float:
    """Mean over frames. Raises ValueError for unequal shapes."""
    values = ssim_per_frame(video, reference)
    return sum(values) / len(values)


def ms_ssim(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> tuple[float | None, str]:
    """(mean over frames, "") or (None, reason) where five scales do not fit. ValueError for unequal shapes."""
    from torchmetrics.functional.image import multiscale_structural_similarity_index_measure as measure

    check_pair(video, reference)
    h, w = video.shape[1:3]
    if min(h, w) < MS_SSIM_SIDE:
        return None, f"MS-SSIM needs both sides >= {MS_SSIM_SIDE} px, the pictures are {w} x {h}"
    return frame_mean(video, reference, lambda a, b: measure(a, b, data_range=1.0, reduction="none")), ""


def ssim_per_frame(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> list[float]:
    """Raises ValueError for unequal shapes."""
    from torchmetrics.functional.image import structural_similarity_index_measure as measure

    return per_frame(video, reference, lambda a, b: measure(a, b, data_range=1.0, reduction="none"))


def per_frame(video, reference, measure) -> list[float]:
    check_pair(video, reference)
    values: list[float] = []
    for a, b in zip(video.split(CHUNK), reference.split(CHUNK)):
        values += measure(a.permute(0, 3, 1, 2) / 255, b.permute(0, 3, 1, 2) / 255).reshape(-1).tolist()
    return values


def frame_mean(video, reference, measure) -> float:
    values = per_frame(video, reference, measure)
    return sum(values) / len(values)
