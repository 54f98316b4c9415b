"""Rivals: what was tried, and explains the clip about as well as what was learned.

An interval from derivatives at the answer knows one valley of the loss. A thing that swings five times in a clip of a
few frames has a valley for every number of swings that fits between them, and where the model draws the thing badly
none of them is deep. What the clip does not tell from the answer (`likelihood.py`) is a rival. One outside the local
interval is another valley; it stands for all that is nearer to it than to what else was tried, and intervals reach as
far as that. One in which a polish ended (`mirror.py`) is a valley as wide as that of the answer. (A search whose steps
skip whole valleys may have skipped the best: where swings are aliased 90 % hold 84 of 100 truths, and without rivals
three.)
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from physics3d.learning.course import Point
from physics3d.learning.interval import Posterior
from physics3d.learning.sandwich import NORMAL
from physics3d.log import Log

FAR = 4.0  # times the loss of the answer: worse by so much that nobody looks


def rivals(course: Sequence[Point], told_apart: Callable[[list[Point]], list[bool]]) -> list[Point]:
    """Points of the search, and ends of other valleys, that do as well as the last of the course, as far as the clip
    tells. Losses of those and of the last one are over all that was filmed."""
    tried = [point for point in course if point.way in ("search", "across")]
    close = [point for point in tried if point.loss < FAR * max(course[-1].loss, 1e-300)]
    different = [point for point in close if not torch.equal(point.theta, course[-1].theta)]
    return [point for point, told in zip(different, told_apart(different), strict=True) if not told]


def widened(found: Posterior, course: Sequence[Point], equal: Sequence[Point], log: Log) -> Posterior:
    """`found`, its 90 % reaching as far as the rivals `equal` do, or as what was thought before the clip."""
    deviation = np.sqrt(found.covariance.diagonal())
    low, high = found.mean - NORMAL * deviation, found.mean + NORMAL * deviation

    def padded(point: Point) -> np.ndarray:  # components that the search does not know stay where they were
        theta = point.theta.detach().numpy()
        return np.concatenate([theta, np.zeros(len(low) - len(theta))])

    tried = np.array([padded(point) for point in course if point.way == "search"]).reshape(-1, len(low))
    tried = np.unique(tried, axis=0)
    varied = np.ptp(tried, axis=0) > 0 if len(tried) else np.zeros(len(low), bool)
    ends = [padded(point) for point in equal if point.way == "across"]
    others = [padded(point) for point in equal if point.way == "search"]
    others = [other for other in others if ((other < low) | (other > high))[varied].any()]
    lower, upper = low, high
    if others:
        distance = np.linalg.norm(tried[:, None] - tried[None], axis=2)
        nearest = np.where(distance > 0, distance, np.inf).argmin(1)
        half = np.abs(tried[nearest] - tried) / 2  # to the next that was tried
        mine = [int(np.linalg.norm(tried - other, axis=1).argmin()) for other in others]
        reach = np.stack([side * half[i] + other for i, other in zip(mine, others) for side in (-1, 1)])
        reach = reach.clip(-NORMAL * found.before, NORMAL * found.before)
        lower = np.where(varied, np.minimum(low, reach.min(0)), low)
        upper = np.where(varied, np.maximum(high, reach.max(0)), high)
    for end in ends:
        lower, upper = np.minimum(lower, end - NORMAL * deviation), np.maximum(upper, end + NORMAL * deviation)
    factor = (upper - lower) / (high - low)
    if (factor < 1.01).all():
        return found
    if ends:
        log.warn(
            "a relaxation time on the other side of the period of the swing explains the clip as well; the intervals "
            "hold both: record how the thing gives way to a steady force, or a swing of another frequency"
        )
    if others:
        log.warn(
            f"{len(others)} of the stiffnesses that the search tried explain the clip as well as the one that was "
            "learned; the intervals reach as far: record for longer, more frames, or another push"
        )
    return replace(found, mean=(lower + upper) / 2, covariance=found.covariance * factor[:, None] * factor)
