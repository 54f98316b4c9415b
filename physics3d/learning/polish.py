"""Levenberg's steps after the descent: forward runs only, where one parameter stands in for another."""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.course import Point
from physics3d.learning.fields import DENSITY, AbstractField, is_stiff
from physics3d.learning.linear import linearise
from physics3d.learning.loss import Chain
from physics3d.log import Log

SHORT = 1e-3  # of theta: a thousandth of a parameter
# of the loss, that a step gains at the bottom. A standard deviation is worth 1/n of it where the clip is as good as n
# independent numbers, and a tenth of one a hundredth of that; n is some hundreds
LEAST = 3e-5


def polish(
    chain: Chain, field: AbstractField, theta: Tensor, *, steps: int, stay: float | Tensor, seed: int, log: Log
) -> tuple[Float[Tensor, " k"], list[Point]]:
    """Levenberg's steps on L: what Adam leaves undone in narrow valleys where one parameter stands in for another.

        (J^T J + stay L_0 + m max diag J^T J) d = -g,   g = J^T (z0 - x0_hat) + stay L_0 theta

    with L_0 the loss where the step begins, and `stay` of all components or of each [k]: the pull to the start is
    measured by what is left unexplained, and fades as that does. Measured by how bad a start was it would hold what the
    pictures hardly show. m grows by 8, 64, 512 on failures in a row and falls by 4 on success. It is the same for all
    components, so that one which the pictures hardly show moves least; where the density is learned, for that and the
    stiffness over it, which a swing shows apart: its width and its frequency. It ends at a step too short to matter, or
    where what the next one would gain without m, g^T (J^T J + stay L_0)^-1 g/2, is LEAST: there theta is nearer to the
    bottom than a tenth of what the clip leaves open, along the flattest valley too. Returns theta and where it was
    after every step.
    """
    now, m, grows = chain.measure(theta, seed), 1e-3, 8
    around, course = None, []
    one, T = torch.eye(len(theta)).double(), _by_mass(field)
    for step in log.progress(range(steps), "polishing"):
        around = around or linearise(chain, field, theta, seed=seed)
        pull = stay * max(now, 1e-12) * one.diagonal()
        A = around.JJ + (pull + 1e-9 * max(now, 1e-12)).diag()
        slope = around.Jr + pull * theta
        if 0.5 * float(slope @ torch.linalg.solve(A, slope)) < LEAST * now:
            break
        damped = T.T @ A @ T + m * (T.T @ around.JJ @ T).diagonal().max() * one
        d = T @ torch.linalg.solve(damped, -T.T @ slope)
        trial = field.bound(theta + d.clamp(-1, 1))  # at most a factor e at once
        if float((trial - theta).abs().max()) < SHORT:
            break
        then = chain.tried(trial, seed)
        gained = now - then + 0.5 * float(pull @ (theta.square() - trial.square()))
        log.metric("polish/loss", then if gained > 0 else now, step)
        if gained > 0:
            theta, now, around, m, grows = trial, then, None, m / 4, 8
        else:
            m, grows = m * grows, 8 * grows
        course.append(Point(way="polish", theta=theta, loss=now))
    log.info(f"polished: loss {now:.5g}")
    return theta, course


def _by_mass(field: AbstractField) -> Float[Tensor, "k k"]:
    """theta of numbers in which what is stiff is divided by the density; the same where that is not learned."""
    one = torch.eye(len(field.names)).double()
    stiff = torch.tensor([float(is_stiff(name)) for name in field.names]).double()
    density = torch.tensor([float(name == DENSITY) for name in field.names]).double()
    return one + stiff[:, None] * density
