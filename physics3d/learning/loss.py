"""The loss of learning: theta -> motion -> video -> what the prior says of it.

    L(theta) = 1/N sum_views distillation(video(theta)) + stay/2 L_0 |theta|^2,     N pixels

`Chain.loss` is the first term, differentiable through prior, renderer and the whole trajectory, every substep of it.
Those who descend add the second, each in its way (`fit.py`, `polish.py`). `Chain.measure` is what two theta are
compared by, the denoising loss by always the same noise (`priors/distillation.py`); L_0 is that at the start. With a
prior whose estimate does not depend on the noise both are the same; of a diffusion model single values of `loss` tell
nothing.

All that takes long is asked of the chain's journal, and within that every motion, so that a learning that was stopped
goes on where it was.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.journal import Journal
from physics3d.log import Log
from physics3d.priors.base import AbstractPrior
from physics3d.priors.distillation import denoising_loss, distillation_loss
from physics3d.priors.estimators.base import AbstractEstimator
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.trajectory import NotMoved

COARSER = 1.25  # cells of a grid that shows what cells do


@dataclass(frozen=True, kw_only=True)
class Chain:
    """theta -> motion -> video -> loss."""

    simulate: Callable[[Tensor], Any]  # theta [k] -> trajectory
    render: Callable[
        [Any, int, Tensor], Float[Tensor, "t h w 3"]
    ]  # trajectory, view, indices of frames -> clip in 0..1
    clips: dict[int, Float[Tensor, "t h w 3"]]  # view -> recorded clip
    prior: AbstractPrior
    estimator: AbstractEstimator = field(default_factory=ScoreDistillation)
    # theta [k], ln of a factor on every known force -> trajectory; None: no force is known that drives the motion
    pushed: Callable[[Tensor, float], Any] | None = None
    # theta [k] -> trajectory by cells COARSER times as large; None: no grid moves the body
    coarser: Callable[[Tensor], Any] | None = None
    # what could be filmed next, in words -> what makes its motions by theta, of as many frames; takes time when called
    recordings: Mapping[str, Callable[[], Callable[[Tensor], Any]]] = field(default_factory=dict)
    passes_a_wall: Callable[[Tensor], bool] = lambda theta: False  # that `simulate` does not feel
    # relative error of the stiffness where no grid moves the body, whose cells it would hang on; takes time when called
    too_stiff: Callable[[], float] | None = None
    journal: Journal = field(default_factory=lambda: Journal(Log(None)))

    @cached_property
    def certain(self) -> bool:
        """Whether the prior's estimate does not depend on the noise, in any view."""
        return all(self.prior.certain(self.condition(view, self.frames)) for view in self.clips)

    @property
    def comparable(self) -> bool:
        """Whether single values of `loss` can be compared, and their gradient is that of `measure`."""
        return self.estimator.descends and self.certain

    @property
    def frames(self) -> Tensor:
        """The indices of all of them."""
        return torch.arange(len(next(iter(self.clips.values()))))

    def condition(self, view: int, frames: Tensor) -> Any:
        """What the prior is told of a view."""
        clip = self.clips[view]
        return self.prior.condition(clip[0], (clip[frames],))

    def motion(self, theta: Tensor) -> Any:
        """`simulate` without derivatives."""
        return self.noted("motion", theta, made=lambda: self.simulate(theta))

    def noted(self, *question: Any, made: Callable[[], Any]) -> Any:
        """A motion by the journal, without derivatives, on the device of the clips."""
        with torch.no_grad():
            return _on(next(iter(self.clips.values())).device, self.journal.ask(*question, answer=made))

    def loss(self, theta: Tensor, views: list[int], frames: Tensor, generator: torch.Generator) -> Tensor:
        """The first term of L, differentiable in theta."""
        motion, total, pixels = self.simulate(theta), 0.0, 0
        for view in views:
            video, condition = self.render(motion, view, frames), self.condition(view, frames)
            total = total + distillation_loss(self.prior, self.estimator, video, condition, generator=generator)  # type: ignore[assignment]
            pixels += video.numel()
        return total / pixels  # type: ignore[return-value]

    def slope(
        self, theta: Float[Tensor, " k"], views: list[int], frames: Tensor, generator: torch.Generator
    ) -> tuple[float, Float[Tensor, " k"]]:
        """(the first term of L, its derivative by theta)."""

        def answer() -> dict[str, Any]:
            at = theta.detach().clone().requires_grad_()
            loss = self.loss(at, views, frames, generator)
            loss.backward()
            return dict(loss=float(loss.detach()), slope=at.grad, generator=generator.get_state())

        told = self.journal.ask("slope", theta, views, frames, generator.get_state(), answer=answer)
        generator.set_state(told["generator"])
        return told["loss"], told["slope"]

    def measure(self, theta: Tensor, seed: int) -> float:
        """The denoising loss over all views and frames, always with the same noise."""
        return self.journal.ask("measure", theta, seed, answer=lambda: self._measured(theta, seed, self.frames))

    def tried(self, theta: Tensor, seed: int) -> float:
        """The same of a theta that only a search asks for: infinite where nothing moves the body so, which is said."""
        try:
            return self.measure(theta, seed)
        except NotMoved as reason:
            why = str(reason).partition("; take ")[0].partition("; enlarge ")[0]  # remedies are for one who wants it
            self.journal.log.warn(f"tried and left: with {theta.tolist()} the body cannot be moved ({why})")
            return math.inf

    def still(self, theta: Tensor, seed: int) -> float:
        """What `measure` is of the first picture of the motion, standing still."""
        return self.journal.ask(
            "still", theta, seed, answer=lambda: self._measured(theta, seed, self.frames, drawn=0 * self.frames)
        )

    def unmoved(self, theta: Tensor, seed: int) -> float:
        """That of the first picture beside the first one filmed: no material explains it."""
        return self.journal.ask("unmoved", theta, seed, answer=lambda: self._measured(theta, seed, self.frames[:1]))

    def _measured(self, theta: Tensor, seed: int, frames: Tensor, drawn: Tensor | None = None) -> float:
        """Of these frames. `drawn`: which are drawn in their place."""
        generator, total, pixels = torch.Generator().manual_seed(seed), 0.0, 0
        with torch.no_grad():
            motion = self.motion(theta)
            for view in self.clips:
                video = self.render(motion, view, frames if drawn is None else drawn)
                condition = self.condition(view, frames)
                total += denoising_loss(self.prior, video, condition, generator=generator)
                pixels += video.numel()
        return total / pixels


def _on(device: torch.device, motion: Any) -> Any:
    """A tensor, or the tensors of a dataclass, on a device."""
    if isinstance(motion, Tensor):
        return motion.to(device)
    if device.type == "cpu" or not is_dataclass(motion) or isinstance(motion, type):
        return motion
    parts = {f.name: getattr(motion, f.name) for f in fields(motion)}
    return replace(motion, **{name: _on(device, part) for name, part in parts.items() if isinstance(part, Tensor)})
