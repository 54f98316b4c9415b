"""A coarse search before descending: a few forward runs that choose the valley."""

import math

from torch import Tensor

from physics3d.learning.fields import GlobalField
from physics3d.learning.loss import Chain
from physics3d.log import Log


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
