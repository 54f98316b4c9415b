"""Enforced rotation: part of the body is held and turned about an axis (a hand that twists a stem).

The particles that are in a cylinder AT REST turn rigidly with `angular_velocity` w about the axis k through `point`,
while start <= t < start + duration. Over one substep the turn is exact, so the radius is kept:

    v = (R(w dt) - I)(x - point)/dt = [ sin(w dt) k x r + (1 - cos(w dt)) k x (k x r) ]/dt,     L = (R(w dt) - I)/dt
"""

import functools
import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base, gripped
from physics3d.checks import Direction, Duration, Length, Time
from physics3d.warp_types import vector


@dataclass(frozen=True, kw_only=True)
class EnforcedRotation(base.AbstractBoundary):
    """Turns what is within `radius` of the axis and within `half_height` of `point` along it [m], at rest."""

    point: base.Vector  # on the axis [m]
    axis: Direction  # any length
    radius: Length  # of the cylinder [m]
    half_height: Length  # of the cylinder, along the axis to both sides of the point [m]
    angular_velocity: float  # right-handed about the axis [rad/s]
    start: Time = 0.0
    duration: Duration

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        r = setting.position - setting.position.new_tensor(self.point)
        axis = r.new_tensor(self.axis)
        axis = axis / axis.norm()
        along = r @ axis
        across = (r - along[:, None] * axis).norm(dim=1)
        selected = ((along.abs() <= self.half_height) & (across <= self.radius)).to(torch.float64)
        base.require_selected(self, selected)
        return selected

    def parameters(self, setting: base.Setting) -> Float[Tensor, "6"]:
        axis = torch.tensor(self.axis, dtype=torch.float64)
        return torch.cat([torch.tensor(self.point, dtype=torch.float64), axis / axis.norm()])

    def signals(self, t: float, dt: float) -> tuple[float, float, float]:
        """(1 while it turns, sin(w dt)/dt, (1 - cos(w dt))/dt)"""
        w = self.angular_velocity
        on = float(self.start <= t < self.start + self.duration)
        if dt == 0:
            return on, w, 0.0
        return on, math.sin(w * dt) / dt, 2 * math.sin(w * dt / 2) ** 2 / dt

    def grip(self, real: type) -> wp.Function:
        return gripped.while_on(real)

    def steer(self, real: type) -> wp.Function:
        return _steer(real)


@functools.cache
def _steer(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"enforced_rotation_{real.__name__}")
    def steer(
        x: vec3,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        K = wp.skew(vec3(q[a + 3], q[a + 4], q[a + 5]))
        gradient = clock[row, b + 1] * K + clock[row, b + 2] * (K * K)
        return gradient * (x - vec3(q[a], q[a + 1], q[a + 2])), gradient

    return steer
