"""Enforced translation: part of the body is held and moved along a line (two fingers that pull a leaf).

The particles that are in the box AT REST move with `velocity`, rigidly, while start <= t < start + duration; afterwards
they are free.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.checks import Corners, Duration, Time
from physics3d.warp_types import matrix, vector


@dataclass(frozen=True, kw_only=True)
class EnforcedTranslation(base.AbstractBoundary):
    """Moves what is between the corners lower and upper [m] at rest with `velocity` [m/s]; zero holds it."""

    lower: base.Vector
    upper: base.Vector
    velocity: base.Vector
    start: Time = 0.0
    duration: Duration

    RULES = (Corners("lower", "upper"),)

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        selected = base.inside_box(setting.position, self.lower, self.upper)
        base.require_selected(self, selected)
        return selected

    def parameters(self, setting: base.Setting) -> Float[Tensor, "3"]:
        return torch.tensor(self.velocity, dtype=torch.float64)

    def signals(self, t: float, dt: float) -> tuple[float]:
        return (float(self.start <= t < self.start + self.duration),)

    def steer(self, real: type) -> wp.Function:
        return _steer(real)


@functools.cache
def _steer(real: type) -> wp.Function:
    vec3, mat33 = vector(real), matrix(real)

    @wp.func(name=f"enforced_translation_{real.__name__}")
    def steer(
        weight: real,
        x: vec3,
        v: vec3,
        L: mat33,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        speed, gradient = v, L
        if clock[row, b] > real(0.0):
            speed, gradient = vec3(q[a], q[a + 1], q[a + 2]), mat33()
        return speed, gradient

    return steer
