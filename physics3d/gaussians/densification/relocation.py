"""Faded Gaussians move to where others are, chosen with probability ~ opacity: a Markov chain Monte Carlo.

The N Gaussians that then lie on top of each other draw what one drew, because

    o' = 1 - (1 - o)^(1/N),     scale' = scale o / sum_{i=1..N} sum_{k<i} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1)

and between these moves every faint Gaussian takes random steps of covariance ~ Sigma^2, which explore.
Kheradmand et al. (2024), "3D Gaussian splatting as Markov chain Monte Carlo".
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import Count, Factor, NotNegative
from physics3d.gaussians.adam import Moments
from physics3d.gaussians.densification.base import AbstractDensification, require_some
from physics3d.gaussians.model import Gaussians

MOST_COPIES = 50  # N above which the scale is not corrected any further


@dataclass(frozen=True, kw_only=True)
class Relocation(AbstractDensification):
    every: Count = 100
    faded: Factor = 0.005  # opacity below which a Gaussian moves elsewhere
    opacity_weight: NotNegative = 0.01  # of the mean opacity, in the loss
    scale_weight: NotNegative = 0.03  # of the mean scale over the extent of the scene, in the loss
    noise: NotNegative = 8e4  # of the random steps: sigma = noise * step size * Sigma / extent

    def penalty(self, model: Gaussians, extent: float) -> Float[Tensor, ""]:
        return (
            self.opacity_weight * model.opacity.mean() + self.scale_weight / extent * torch.exp(model.log_scale).mean()
        )

    def stirred(self, model: Gaussians, step: float, generator: torch.Generator) -> Gaussians:
        with torch.no_grad():
            faint = torch.sigmoid(100 * (self.faded - model.opacity))
            noise = (
                torch.randn(model.mean.shape, generator=generator).to(model.mean) * (self.noise * step * faint)[:, None]
            )
            return replace(model, mean=model.mean + torch.einsum("nij,nj->ni", model.covariance(), noise))

    def renewed(
        self, model: Gaussians, moments: Moments, error: Callable[[], Tensor], wanted: int, generator: torch.Generator
    ) -> Gaussians:
        with torch.no_grad():
            opacity, n = model.opacity, len(model)
            dead, alive = torch.nonzero(opacity <= self.faded)[:, 0], torch.nonzero(opacity > self.faded)[:, 0]
            require_some(alive)
            count = len(dead) + max(0, min(wanted - n, n))
            if not count:
                return model
            drawn = torch.multinomial(opacity[alive].cpu(), count, replacement=True, generator=generator)
            source = alive[drawn.to(alive.device)]
            copies = 1 + torch.bincount(source, minlength=n)
            several = copies > 1
            thinner, smaller = shared(opacity[several], copies[several])
            opacity_logit, log_scale = model.opacity_logit.clone(), model.log_scale.clone()
            opacity_logit[several] = torch.logit(thinner.clamp(self.faded, 1 - 1e-6))
            log_scale[several] += torch.log(smaller)[:, None]
            order = torch.cat([torch.arange(n, device=source.device), source[len(dead) :]])
            order[dead] = source[: len(dead)]
            for name, pair in moments.items():
                moments[name] = tuple(torch.where(_beside(several, a), 0, a)[order] for a in pair)  # type: ignore[assignment]
        return replace(model, opacity_logit=opacity_logit, log_scale=log_scale).select(order)


def shared(opacity: Float[Tensor, " n"], copies: Tensor) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Opacity of each of `copies` [n] equal Gaussians, and the factor on their scale, that draw one of `opacity`.

    Together: the integral of what they draw along a line through the centre is the same as before.
    """
    N = copies.clamp(1, MOST_COPIES)
    each = 1 - (1 - opacity.double()) ** (1 / N)
    total = torch.zeros_like(each)
    for i in range(1, int(N.max()) + 1):
        k = torch.arange(i, dtype=torch.float64, device=each.device)
        binomial = torch.tensor([math.comb(i - 1, j) for j in range(i)], dtype=torch.float64, device=each.device)
        terms = binomial * (-1.0) ** k / torch.sqrt(k + 1) * each[:, None] ** (k + 1)
        total += torch.where(i <= N, terms.sum(-1), 0)
    return each.to(opacity), (opacity.double() / total).to(opacity)


def _beside(mask: Tensor, a: Tensor) -> Tensor:
    """`mask` [n] with as many dimensions as `a`."""
    return mask.reshape(-1, *[1] * (a.ndim - 1))
