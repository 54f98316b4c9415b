"""Score distillation sampling: the gradient that pulls a video towards what the prior holds probable.

    dL/dz0 = w(level) (z0 - x0_hat(alpha z0 + sigma n))        (no derivative of the network)

It is delivered as L = w/2 |z0 - stop(x0_hat)|^2, whose gradient is exactly this and whose value says how far the
video is from the prior's estimate. In terms of the noise, z0 - x0_hat = (sigma/alpha) (n_hat - n).

Poole et al., DreamFusion (2022), eq. 3; Liu et al., Physics3D (2024), eq. 12.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.priors.base import AbstractPrior


def sds_loss(
    prior: AbstractPrior, video: Float[Tensor, "t h w 3"], condition: Any, *, generator: torch.Generator
) -> Float[Tensor, ""]:
    """L above, summed over all entries of the code; `generator` (on the CPU) draws level and noise."""
    z0 = prior.encode(video)
    with torch.no_grad():
        level = prior.level(generator)
        noise = torch.randn(z0.shape, generator=generator).to(z0)
        estimate = prior.x0_hat(level.alpha * z0 + level.sigma * noise, level, condition)
    return 0.5 * prior.weight(level) * ((z0 - estimate) ** 2).sum()
