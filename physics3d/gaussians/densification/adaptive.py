"""Transparent Gaussians are removed, and those that draw the most error are split in two along their longest axis.

    e_i = sum over pixels of (blending weight x absolute error)

After Rota Bulo et al. (2024), "Revising densification in Gaussian splatting".
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


@dataclass(frozen=True, kw_only=True)
class Adaptive(AbstractDensification):
    every: Count = 100
    faded: Factor = 0.02  # opacity below which a Gaussian is removed
    opacity_weight: NotNegative = 0.01  # of the mean opacity, in the loss

    def penalty(self, model: Gaussians, extent: float) -> Float[Tensor, ""]:
        return self.opacity_weight * model.opacity.mean()

    def stirred(self, model: Gaussians, step: float, generator: torch.Generator) -> Gaussians:
        return model

    def renewed(
        self, model: Gaussians, moments: Moments, error: Callable[[], Tensor], wanted: int, generator: torch.Generator
    ) -> Gaussians:
        with torch.no_grad():
            keep = torch.nonzero(model.opacity > self.faded)[:, 0]
            require_some(keep)
            count = max(0, min(wanted - len(keep), len(keep)))
            split = torch.zeros(len(model), dtype=torch.bool, device=keep.device)
            if count:
                split[keep[torch.topk(error()[keep], count).indices]] = True
            model, parents = model.select(torch.cat([keep, torch.nonzero(split)[:, 0]])), split[keep]
            twin = torch.cat([parents, torch.ones(count, dtype=torch.bool, device=keep.device)])
            side = torch.ones(len(model), device=keep.device)
            side[len(keep) :] = -1
            # two halves of the longest axis: centres 0.5 sigma from the middle, 0.6 times as long, 0.85 as thick
            longest = torch.nn.functional.one_hot(model.log_scale.argmax(-1), 3).to(model.mean)
            axis = torch.einsum("nij,nj->ni", model.rotation(), longest * torch.exp(model.log_scale))
            thinner = math.log(0.85) + (math.log(0.6) - math.log(0.85)) * longest
            mean = torch.where(twin[:, None], model.mean + 0.5 * side[:, None] * axis, model.mean)
            log_scale = torch.where(twin[:, None], model.log_scale + thinner, model.log_scale)
            for name, pair in moments.items():
                moments[name] = tuple(torch.cat([a[keep], torch.zeros_like(a[:count])]) for a in pair)  # type: ignore[assignment]
        return replace(model, mean=mean, log_scale=log_scale)
