"""Exemplar prior: the exact denoiser of a finite set of recorded clips; no weights, no approximation.

    D(z_t; s) = sum_i p_i y_i,   p = softmax_i( -|z_t - y_i|^2 / (2 s^2) ),   y_i = encode(clip_i)

the posterior mean of z0 when z0 is one of the y_i with equal probability: the minimiser of the denoising loss on that
set (Karras et al. 2022, eq. 57). With one clip x0_hat = y whatever the noise, so SDS is the gradient of w/2
|encode(x) - y|^2, known in closed form: the whole chain prior -> renderer -> simulator can be checked against it. Its
weight w is 1.

The code is a pyramid of low-passed videos, A x: for each `blur` s_b [px] a Gaussian filter of that standard
deviation, sampled every max(1, round(s_b)) pixels and multiplied by that stride, so that its squared norm stays an
integral over the image. It is linear, hence this is the exact denoiser of the filtered clips. A small thing that
moves by more than its own width leaves no gradient in a sharp image (the two pictures do not overlap); blurred by the
size of the motion they do. Nothing is lost for accuracy: a blurred picture still moves by a hundredth of a pixel when
the thing does. `blur: [0.0]` compares plain pixels.
"""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import MinLen
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import Ascending, NotNegative, Positive, require_fields
from physics3d.priors.base import AbstractPrior, Level


@dataclass(frozen=True, kw_only=True)
class Exemplar(AbstractPrior):
    needs_clip: ClassVar[bool] = True

    # standard deviations of the low-pass [px of the video given]
    blur: Annotated[tuple[NotNegative, ...], MinLen(1)] = (1.0, 4.0)
    # noise levels, drawn uniformly in the logarithm (matters with several clips)
    sigma: Annotated[tuple[Positive, Positive], Ascending()] = (0.1, 10.0)

    def __post_init__(self):
        require_fields(self, "prior")

    def condition(
        self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]
    ) -> Float[Tensor, "m d"]:
        """The codes of the clips. Raises ValueError without clips or if their sizes differ."""
        if not clips or len({clip.shape for clip in clips}) != 1:
            raise ValueError(
                f"the exemplar prior got clips of shapes {[tuple(c.shape) for c in clips]}; it needs one or "
                "more of equal shape (a take with role learn), or choose another prior"
            )
        return torch.stack([self.encode(clip) for clip in clips])

    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, " d"]:
        return torch.cat([lowpass(video, blur).flatten() for blur in self.blur])

    def level(self, share: float) -> Level:
        low, high = (math.log(s) for s in self.sigma)
        return Level(alpha=1.0, sigma=math.exp(low + (high - low) * share))

    def certain(self, condition: Float[Tensor, "m d"]) -> bool:
        return len(condition) == 1

    def x0_hat(self, z_t: Tensor, level: Level, condition: Float[Tensor, "m d"]) -> Float[Tensor, " d"]:
        if condition.shape[1:] != z_t.shape:
            raise ValueError(
                f"the video's code has {tuple(z_t.shape)} numbers, the exemplars' {tuple(condition.shape[1:])}; "
                "render as many frames and pixels as the clips have"
            )
        if len(condition) == 1:
            return condition[0]
        # in float64: the squared distances are sums of 1e6 terms and only their differences count
        distance = ((level.alpha * condition.double() - z_t.double()) ** 2).sum(1)
        p = torch.softmax(-distance / (2 * level.sigma**2), 0)  # torch's softmax subtracts the largest exponent
        return (p[:, None] * condition).sum(0).to(z_t.dtype)

    def weight(self, level: Level) -> float:
        return 1.0


def lowpass(video: Float[Tensor, "t h w 3"], blur: float) -> Float[Tensor, "t c H W"]:
    """Gaussian filter of standard deviation `blur` [px], borders repeat; every s-th pixel times s = round(blur)."""
    frames = video.permute(0, 3, 1, 2)
    if blur == 0:
        return frames
    stride, radius = max(1, round(blur)), math.ceil(3 * blur)
    x = torch.arange(-radius, radius + 1, dtype=video.dtype, device=video.device)
    kernel = torch.exp(-0.5 * (x / blur) ** 2)
    kernel = kernel / kernel.sum()
    t, c, h, w = frames.shape
    flat = torch.nn.functional.pad(frames.reshape(t * c, 1, h, w), (radius,) * 4, mode="replicate")
    flat = torch.nn.functional.conv2d(flat, kernel[None, None, :, None], stride=(stride, 1))
    flat = torch.nn.functional.conv2d(flat, kernel[None, None, None, :], stride=(1, stride))
    return stride * flat.reshape(t, c, *flat.shape[-2:])
