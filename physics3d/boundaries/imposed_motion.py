"""Imposed motion: part of the body follows a table over time (a hand, the jaws of a testing machine, measured marks).

The particles that are in a box AT REST, but not in a hole of it if there is one, move affinely from the first time on,

    x = c + d(t) + A(t) (X - c)

with d and A linear between the rows of their tables; after the last one they are free. Over a substep from A, d to
A', d' this is exact for any dt:

    v = [d' - d + (A' A^-1 - 1)(x - c - d)]/dt,     L = (A' A^-1 - 1)/dt

What has started to move by then moves on from where it is. The tables may be tensors, and the trajectory is
differentiable with respect to them. In a scene:

    boundaries:
      - _target_: physics3d.boundaries.imposed_motion.ImposedMotion # the jaw goes up by 5 mm and back
        lower: [-1.0, -1.0, 0.09] # [m]
        upper: [1.0, 1.0, 1.0]
        times: [0.0, 0.5, 1.0] # [s]
        displacement: [[0.0, 0.0, 0.0], [0.0, 0.0, 0.005], [0.0, 0.0, 0.0]] # [m]
"""

import functools
from bisect import bisect_right
from dataclasses import dataclass
from typing import Annotated

import torch
import warp as wp
from annotated_types import MinLen
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base, gripped
from physics3d.checks import Ascending, Corners, Time
from physics3d.warp_types import matrix, vector

Rows = tuple[base.Vector, base.Vector, base.Vector]


@dataclass(frozen=True, kw_only=True)
class ImposedMotion(base.AbstractBoundary):
    """Moves what is between lower and upper [m] at rest by tables over `times`; a row for each time."""

    lower: base.Vector
    upper: base.Vector
    hole_lower: base.Vector | None = None  # matter between these corners is free [m]
    hole_upper: base.Vector | None = None
    times: Annotated[tuple[Time, ...], MinLen(2), Ascending()]  # of the rows of the tables [s]
    displacement: Float[Tensor, "k 3"] | tuple[base.Vector, ...]  # d [m]
    deformation: Float[Tensor, "k 3 3"] | tuple[Rows, ...] | None = None  # A [1]; None: the identity
    centre: base.Vector = (0.0, 0.0, 0.0)  # c [m]

    RULES = (Corners("lower", "upper"), Corners("hole_lower", "hole_upper"))

    def check(self) -> None:
        super().check()
        count = len(self.times)
        apart = all(b > a for a, b in zip(self.times, self.times[1:]))
        base.require(apart, self, "times", "times of which each is after the one before it")
        self._check_table("displacement", (count, 3), f"{count} rows of 3 numbers, one for each time")
        if self.deformation is not None:
            self._check_table("deformation", (count, 3, 3), f"{count} matrices of 3 x 3 numbers, one for each time")
            right = bool((torch.linalg.det(self._deformations().detach()) > 0).all())
            base.require(right, self, "deformation", "matrices with a determinant above 0")

    def _check_table(self, field: str, shape: tuple[int, ...], remedy: str) -> None:
        try:
            table = torch.as_tensor(getattr(self, field), dtype=torch.float64)
        except (TypeError, ValueError):  # ragged rows, or something that is no number
            table = torch.empty(0)
        base.require(table.shape == shape and bool(table.isfinite().all()), self, field, remedy)

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        selected = base.inside_box(setting.position, self.lower, self.upper)
        if self.hole_lower is not None and self.hole_upper is not None:
            selected = selected * (1 - base.inside_box(setting.position, self.hole_lower, self.hole_upper))
        base.require_selected(self, selected)
        return selected

    def parameters(self, setting: base.Setting) -> Float[Tensor, " n"]:
        """Centre (3), then for each time d (3) and A (9)."""
        d = torch.as_tensor(self.displacement, dtype=torch.float64).cpu()
        rows = torch.cat([d, self._deformations().flatten(1)], 1)
        return torch.cat([torch.tensor(self.centre, dtype=torch.float64), rows.flatten()])

    def signals(self, t: float, dt: float) -> tuple[float, ...]:
        """1 while it acts; the row before t, the share of the way to the next one; the same of t + dt; 1/dt [1/s]."""
        on = float(self.times[0] <= t < self.times[-1])
        step = dt if dt > 0 else 1e-3 * (self.times[1] - self.times[0])
        return (on, *self._place(t), *self._place(t + step), 1 / step)

    def grip(self, real: type) -> wp.Function:
        return gripped.while_on(real)

    def steer(self, real: type) -> wp.Function:
        return _steer(real)

    def _deformations(self) -> Float[Tensor, "k 3 3"]:
        if self.deformation is None:
            return torch.eye(3, dtype=torch.float64).expand(len(self.times), 3, 3)
        return torch.as_tensor(self.deformation, dtype=torch.float64).cpu()

    def _place(self, t: float) -> tuple[float, float]:
        t = min(max(t, self.times[0]), self.times[-1])
        row = min(bisect_right(self.times, t), len(self.times) - 1) - 1
        return float(row), (t - self.times[row]) / (self.times[row + 1] - self.times[row])


@functools.cache
def _steer(real: type) -> wp.Function:
    vec3, mat33 = vector(real), matrix(real)

    @wp.func
    def moved(q: wp.array(dtype=real), a: int, s: real):
        return (real(1.0) - s) * vec3(q[a], q[a + 1], q[a + 2]) + s * vec3(q[a + 12], q[a + 13], q[a + 14])

    @wp.func
    def row_at(q: wp.array(dtype=real), a: int):
        return mat33(q[a], q[a + 1], q[a + 2], q[a + 3], q[a + 4], q[a + 5], q[a + 6], q[a + 7], q[a + 8])

    @wp.func(name=f"imposed_motion_{real.__name__}")
    def steer(x: vec3, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        one = real(1.0)
        now, s = a + 3 + 12 * int(clock[row, b + 1]), clock[row, b + 2]
        then, r = a + 3 + 12 * int(clock[row, b + 3]), clock[row, b + 4]
        A = (one - s) * row_at(q, now + 3) + s * row_at(q, now + 15)
        B = (one - r) * row_at(q, then + 3) + r * row_at(q, then + 15)
        d, e = moved(q, now, s), moved(q, then, r)
        rate = clock[row, b + 5]
        L = rate * (B * wp.inverse(A) - wp.identity(n=3, dtype=real))
        v = rate * (e - d) + L * (x - vec3(q[a], q[a + 1], q[a + 2]) - d)
        return v, L

    return steer
