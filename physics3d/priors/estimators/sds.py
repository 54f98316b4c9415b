"""Score distillation sampling (Poole et al., DreamFusion 2022): the target is the prior's estimate of the clean video.

target = x0_hat(alpha z0 + sigma n);     z0 - x0_hat = (sigma/alpha) (n_hat - n)
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from physics3d.priors.base import AbstractPrior, Draw
from physics3d.priors.estimators.base import AbstractEstimator, Target


@dataclass(frozen=True, kw_only=True)
class ScoreDistillation(AbstractEstimator):
    @property
    def descends(self) -> bool:
        return True

    def target(
        self, prior: AbstractPrior, z0: Tensor, still: Callable[[], Tensor], condition: Any, draw: Draw
    ) -> Target:
        return Target(prior.weight(draw.level), prior.estimate(z0, draw, condition))
