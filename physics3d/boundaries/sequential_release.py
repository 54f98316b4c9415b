"""Sequential release: the body hangs still and is let go layer by layer (a towel slipping off, a row of falling beads).

The box between lower and upper [m] is cut AT REST into `layers` equal slices along `direction`; slice i is held until
t = start + i * interval.
"""

import functools
import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.checks import Corners, Count, Direction, Duration, Time
from physics3d.warp_types import matrix, vector


@dataclass(frozen=True, kw_only=True)
class SequentialRelease(base.AbstractBoundary):
    """Holds the particles of a box and releases them slice by slice, the first at `start` [s]."""

    lower: base.Vector
    upper: base.Vector
    direction: Direction  # from the slice that is released first to the last, any length
    layers: Count
    start: Time = 0.0
    interval: Duration  # [s]

    RULES = (Corners("lower", "upper"),)

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        """1 + number of the slice."""
        selected = base.inside_box(setting.position, self.lower, self.upper)
        base.require_selected(self, selected)
        along = setting.position @ setting.position.new_tensor(self.direction)
        low, high = along[selected > 0].min(), along[selected > 0].max()
        layer = ((along - low) / (high - low).clamp(min=1e-300) * self.layers).floor().clamp(0, self.layers - 1)
        return selected * (1 + layer)

    def parameters(self, setting: base.Setting) -> Float[Tensor, "0"]:
        return torch.zeros(0, dtype=torch.float64)

    def signals(self, t: float, dt: float) -> tuple[float]:
        """How many slices are free."""
        return (math.floor((t - self.start) / self.interval + 1e-9) + 1.0,)

    def steer(self, real: type) -> wp.Function:
        return _steer(real)


@functools.cache
def _steer(real: type) -> wp.Function:
    vec3, mat33 = vector(real), matrix(real)

    @wp.func(name=f"sequential_release_{real.__name__}")
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
        if weight > clock[row, b] + real(0.5):
            speed, gradient = vec3(), mat33()
        return speed, gradient

    return steer
