"""A coarse search before descending: forward runs that choose the valley.

Offsets are tried along a line, equally far apart. Where the lowest loss is at an end, the line goes on from there by
the same step, so that a start which is a factor 100 off is found as one that is a factor 2 off; it ends at the span of
the field. Between the best and its neighbours the middles are tried as well, for of two places to either side of the
best valley one may lie in another. A valley is the narrower the more swings a clip shows: where the best that was tried
explains little more of what moves than a picture that stands still, all of the line is looked at again between what
was tried, and beyond its ends, once or twice. What nothing can move, too soft for its force or so stiff that steps
become too short, is passed over. A second valley that is nearly as deep is said: then the clip, as far as the search
sees, has two answers.
"""

import itertools
import math

from torch import Tensor

from physics3d.learning.course import Point
from physics3d.learning.fields import GlobalField
from physics3d.learning.loss import Chain
from physics3d.log import Log

DEEP = 0.75  # of what the motion adds to the loss of a picture that stands still: below it something is explained
FINE = 0.2  # between neighbours that are looked at, in the logarithm: a tenth of a frequency
NEARLY = 1.5  # as deep: so many times the lowest loss, as of two answers that a descent may still exchange


def search(
    chain: Chain, field: GlobalField, directions: Tensor, offsets: list[float], *, seed: int, log: Log
) -> tuple[Tensor, list[Point]]:
    """(theta of the lowest loss among offset * directions, all that were tried, and it again). `offsets` ascend, two or
    more, equally far apart. Raises NotMoved if none of them moves the body, and the start does not."""
    course: list[Point] = []
    tried: dict[float, Point] = {}

    def measure(offset: float) -> None:
        theta = field.bound(offset * directions)
        tried[offset] = Point(way="search", theta=theta, loss=chain.tried(theta, seed))
        course.append(tried[offset])
        log.metric("search/factor", math.exp(offset), len(course) - 1)
        log.metric("search/loss", course[-1].loss, len(course) - 1)

    for offset in log.progress(offsets, "coarse search"):
        measure(offset)
    if all(math.isinf(point.loss) for point in course):
        chain.measure(field.zero(), seed)  # says what is wrong with the start
    step, limit = offsets[1] - offsets[0], math.log(field.span) + 1e-9
    lowest = lambda: min(tried, key=lambda offset: tried[offset].loss)
    best = lowest()
    while (side := (best == max(tried)) - (best == min(tried))) and abs(best + side * step) <= limit:
        log.info(f"x{math.exp(best):.3g} is the best so far and the last that was tried: going on")
        measure(best + side * step)
        if tried[best].loss <= tried[best + side * step].loss:
            break
        best += side * step
    others = [other for other in valleys(tried) if other != best]
    for side in (-1, 1):
        if abs(best + side * step / 2) <= limit:
            measure(best + side * step / 2)
    best, width = lowest(), step
    # a diffusion model's losses have a floor that no motion goes below, and cost minutes
    explained = math.inf
    if chain.certain:
        unmoved = chain.unmoved(tried[best].theta, seed)
        explained = unmoved + DEEP * (chain.still(tried[best].theta, seed) - unmoved)
    while tried[best].loss > explained and step > FINE:
        log.info("nothing tried explains much more than a picture that stands still: looking between and beyond")
        ends = (min(tried), -1), (max(tried), 1)
        beyond = [end + side * times * width for end, side in ends for times in (1, 2)]
        places = [offset for offset in beyond if abs(offset) <= limit]
        places += [(low + high) / 2 for low, high in itertools.pairwise(sorted([*tried, *places]))]
        for offset in log.progress([place for place in places if place not in tried], "finer search"):
            measure(offset)
        best, step = lowest(), step / 2
        others = [other for other in valleys(tried) if other != best]
    table = ", ".join(f"x{math.exp(offset):.3g}: {tried[offset].loss:.4g}" for offset in sorted(tried))
    log.info(f"coarse search over the stiffness ({table}): start at x{math.exp(best):.3g}")
    if others:
        log.warn(
            f"two valleys explain the clip: the stiffness may as well be near x{math.exp(others[0]):.3g} of the start; "
            "record for longer, or another push"
        )
    return tried[best].theta, [*course, tried[best]]


def valleys(tried: dict[float, Point]) -> list[float]:
    """The offsets whose loss is below that of both neighbours and NEARLY as low as the lowest, the lowest first."""
    at = sorted(tried)
    loss = [tried[offset].loss for offset in at]
    inner = [i for i in range(1, len(at) - 1) if loss[i - 1] > loss[i] < loss[i + 1] and loss[i] <= NEARLY * min(loss)]
    return [at[i] for i in sorted(inner, key=lambda i: loss[i])]
