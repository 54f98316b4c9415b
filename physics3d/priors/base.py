"""A video prior knows what videos look like: it takes noise off a noisy one.

Every denoising model, whatever its network predicts, is brought to one form. A video x becomes a clean code z0 =
encode(x), is noised to

    z_t = alpha z0 + sigma n,   n ~ N(0, I)

and `x0_hat(z_t)` is the prior's estimate of z0. Networks differ in what they put out (r^2 = alpha^2 + sigma^2):

    epsilon         n                                   x0 = (z_t - sigma out) / alpha
    v_prediction    (alpha n - sigma z0) / r            x0 = (alpha z_t / r - sigma out) / r
    flow_prediction n - z0                              x0 = (z_t - sigma out) / (alpha + sigma)

v: Salimans and Ho (2022); flow: Lipman et al. (2023), the velocity of a straight line from picture to noise. Stable
Video Diffusion is v_prediction with alpha = 1, ModelScope is epsilon with alpha^2 + sigma^2 = 1, Wan is flow_prediction
with alpha + sigma = 1.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.priors.memory import Memory


@dataclass(frozen=True, kw_only=True)
class Level:
    """How much noise: z_t = alpha z0 + sigma n."""

    alpha: float
    sigma: float
    time: float = 0.0  # what the network is told (index of the schedule, or ln(sigma)/4)


@dataclass(frozen=True)
class Draw:
    """One level and one noise."""

    level: Level
    noise: Tensor


class AbstractPrior(ABC):
    """Frozen dataclass of options; weights are loaded at the first use. Videos are float [t, h, w, 3] in 0..1, sRGB."""

    needs_clip: ClassVar[bool] = False  # whether it knows nothing but the clips of `condition`

    @property
    def trained_frames(self) -> int | None:
        """So many frames had the clips that it was trained on; None: any number is as good."""
        return None

    def require_frames(self, frames: int) -> None:
        """Raises ValueError, naming the nearest right numbers, if it cannot be shown clips of so many frames."""
        return None

    def memory(self, frames: int) -> Memory | None:
        """What it will take to show it clips of so many frames, known before its weights are loaded; None: next to
        nothing. Raises ValueError if the model's files are not there, or do not fit its options."""
        return None

    @abstractmethod
    def condition(self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]) -> Any:
        """What the prior is told besides the noisy video: first image of the take, recorded clips, or a text."""

    @abstractmethod
    def encode(self, video: Float[Tensor, "t h w 3"]) -> Tensor:
        """Video -> code z0, differentiable. Raises ValueError if the prior cannot take so many frames or this size."""

    @abstractmethod
    def level(self, share: float) -> Level:
        """The noise level that `share` of all draws (0..1) lie below: its quantile function."""

    @abstractmethod
    def x0_hat(self, z_t: Tensor, level: Level, condition: Any) -> Tensor:
        """The prior's estimate of z0 from z_t."""

    def estimate(self, z0: Tensor, draw: Draw, condition: Any) -> Tensor:
        """The prior's estimate of z0 from z0 under the noise of the draw."""
        return self.x0_hat(draw.level.alpha * z0 + draw.level.sigma * draw.noise, draw.level, condition)

    def certain(self, condition: Any) -> bool:
        """Whether x0_hat is the same whatever the noise: then one draw says all."""
        return False

    def weight(self, level: Level) -> float:
        """w of the SDS gradient w (z0 - x0_hat): DreamFusion's sigma^2 (n_hat - n), with z_t scaled by 1/r."""
        return level.alpha * level.sigma / (level.alpha**2 + level.sigma**2)


def draws(
    prior: AbstractPrior, like: Tensor, generator: torch.Generator, *, levels: int, mirrored: bool = False
) -> list[Draw]:
    """`levels` draws, one from each of as many equally probable ranges of the noise; `mirrored`: and as many more with
    the negatives of their noises. `generator` is on the CPU, so that every device sees the same."""
    shares = [(i + float(torch.rand((), generator=generator))) / levels for i in range(levels)]
    one = [Draw(prior.level(share), torch.randn(like.shape, generator=generator).to(like)) for share in shares]
    return one + [Draw(draw.level, -draw.noise) for draw in one] if mirrored else one


def x0_from(prediction: str, output: Tensor, z_t: Tensor, level: Level) -> Tensor:
    """Network output -> estimate of z0 (table above). Raises ValueError for an unknown kind of prediction."""
    alpha, sigma, r = level.alpha, level.sigma, math.hypot(level.alpha, level.sigma)
    match prediction:
        case "epsilon":
            return (z_t - sigma * output) / alpha
        case "v_prediction":
            return (alpha * z_t / r - sigma * output) / r
        case "flow_prediction":
            return (z_t - sigma * output) / (alpha + sigma)
    raise ValueError(
        f"prediction is {prediction!r}; known are epsilon, v_prediction and flow_prediction; take weights whose "
        "scheduler has one of these as its prediction_type"
    )
