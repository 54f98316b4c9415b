"""The window of the grid: nodes around the particles, with room for the way they can go before the next look."""

import math

from physics3d.mpm.survey import Survey
from physics3d.trajectory import NotMoved
from physics3d.world import World

MOST_NODES = 2**27


def window(
    world: World, seen: Survey, *, steps: int, dt: float, reach: float, frame: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Lowest node and number of nodes along each axis, with room for `reach` times the way particles can go in `steps`
    substeps of dt [s]. Raises NotMoved if they spread too far for a grid."""
    duration = steps * dt
    speed = seen.speed + math.hypot(*world.gravity) * duration
    # a legal substep moves no particle farther than a cell, so no more room than that, however fast they are
    room = 2 + math.ceil(min(reach * (1 + speed * duration / world.dx), reach + steps))
    lowest = tuple(cell - room for cell in seen.lowest)
    size = tuple(high + room + 1 - low for high, low in zip(seen.highest, lowest))
    if seen.infinite or math.prod(size) > MOST_NODES:
        across = " x ".join(f"{s:g}" for s in size)
        raise NotMoved(f"frame {frame}: the particles spread over {across} cells; take a larger dx or a BoundingBox")
    return lowest, size
