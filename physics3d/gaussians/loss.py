"""How far a drawn picture is from its photograph: the loss of reconstruction, and the PSNR that a fit is judged by.

    loss = (1 - s) |image - photograph|_1 + s (1 - SSIM) + a |alpha - matte|_1 + the densification's penalty

s = `ssim_weight`; a = `MATTE_WEIGHT` where there are mattes, which makes empty space transparent.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.photograph import Photograph
from physics3d.gaussians.render import render
from physics3d.gaussians.ssim import ssim

MATTE_WEIGHT = 0.2  # of the error in alpha, in the loss


def reconstruction_loss(
    image: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    truth: Float[Tensor, "h w 3"],
    matte: Float[Tensor, "h w"] | None,
    *,
    penalty: Float[Tensor, ""],
    ssim_weight: float,
) -> Float[Tensor, ""]:
    """The loss above of one picture, all in 0..1; `truth` on the same background as the image."""
    loss = (1 - ssim_weight) * (image - truth).abs().mean() + penalty
    if ssim_weight > 0:
        loss = loss + ssim_weight * (1 - ssim(image, truth))
    if matte is not None:
        loss = loss + MATTE_WEIGHT * (alpha - matte).abs().mean()
    return loss


def psnr(image: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio of pictures in 0..1 [dB]."""
    return -10 * math.log10(max(float((image.clamp(0, 1) - truth).square().mean()), 1e-12))


def held_out_psnr(gaussians: Gaussians, photographs: list[Photograph], background: Tensor) -> float:
    """Mean PSNR [dB] over photographs, on one background."""
    with torch.no_grad():
        values = [psnr(render(gaussians, p.camera, background=background).color, p.on(background)) for p in photographs]
    return sum(values) / len(values)
