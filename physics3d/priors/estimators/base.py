"""An estimator turns a prior's answers into what a video is pulled to.

dL/dz0 = mean over the targets of  w (z0 - target)                                 (`priors/distillation.py`)
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from physics3d.priors.base import AbstractPrior, Draw, draws


@dataclass(frozen=True)
class Target:
    """What a code is pulled to, and how strongly."""

    weight: float
    code: Tensor


class AbstractEstimator(ABC):
    """Frozen dataclass of options."""

    @property
    def descends(self) -> bool:
        """Whether, where x0_hat does not depend on the noise, the pull is the gradient of the denoising loss: then that
        loss may judge every step."""
        return False

    @abstractmethod
    def target(
        self, prior: AbstractPrior, z0: Tensor, still: Callable[[], Tensor], condition: Any, draw: Draw
    ) -> Target:
        """Of one draw of level and noise; `still` gives the code of the first frame standing still."""

    def targets(
        self,
        prior: AbstractPrior,
        z0: Tensor,
        still: Callable[[], Tensor],
        condition: Any,
        generator: torch.Generator,
    ) -> list[Target]:
        """Of all draws that make one step; one draw, if an estimator does not say otherwise."""
        return [self.target(prior, z0, still, condition, draw) for draw in draws(prior, z0, generator, levels=1)]
