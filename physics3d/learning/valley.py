"""Along the valley of the loss: how far an interval reaches where its derivatives no longer tell.

With theta_hat the answer, L its loss and u_i the directions in which what the clip says (`interval.Told`) is
independent, the 90 % that derivatives give end at theta_hat +- d, d = 1.645 sigma_i u_i, where L should have risen by

    R_i = 1/2 d^T J^T J d / N

Where a relaxation time stands in for a stiffness the valley is long and bent, and L has hardly risen there. So L is
asked, at s d with growing s, until it has risen by R_i; the interval reaches as far as that, never less than 1 (profile
likelihood, Venzon and Moolgavkar 1988, along straight lines, with the sandwich's own measure of what rises by chance).
A point that is lower than L is a better answer, and the descent goes on from there.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from physics3d.learning.interval import Told
from physics3d.learning.sandwich import NORMAL
from physics3d.log import Log

CLEAR = 0.1  # an interval narrower than so much to either side [of theta] is left alone: derivatives tell
STRIDE = 1.8  # s grows by this factor
FARTHEST = 6  # strides
LOWER = 0.98  # a loss below this share of L is a better answer


def reaches(
    told: Told,
    *,
    before: Float[np.ndarray, " k"],
    rise: Callable[[Float[np.ndarray, " k"]], float],
    loss: Callable[[Float[np.ndarray, " k"]], float],
    log: Log,
) -> tuple[Told, Float[np.ndarray, " k"] | None]:
    """(`told`, reaching as far along each direction as the loss allows; the lowest place that is clearly lower).

    `before`: widths of what was thought beforehand, beyond which nobody looks; `rise`: R of a d; `loss`: L at
    theta_hat + d. Where a lower place is found the reaches are those around an answer that is not the best.
    """
    middle, deviation = told.middle.copy(), told.deviation.copy()
    here = loss(np.zeros(len(before)))
    lowest, least = None, LOWER * here
    for i in range(len(deviation)):
        d = NORMAL * told.deviation[i] * before * told.axes[:, i]
        if np.abs(d).max() < CLEAR:
            continue
        ends = []
        for side in (-1, 1):
            s, known = 1.0, (0.0, 0.0)  # the last place, and how much the loss had risen there
            for _ in range(FARTHEST):
                at = side * s * d
                if s > 1 and (np.abs(at) > NORMAL * before).any():
                    break
                value = loss(at)
                if value < least:
                    lowest, least = at, value
                if value - here >= rise(d):
                    break
                known, s = (s, value - here), s * STRIDE
            ends.append(max(1.0, _between(known, (s, value - here), rise(d))))
        down, up = ends
        middle[i] += NORMAL * told.deviation[i] * (up - down) / 2
        deviation[i] *= (up + down) / 2
        if max(ends) > 1.5:
            log.info(
                f"along the valley the loss stays as low {max(ends):.2g} times as far as its derivatives say; "
                "intervals reach as far"
            )
    return replace(told, middle=middle, deviation=deviation), lowest


def _between(inner: tuple[float, float], outer: tuple[float, float], rise: float) -> float:
    """s where the loss has risen by `rise`, between two places, by a power of s; the outer one where it has not."""
    if outer[1] < rise:
        return outer[0]
    if inner[1] <= 0 or outer[1] <= inner[1]:  # from the bottom a parabola
        return inner[0] + (outer[0] - inner[0]) * math.sqrt(rise / outer[1])
    power = math.log(outer[1] / inner[1]) / math.log(outer[0] / inner[0])
    return inner[0] * (rise / inner[1]) ** (1 / power)
