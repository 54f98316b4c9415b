"""Where Gaussians are added while they are fitted, and which are removed: one way per file, chosen by configuration."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import require_fields
from physics3d.gaussians.adam import Moments
from physics3d.gaussians.model import Gaussians


class AbstractDensification:
    """A frozen dataclass with `every`: iterations between two calls of `renewed`."""

    every: int

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "densification")

    def renewed(
        self, model: Gaussians, moments: Moments, error: Callable[[], Tensor], wanted: int, generator: torch.Generator
    ) -> Gaussians:
        """The model with up to `wanted` Gaussians, `moments` changed to match; `error` gives e_i [n], at some cost.

        Raises ValueError if every Gaussian has faded.
        """
        raise NotImplementedError

    def penalty(self, model: Gaussians, extent: float) -> Float[Tensor, ""]:
        """What is added to the loss, so that Gaussians that do not help fade; `extent` [m] of the cameras."""
        raise NotImplementedError

    def stirred(self, model: Gaussians, step: float, generator: torch.Generator) -> Gaussians:
        """Called after each step of descent; `step` is the step of positions over the extent of the scene [1/m]."""
        raise NotImplementedError


def require_some(alive: Tensor) -> None:
    if len(alive) == 0:
        raise ValueError("every Gaussian faded away; check the photographs' cameras, or give the capture points")
