"""Learning: roll out -> render -> ask the prior -> step, until the simulated video looks as the prior says it should.

    L(theta) = 1/N sum_views sds(video(theta)) + stay/2 L_0 |theta|^2,     L_0 = the first term at the start, N pixels

One backward pass goes through prior, renderer and the whole trajectory, every substep of it. Each step looks at a
random choice of views and, spread over the whole clip, of frames. Adam steps in theta (`fields.py`), its rate falling
to a tenth along a cosine; L is divided by L_0, so that `stay` and the clip on the gradient's norm mean the same in
every scene. A gradient that is not finite is reported and answered by going half the way back to the last good point.
`search` before and `polish` after it need forward runs only.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.fields import GlobalField
from physics3d.log import Log
from physics3d.priors.base import AbstractPrior
from physics3d.priors.sds import sds_loss

MOST_RETREATS = 3  # steps in a row with a gradient that is not finite, before giving up


@dataclass(frozen=True, kw_only=True)
class Chain:
    """theta -> motion -> video -> loss."""

    simulate: Callable[[Tensor], Any]  # theta [k] -> trajectory
    render: Callable[
        [Any, int, Tensor], Float[Tensor, "t h w 3"]
    ]  # trajectory, view, indices of frames -> clip in 0..1
    clips: dict[int, Float[Tensor, "t h w 3"]]  # view -> recorded clip
    prior: AbstractPrior

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


def search(
    chain: Chain, field: GlobalField, directions: Tensor, offsets: list[float], *, seed: int, log: Log
) -> Tensor:
    """theta of the lowest loss among offset * directions: a few forward runs that choose the valley to descend into."""
    losses = []
    for i, offset in enumerate(log.progress(offsets, "coarse search")):
        losses.append(chain.measure(field.bound(offset * directions), seed))
        log.metric("search/factor", math.exp(offset), i)
        log.metric("search/loss", losses[-1], i)
    best = min(range(len(offsets)), key=losses.__getitem__)
    table = ", ".join(f"x{math.exp(o):.3g}: {l:.4g}" for o, l in zip(offsets, losses))
    log.info(f"coarse search over the stiffness ({table}): start at x{math.exp(offsets[best]):.3g}")
    return field.bound(offsets[best] * directions)


def fit(
    chain: Chain,
    field: GlobalField,
    theta: Float[Tensor, " k"],
    *,
    steps: int,
    learning_rate: float,
    views_per_step: int,
    frames_per_step: int,
    stay: float,
    largest_gradient: float,
    seed: int,
    log: Log,
) -> tuple[Float[Tensor, " k"], dict[str, list[float]]]:
    """Descend from theta. Returns theta and the history (loss, gradient norm and every component per step).

    What is returned is the mean of the last quarter of the iterates, or the iterate of lowest loss if that is better
    over all views and frames. Raises ValueError when the gradient stays not finite.
    """
    generator = torch.Generator().manual_seed(seed)
    unit = max(chain.measure(field.zero(), seed), 1e-12)
    theta = field.bound(theta).requires_grad_()
    adam = torch.optim.Adam([theta], lr=learning_rate, betas=(0.8, 0.95))
    good, retreats, iterates = theta.detach().clone(), 0, []
    history: dict[str, list[float]] = {name: [] for name in ("loss", "gradient", *field.names)}
    for step in (bar := log.progress(range(steps), "learning")):
        views, frames = (
            draw(list(chain.clips), views_per_step, generator),
            draw_frames(chain, frames_per_step, generator),
        )
        adam.zero_grad()
        data = chain.loss(theta, views, frames, generator) / unit
        (data + 0.5 * stay * theta.square().sum()).backward()
        if not torch.isfinite(theta.grad).all():  # type: ignore[arg-type]
            retreats += 1
            log.warn(f"step {step}: gradient {theta.grad.tolist()} is not finite; going half the way back")  # type: ignore[union-attr]
            if retreats > MOST_RETREATS:
                raise ValueError(
                    f"learning: the gradient was not finite {retreats} times in a row (step {step}); lower "
                    f"learn.learning_rate ({learning_rate:g}), learn.duration or learn.span"
                )
            with torch.no_grad():
                theta.copy_((theta + good) / 2)
            continue
        retreats, good = 0, theta.detach().clone()
        iterates.append(good)
        norm = float(torch.nn.utils.clip_grad_norm_(theta, largest_gradient))
        for name, value in zip(history, [float(data.detach()) * unit, norm, *good.tolist()]):
            history[name].append(value)
        for name, value in physical(field, good).items():
            log.metric(f"parameter/{name}", value, step)
        log.metric("loss", float(data.detach()) * unit, step)
        log.metric("gradient_norm", norm, step)
        bar.set_postfix(
            loss=f"{float(data.detach()):.4f}", **{n.split("+")[0][:8]: f"{v:+.2f}" for n, v in zip(field.names, good)}
        )
        adam.param_groups[0]["lr"] = learning_rate * (0.55 + 0.45 * math.cos(math.pi * step / steps))
        adam.step()
        with torch.no_grad():
            theta.copy_(field.bound(theta))
    mean = torch.stack(iterates[-max(1, len(iterates) // 4) :]).mean(0)
    best = iterates[min(range(len(iterates)), key=history["loss"].__getitem__)]
    losses = [chain.measure(candidate, seed) for candidate in (mean, best)]
    log.info(
        f"loss over all frames: start {unit:.5g}, mean of last quarter {losses[0]:.5g}, best iterate {losses[1]:.5g}"
    )
    log.metric("loss_start", unit)
    log.metric("loss_learned", min(losses))
    return (mean if losses[0] <= losses[1] else best), history


@dataclass(frozen=True)
class Linear:
    """The chain around theta: code(theta + d) = code + J d, over all views and frames; sums divided by N pixels."""

    JJ: Tensor  # w J^T J / N [k, k]
    Jr: Tensor  # w J^T (z0 - x0_hat) / N [k]: the SDS gradient
    rms: Tensor  # of the columns of J [k], colour in 0..1
    residual: float  # rms of z0 - x0_hat
    count: int  # numbers in the code


def linearise(chain: Chain, field: GlobalField, theta: Tensor, *, seed: int, step: float = 0.05) -> Linear:
    """J by forward differences in theta: k + 1 simulations, none of them differentiated."""
    k, frames = len(theta), torch.arange(len(next(iter(chain.clips.values()))))
    JJ, Jr, squares, residual, count, pixels = (
        torch.zeros(k, k).double(),
        torch.zeros(k).double(),
        torch.zeros(k),
        0.0,
        0,
        0,
    )
    with torch.no_grad():
        motions = [chain.simulate(t) for t in (theta, *(theta + step * torch.eye(k, dtype=theta.dtype)))]
        for view, clip in chain.clips.items():
            codes = [chain.prior.encode(chain.render(motion, view, frames)) for motion in motions]
            generator = torch.Generator().manual_seed(seed)
            level = chain.prior.level(generator)
            noise = torch.randn(codes[0].shape, generator=generator).to(codes[0])
            condition = chain.prior.condition(clip[0], (clip,))
            estimate = chain.prior.x0_hat(level.alpha * codes[0] + level.sigma * noise, level, condition)
            J = torch.stack([(code - codes[0]).flatten() / step for code in codes[1:]], 1).double().cpu()
            r, w = (codes[0] - estimate).flatten().double().cpu(), chain.prior.weight(level)
            JJ, Jr, squares = JJ + w * J.T @ J, Jr + w * J.T @ r, squares + J.square().sum(0)
            residual, count, pixels = residual + float(r.square().sum()), count + len(r), pixels + clip.numel()
    return Linear(JJ / pixels, Jr / pixels, (squares / count).sqrt(), math.sqrt(residual / count), count)


def polish(
    chain: Chain, field: GlobalField, theta: Tensor, *, steps: int, stay: float, seed: int, log: Log
) -> Float[Tensor, " k"]:
    """Levenberg's steps on L: what Adam leaves undone in narrow valleys where one parameter stands in for another.

        (J^T J + stay L_0 + m max diag J^T J) d = -(J^T (z0 - x0_hat) + stay L_0 theta)

    m grows by 8 on failure and falls by 4 on success. It is the same for all components, so that one which the pictures
    hardly show moves least.
    """
    unit, m = max(chain.measure(field.zero(), seed), 1e-12), 1e-3
    total = lambda t: chain.measure(t, seed) + 0.5 * stay * unit * float(t.square().sum())
    now, around = total(theta), None
    for step in log.progress(range(steps), "polishing"):
        around = around or linearise(chain, field, theta, seed=seed)
        pull = stay * unit
        A = around.JJ + (m * around.JJ.diagonal().max() + pull + 1e-9 * unit) * torch.eye(len(theta)).double()
        d = torch.linalg.solve(A, -(around.Jr + pull * theta))
        trial = field.bound(theta + d.clamp(-1, 1))  # at most a factor e at once
        then = total(trial)
        log.metric("polish/loss", min(now, then), step)
        if then < now:
            theta, now, around, m = trial, then, None, m / 4
        else:
            m *= 8
    log.info(f"polished: loss {chain.measure(theta, seed):.5g}")
    return theta


def sensitivity(chain: Chain, field: GlobalField, theta: Tensor, *, seed: int) -> dict[str, tuple[float, float]]:
    """How well each component can be told: name -> (change of the code per unit of theta [rms x 255], error of theta).

    The error is sqrt(diag(s^2 (J^T J)^-1)) with the residual's mean square s^2, as if residuals were independent from
    pixel to pixel: they are not, so it is a lower bound. Infinite if unobservable.
    """
    around = linearise(chain, field, theta, seed=seed)
    scale = around.rms.clamp_min(1e-12).double()
    correlation = around.JJ / around.JJ.diagonal().sqrt().clamp_min(1e-12).outer(
        around.JJ.diagonal().sqrt().clamp_min(1e-12)
    )
    variance = torch.linalg.pinv(correlation, hermitian=True).diagonal() / scale**2 * around.residual**2 / around.count
    error = torch.where(255 * around.rms > 1e-3, variance.clamp_min(0).sqrt(), torch.inf)
    return {name: (255 * float(r), float(e)) for name, r, e in zip(field.names, around.rms, error)}


def physical(field: GlobalField, theta: Tensor) -> dict[str, float]:
    """The learned parameters in SI units."""
    values = field.parameters(theta)
    learned = {name: float(values[name].mean()) for group in field.groups for name in group}
    if field.velocity_scale is not None:
        learned |= dict(zip(("velocity_x", "velocity_y", "velocity_z"), field.velocity(theta).tolist()))
    return learned


def draw(items: list[int], count: int, generator: torch.Generator) -> list[int]:
    """`count` of the items without repetition; all if count is 0."""
    if not 0 < count < len(items):
        return items
    return [items[i] for i in torch.randperm(len(items), generator=generator)[:count].tolist()]


def draw_frames(chain: Chain, count: int, generator: torch.Generator) -> Tensor:
    """`count` frames in order, one from each of as many equal stretches of the clip; all if count is 0."""
    total = len(next(iter(chain.clips.values())))
    if not 0 < count < total:
        return torch.arange(total)
    edges = torch.linspace(1, total, count + 1).floor()  # frame 0 is the same for every material
    return (edges[:-1] + (edges.diff() * torch.rand(count, generator=generator)).floor()).long()
