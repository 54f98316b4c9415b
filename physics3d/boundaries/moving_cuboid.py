"""Moving cuboid: a rigid block that travels with a prescribed velocity for some time, then is gone.

Nodes inside the block have its velocity while start <= t < start + duration; the block moves along with it. It acts
only on nodes of particles that touch it, and then up to dx/2 in front of it too, as ground that separates does
(`half_space`): it takes the body along when it arrives, wherever its faces lie between nodes.
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

    def parameters(self, setting: base.Setting) -> Float[Tensor, "11"]:
        """Corners (6) [m], velocity (3) [m/s], how far in front nodes belong to it and what is forgiven a particle
        [m]."""
        # what is on the surface belongs to the block whatever the rounding
        reach = (base.NEAREST * setting.dx, 1e-3 * setting.dx)
        return torch.tensor((*self.lower, *self.upper, *self.velocity, *reach), dtype=torch.float64)

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

    def touch(self, real: type) -> wp.Function:
        return _touch(real)


@functools.cache
def _outside(real: type) -> wp.Function:
    """outside(x, q, a, clock, row, b): how far x is from the block [m], the largest along an axis; < 0 inside."""
    vec3 = vector(real)

    @wp.func
    def outside(x: vec3, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        # where x was in the block as it came
        y = x - clock[row, b + 1] * vec3(q[a + 6], q[a + 7], q[a + 8])
        below = vec3(q[a] - y[0], q[a + 1] - y[1], q[a + 2] - y[2])
        above = vec3(y[0] - q[a + 3], y[1] - q[a + 4], y[2] - q[a + 5])
        return wp.max(wp.max(below), wp.max(above))

    return outside


@functools.cache
def _touch(real: type) -> wp.Function:
    vec3 = vector(real)
    outside = _outside(real)

    @wp.func(name=f"moving_cuboid_touch_{real.__name__}")
    def touch(
        x: vec3,
        radius: real,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        return clock[row, b] > real(0.0) and outside(x, q, a, clock, row, b) <= radius + q[a + 10]

    return touch


@functools.cache
def _node(real: type) -> wp.Function:
    vec3 = vector(real)
    outside = _outside(real)

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
        if clock[row, b] > real(0.0) and outside(x, q, a, clock, row, b) <= q[a + 9]:
            result = vec3(q[a + 6], q[a + 7], q[a + 8])
        return result

    return node
