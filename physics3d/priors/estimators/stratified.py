"""The mean of another estimator over several levels at once, each with a noise and its negative: the same expectation
at less variance.

The levels are one from each of `levels` equally probable ranges (stratified sampling), so that no step sees much noise
only; and what of x0_hat(alpha z0 + sigma n) is linear in n cancels between n and -n (antithetic variates). A step costs
2 `levels` times that of one draw.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from annotated_types import Ge, Le
from torch import Tensor

from physics3d.checks import require_fields
from physics3d.priors.base import AbstractPrior, Draw, draws
from physics3d.priors.estimators.base import AbstractEstimator, Target


@dataclass(frozen=True, kw_only=True)
class Stratified(AbstractEstimator):
    of: AbstractEstimator  # whose draws are averaged
    levels: Annotated[int, Ge(1), Le(1000)] = 4  # of noise in a step, one from each of so many equally probable ranges

    def __post_init__(self):
        require_fields(self, "estimator")

    @property
    def descends(self) -> bool:
        return self.of.descends

    def target(
        self, prior: AbstractPrior, z0: Tensor, still: Callable[[], Tensor], condition: Any, draw: Draw
    ) -> Target:
        return self.of.target(prior, z0, still, condition, draw)

    def targets(
        self,
        prior: AbstractPrior,
        z0: Tensor,
        still: Callable[[], Tensor],
        condition: Any,
        generator: torch.Generator,
    ) -> list[Target]:
        every = draws(prior, z0, generator, levels=self.levels, mirrored=True)
        return [self.target(prior, z0, still, condition, draw) for draw in every]
