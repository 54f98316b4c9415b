"""Impulse: a total force on the particles of a ball, for some time; a poke, a gust, the start of every paper video.

    a(t) = force / m(ball),  start <= t < start + duration,  for the particles within `radius` of `centre` AT REST

The force follows the material, and the momentum it gives is force * duration exactly, whatever the substep.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.mpm.boundaries import base
from physics3d.mpm.transfer import vector


@dataclass(frozen=True, kw_only=True)
class Impulse(base.AbstractBoundary):
    """Total force [N] over a ball (centre, radius [m]) of rest positions in a window of time [s].

    The force may be a tensor of three, and the trajectory is differentiable with respect to it. For a momentum P [N s]
    take force = P/duration."""

    force: base.Vector | Tensor
    centre: base.Vector
    radius: float
    start: float = 0.0
    duration: float

    def check(self) -> None:
        base.require_finite(self, "force", "centre", "radius")
        base.require(len(self.force) == 3, self, "force", "three numbers [N]")
        base.require(self.radius > 0, self, "radius", "a length above 0 m")
        base.require_window(self)

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        distance = (setting.position - setting.position.new_tensor(self.centre)).norm(dim=1)
        selected = (distance <= self.radius).to(torch.float64)
        base.require_selected(self, selected)
        return selected

    def parameters(self, setting: base.Setting) -> Float[Tensor, "3"]:
        mass = (self.selection(setting) * setting.mass).sum()
        return torch.as_tensor(self.force, dtype=torch.float64).cpu() / mass

    def signals(self, t: float, dt: float) -> tuple[float]:
        return (base.overlap(self.start, self.duration, t, dt),)

    def acceleration(self, real: type) -> wp.Function:
        return _acceleration(real)


@functools.cache
def _acceleration(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"impulse_{real.__name__}")
    def acceleration(
        weight: real,
        x: vec3,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        return (weight * clock[row, b]) * vec3(q[a], q[a + 1], q[a + 2])

    return acceleration
