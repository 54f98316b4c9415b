"""Moving cuboid: a rigid block that travels with a prescribed velocity for some time, then is gone.

Nodes inside the block have its velocity while start <= t < start + duration; the block moves along with it.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.checks import Corners, Duration
from physics3d.warp_types import vector


@dataclass(frozen=True, kw_only=True)
class MovingCuboid(base.AbstractBoundary):
    """Block between the corners lower and upper [m] at `start`, with `velocity` [m/s] for `duration` [s]."""

    lower: base.Vector
    upper: base.Vector
    velocity: base.Vector
    start: float = 0.0  # before the first frame: it is under way then [s]
    duration: Duration

    RULES = (Corners("lower", "upper"),)

    def parameters(self, setting: base.Setting) -> Float[Tensor, "9"]:
        slack = 1e-3 * setting.dx  # a node on the surface belongs to the block whatever the rounding
        lower = torch.tensor(self.lower, dtype=torch.float64) - slack
        upper = torch.tensor(self.upper, dtype=torch.float64) + slack
        return torch.cat([lower, upper, torch.tensor(self.velocity, dtype=torch.float64)])

    def signals(self, t: float, dt: float) -> tuple[float, float]:
        """(1 while it is there, time since it came [s])"""
        return float(self.start <= t < self.start + self.duration), t - self.start

    def behind(self, setting: base.Setting) -> Float[Tensor, " p"]:
        if not self.start <= 0 < self.start + self.duration:
            return super().behind(setting)
        lower, upper, velocity = (setting.position.new_tensor(v) for v in (self.lower, self.upper, self.velocity))
        x = setting.position + self.start * velocity  # where the block was as it came
        return torch.minimum(x - lower, upper - x).amin(1)

    def node(self, real: type) -> wp.Function:
        return _node(real)


@functools.cache
def _node(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"moving_cuboid_{real.__name__}")
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
        velocity = vec3(q[a + 6], q[a + 7], q[a + 8])
        y = x - clock[row, b + 1] * velocity  # where the node was in the block as it came
        above = y[0] >= q[a] and y[1] >= q[a + 1] and y[2] >= q[a + 2]
        below = y[0] <= q[a + 3] and y[1] <= q[a + 4] and y[2] <= q[a + 5]
        if clock[row, b] > real(0.0) and above and below:
            result = velocity
        return result

    return node
