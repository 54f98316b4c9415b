"""The score of the clip minus that of its first frame standing still, by the same noise: motion distillation (Huang et
al., DreamPhysics 2024, eq. 8).

    z0 - target = (z0 - x0_hat(alpha z0 + sigma n)) - (s0 - x0_hat(alpha s0 + sigma n)),   s0 = encode(still clip)

What the prior holds against colours, background and renderer is in both scores and cancels, and so does most of the
noise's share. The price is a bias. The pull vanishes at the still clip itself, whatever the prior. And where x0_hat
does not depend on z_t, as with one exemplar or at much noise, z0 - target = z0 - s0: the difference stills the motion
of a prior that knows the right clip exactly, while plain score distillation goes there (`docs/results/priors.md`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from physics3d.priors.base import AbstractPrior, Draw
from physics3d.priors.estimators.base import AbstractEstimator, Target


@dataclass(frozen=True, kw_only=True)
class MovingMinusStill(AbstractEstimator):
    def target(
        self, prior: AbstractPrior, z0: Tensor, still: Callable[[], Tensor], condition: Any, draw: Draw
    ) -> Target:
        s0 = still()
        moving, at_rest = (prior.estimate(code, draw, condition) for code in (z0, s0))
        return Target(prior.weight(draw.level), moving + s0 - at_rest)
