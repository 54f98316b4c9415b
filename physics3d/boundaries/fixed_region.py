"""Fixed region: nothing moves in this box, as if it were clamped (a stem in its pot, the held end of a bar).

For good, or for start <= t < start + duration (held, then let go)."""

import functools
import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.checks import Corners, Lasting, Time
from physics3d.warp_types import vector


@dataclass(frozen=True, kw_only=True)
class FixedRegion(base.AbstractBoundary):
    """Nodes between the corners lower and upper [m] have no velocity."""

    lower: base.Vector
    upper: base.Vector
    start: Time = 0.0  # [s]
    duration: Lasting = math.inf  # [s]

    RULES = (Corners("lower", "upper"),)

    def parameters(self, setting: base.Setting) -> Float[Tensor, "6"]:
        slack = 1e-3 * setting.dx  # a node on the surface belongs to the region whatever the rounding
        lower = torch.tensor(self.lower, dtype=torch.float64) - slack
        return torch.cat([lower, torch.tensor(self.upper, dtype=torch.float64) + slack])

    def signals(self, t: float, dt: float) -> tuple[float]:
        return (float(self.start <= t < self.start + self.duration),)

    def holds(self, setting: base.Setting) -> Float[Tensor, " p"]:
        inside = base.inside_box(setting.position, self.lower, self.upper)
        return inside if self.start <= 0 else torch.zeros_like(inside)

    def node(self, real: type) -> wp.Function:
        return _node(real)


@functools.cache
def _node(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"fixed_region_{real.__name__}")
    def node(
        x: vec3,
        v: vec3,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        result = v
        above = x[0] >= q[a] and x[1] >= q[a + 1] and x[2] >= q[a + 2]
        below = x[0] <= q[a + 3] and x[1] <= q[a + 4] and x[2] <= q[a + 5]
        if clock[row, b] > real(0.0) and above and below:
            result = vec3()
        return result

    return node
