"""The loss of learning: theta -> motion -> video -> what the prior says of it.

    L(theta) = 1/N sum_views sds(video(theta)) + stay/2 L_0 |theta|^2,     L_0 = the first term at the start, N pixels

`Chain.loss` is the first term, differentiable through prior, renderer and the whole trajectory, every substep of it.
Those who descend add the second, each in its way (`fit.py`, `polish.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.priors.base import AbstractPrior
from physics3d.priors.sds import sds_loss


@dataclass(frozen=True, kw_only=True)
class Chain:
    """theta -> motion -> video -> loss."""

    simulate: Callable[[Tensor], Any]  # theta [k] -> trajectory
    render: Callable[
        [Any, int, Tensor], Float[Tensor, "t h w 3"]
    ]  # trajectory, view, indices of frames -> clip in 0..1
    clips: dict[int, Float[Tensor, "t h w 3"]]  # view -> recorded clip
    prior: AbstractPrior
    # theta [k], ln of a factor on every known force -> trajectory; None: no force is known that drives the motion
    pushed: Callable[[Tensor, float], Any] | None = None

    def loss(self, theta: Tensor, views: list[int], frames: Tensor, generator: torch.Generator) -> Tensor:
        """The first term of L, differentiable in theta."""
        motion, total, pixels = self.simulate(theta), 0.0, 0
        for view in views:
            clip = self.clips[view]
            condition = self.prior.condition(clip[0], (clip[frames],))
            total = total + sds_loss(self.prior, self.render(motion, view, frames), condition, generator=generator)  # type: ignore[assignment]
            pixels += clip[frames].numel()
        return total / pixels  # type: ignore[return-value]

    def measure(self, theta: Tensor, seed: int) -> float:
        """The first term of L over all views and frames, always with the same noise."""
        frames = torch.arange(len(next(iter(self.clips.values()))))
        with torch.no_grad():
            return float(self.loss(theta, list(self.clips), frames, torch.Generator().manual_seed(seed)))
