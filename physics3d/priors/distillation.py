"""Distillation: the gradient that pulls a video towards what a prior holds probable, as a loss.

    L = mean over the targets of  w/2 |z0 - stop(target)|^2,     dL/dz0 = mean of w (z0 - target)

No derivative of the network is taken. What the target is, an estimator says (`estimators/`); that of score
distillation is the prior's estimate x0_hat(alpha z0 + sigma n), Poole et al., DreamFusion (2022), eq. 3; Liu et al.,
Physics3D (2024), eq. 12.

`denoising_loss` is what videos are compared by: the same error, over levels that are spread evenly and always the same
noise. Up to the weights it is the bound that a diffusion model sets on -ln p of a video (Ho et al. 2020, eq. 12), of
which x0_hat is the minimiser; the value of L above is none, for its target changes with the video.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.priors.base import AbstractPrior, Draw, draws
from physics3d.priors.estimators.base import AbstractEstimator

LEVELS = 8  # of noise, at which videos are compared


def distillation_loss(
    prior: AbstractPrior,
    estimator: AbstractEstimator,
    video: Float[Tensor, "t h w 3"],
    condition: Any,
    *,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """L, summed over all entries of the code; `generator` (on the CPU) draws levels and noise."""
    z0 = prior.encode(video)
    with torch.no_grad():
        targets = estimator.targets(prior, z0.detach(), lambda: still_code(prior, video), condition, generator)
    return torch.stack([0.5 * t.weight * ((z0 - t.code) ** 2).sum() for t in targets]).mean()


@torch.no_grad()
def denoising_loss(
    prior: AbstractPrior, video: Float[Tensor, "t h w 3"], condition: Any, *, generator: torch.Generator
) -> float:
    """w/2 |z0 - x0_hat|^2, the mean over LEVELS levels and, of each, a noise and its negative; one draw is enough where
    the estimate does not depend on the noise."""
    z0 = prior.encode(video)
    errors = [
        0.5 * prior.weight(draw.level) * float(((z0 - prior.estimate(z0, draw, condition)) ** 2).sum())
        for draw in comparison(prior, z0, condition, generator)
    ]
    return sum(errors) / len(errors)


def comparison(prior: AbstractPrior, z0: Tensor, condition: Any, generator: torch.Generator) -> list[Draw]:
    """The draws by which videos are compared."""
    if prior.certain(condition):
        return draws(prior, z0, generator, levels=1)
    return draws(prior, z0, generator, levels=LEVELS, mirrored=True)


def still_code(prior: AbstractPrior, video: Float[Tensor, "t h w 3"]) -> Tensor:
    """The code of the video's first frame, standing still for as long."""
    return prior.encode(video[:1].expand_as(video))
