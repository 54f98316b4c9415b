"""A coarse search before descending: a few forward runs that choose the valley."""

import math

from torch import Tensor

from physics3d.learning.course import Point
from physics3d.learning.fields import GlobalField
from physics3d.learning.loss import Chain
from physics3d.log import Log


def search(
    chain: Chain, field: GlobalField, directions: Tensor, offsets: list[float], *, seed: int, log: Log
) -> tuple[Tensor, list[Point]]:
    """(theta of the lowest loss among offset * directions, all that were tried, and it again): a few forward runs that
    choose the valley to descend into."""
    course = []
    for i, offset in enumerate(log.progress(offsets, "coarse search")):
        theta = field.bound(offset * directions)
        course.append(Point(way="search", theta=theta, loss=chain.measure(theta, seed)))
        log.metric("search/factor", math.exp(offset), i)
        log.metric("search/loss", course[-1].loss, i)
    best = min(range(len(offsets)), key=lambda i: course[i].loss)
    table = ", ".join(f"x{math.exp(o):.3g}: {point.loss:.4g}" for o, point in zip(offsets, course))
    log.info(f"coarse search over the stiffness ({table}): start at x{math.exp(offsets[best]):.3g}")
    return course[best].theta, [*course, course[best]]
