"""Learning: roll out -> render -> ask the prior -> step, until the simulated video looks as the prior says it should.

The loss is in `loss.py`. Each step looks at a random choice of views and, spread over the whole clip, of frames. Adam
steps in theta (`fields.py`), its rate falling to a tenth along a cosine; L is divided by L_0, so that `stay` and the
clip on the gradient's norm mean the same in every scene. A gradient that is not finite, or a body that nothing moves,
is reported and answered by going half the way back to the last good point; where nothing moves the body the descent may
end there. `search.py` before and `polish.py` after it need forward runs only.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.course import Point
from physics3d.learning.fields import AbstractField, physical
from physics3d.learning.loss import Chain
from physics3d.log import Log
from physics3d.trajectory import NotMoved

MOST_RETREATS = 3  # steps in a row with a gradient that is not finite, before giving up


def fit(
    chain: Chain,
    field: AbstractField,
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
) -> tuple[Float[Tensor, " k"], list[Point]]:
    """Descend from theta. Returns theta and where it was at every step, and at the end.

    What is returned is the mean of the last quarter of the iterates; or, where losses of single steps can be compared,
    the iterate of lowest loss, if that is better over all views and frames. Raises ValueError when the gradient stays
    not finite, NotMoved when theta is not moved.
    """
    generator = torch.Generator().manual_seed(seed)
    unit = chain.tried(field.zero(), seed)
    unit = max(chain.measure(theta, seed) if math.isinf(unit) else unit, 1e-12)
    theta = field.bound(theta).requires_grad_()
    adam = torch.optim.Adam([theta], lr=learning_rate, betas=(0.8, 0.95))
    good, retreats = theta.detach().clone(), 0
    course: list[Point] = []
    for step in (bar := log.progress(range(steps), "learning")):
        views, frames = (
            some_of(list(chain.clips), views_per_step, generator),
            some_frames(chain, frames_per_step, generator),
        )
        why, wall = "", False
        try:
            loss, slope = chain.slope(theta, views, frames, generator)
            theta.grad = slope / unit + stay * theta.detach()
            if not torch.isfinite(theta.grad).all():
                why = f"gradient {theta.grad.tolist()} is not finite"
        except NotMoved as reason:
            why, wall = str(reason), True
        if why:
            retreats += 1
            log.warn(f"step {step}: {why}; going half the way back")
            if retreats > MOST_RETREATS and wall and course:
                log.warn("the descent ends at the last place where the body can be moved")
                break
            if retreats > MOST_RETREATS:
                raise ValueError(
                    f"learning: no finite gradient {retreats} times in a row (step {step}: {why}); lower "
                    f"learn.learning_rate ({learning_rate:g}), learn.duration or learn.span"
                )
            with torch.no_grad():
                theta.copy_((theta + good) / 2)
            continue
        retreats, good = 0, theta.detach().clone()
        norm = float(torch.nn.utils.clip_grad_norm_(theta, largest_gradient))
        course.append(Point(way="descent", theta=good, loss=loss))
        for name, value in physical(field, good).items():
            log.metric(f"parameter/{name}", value, step)
        log.metric("loss", loss, step)
        log.metric("gradient_norm", norm, step)
        bar.set_postfix(
            loss=f"{loss / unit:.4f}", **{n.split("+")[0][:8]: f"{v:+.2f}" for n, v in zip(field.names, good)}
        )
        adam.param_groups[0]["lr"] = learning_rate * (0.55 + 0.45 * math.cos(math.pi * step / steps))
        adam.step()
        with torch.no_grad():
            theta.copy_(field.bound(theta))
    mean = torch.stack([point.theta for point in course[-max(1, len(course) // 4) :]]).mean(0)
    found = {"mean of last quarter": mean}
    if chain.comparable:
        found["best iterate"] = min(course, key=lambda point: point.loss).theta
    candidates = log.progress(found.items(), "comparing what was found", total=len(found))
    losses = {name: chain.measure(candidate, seed) for name, candidate in candidates}
    log.info(
        f"loss over all frames: start {unit:.5g}, {', '.join(f'{name} {loss:.5g}' for name, loss in losses.items())}"
    )
    log.metric("loss_start", unit)
    log.metric("loss_learned", min(losses.values()))
    theta = found[min(losses, key=lambda name: losses[name])]
    return theta, [*course, Point(way="descent", theta=theta, loss=min(losses.values()))]


def some_of(items: list[int], count: int, generator: torch.Generator) -> list[int]:
    """`count` of the items without repetition; all if count is 0."""
    if not 0 < count < len(items):
        return items
    return [items[i] for i in torch.randperm(len(items), generator=generator)[:count].tolist()]


def some_frames(chain: Chain, count: int, generator: torch.Generator) -> Tensor:
    """`count` frames in order, one from each of as many equal stretches of the clip; all if count is 0."""
    total = len(next(iter(chain.clips.values())))
    if not 0 < count < total:
        return torch.arange(total)
    edges = torch.linspace(1, total, count + 1).floor()  # frame 0 is the same for every material
    return (edges[:-1] + (edges.diff() * torch.rand(count, generator=generator)).floor()).long()
