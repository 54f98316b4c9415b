"""Levenberg's steps after the descent: forward runs only, where one parameter stands in for another."""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.course import Point
from physics3d.learning.fields import AbstractField
from physics3d.learning.linear import linearise
from physics3d.learning.loss import Chain
from physics3d.log import Log


def polish(
    chain: Chain, field: AbstractField, theta: Tensor, *, steps: int, stay: float, seed: int, log: Log
) -> tuple[Float[Tensor, " k"], list[Point]]:
    """Levenberg's steps on L: what Adam leaves undone in narrow valleys where one parameter stands in for another.

        (J^T J + stay L_0 + m max diag J^T J) d = -(J^T (z0 - x0_hat) + stay L_0 theta)

    with L_0 the loss where they begin: the pull to the start is measured by what is left unexplained, not by how bad
    the start was, else one that is far off holds what the pictures hardly show. m grows by 8 on failure and falls by 4
    on success. It is the same for all components, so that one which the pictures hardly show moves least. Returns theta
    and where it was after every step.
    """
    unit, m = max(chain.measure(theta, seed), 1e-12), 1e-3
    pulled = lambda t: 0.5 * stay * unit * float(t.square().sum())
    total = lambda t: chain.measure(t, seed) + pulled(t)
    now, around, course = total(theta), None, []
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
        course.append(Point(way="polish", theta=theta, loss=now - pulled(theta)))
    log.info(f"polished: loss {now - pulled(theta):.5g}")
    return theta, course
