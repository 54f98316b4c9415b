"""A video prior knows what videos look like: it takes noise off a noisy one.

Every denoising model, whatever its network predicts, is brought to one form. A video x becomes a clean code z0 =
encode(x), is noised to

    z_t = alpha z0 + sigma n,   n ~ N(0, I)

and `x0_hat(z_t)` is the prior's estimate of z0. Networks differ in what they put out (r^2 = alpha^2 + sigma^2):

    epsilon         n                                   x0 = (z_t - sigma out) / alpha
    v_prediction    (alpha n - sigma z0) / r            x0 = (alpha z_t / r - sigma out) / r

v: Salimans and Ho (2022). Stable Video Diffusion is v_prediction with alpha = 1, ModelScope is epsilon with
alpha^2 + sigma^2 = 1.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Level:
    """How much noise: z_t = alpha z0 + sigma n."""

    alpha: float
    sigma: float
    time: float = 0.0  # what the network is told (index of the schedule, or ln(sigma)/4)


class AbstractPrior(ABC):
    """Frozen dataclass of options; weights are loaded at the first use. Videos are float [t, h, w, 3] in 0..1, sRGB."""

    @abstractmethod
    def condition(self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]) -> Any:
        """What the prior is told besides the noisy video: first image of the take, recorded clips, or a text."""

    @abstractmethod
    def encode(self, video: Float[Tensor, "t h w 3"]) -> Tensor:
        """Video -> code z0, differentiable. Raises ValueError if the prior cannot take so many frames or this size."""

    @abstractmethod
    def level(self, generator: torch.Generator) -> Level:
        """Draw a noise level."""

    @abstractmethod
    def x0_hat(self, z_t: Tensor, level: Level, condition: Any) -> Tensor:
        """The prior's estimate of z0 from z_t."""

    def weight(self, level: Level) -> float:
        """w of the SDS gradient w (z0 - x0_hat): DreamFusion's sigma^2 (n_hat - n), with z_t scaled by 1/r."""
        return level.alpha * level.sigma / (level.alpha**2 + level.sigma**2)


def x0_from(prediction: str, output: Tensor, z_t: Tensor, level: Level) -> Tensor:
    """Network output -> estimate of z0 (table above). Raises ValueError for an unknown kind of prediction."""
    alpha, sigma, r = level.alpha, level.sigma, math.hypot(level.alpha, level.sigma)
    match prediction:
        case "epsilon":
            return (z_t - sigma * output) / alpha
        case "v_prediction":
            return (alpha * z_t / r - sigma * output) / r
    raise ValueError(
        f"prediction is {prediction!r}; known are epsilon and v_prediction; take weights whose scheduler has one of "
        "these as its prediction_type"
    )
