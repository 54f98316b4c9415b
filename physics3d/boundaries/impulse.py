"""Impulse: a total force on part of the body for some time; a poke, a gust, the start of every paper video.

    a(t) = force / m(part)  or  acceleration,   start <= t < start + duration,   for the particles AT REST in the region

The region is a ball (centre, radius), a box (lower, upper), or the so many particles `nearest` to a centre. The force
follows the material, and the momentum it gives is force * duration exactly, whatever the substep.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, TypeGuard

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.checks import Corners, Count, Duration, Keys, Length, Time, exactly_one
from physics3d.warp_types import vector

Force = Annotated[Mapping[str, float], Keys(("x", "y", "z"))]  # [N]


@dataclass(frozen=True, kw_only=True)
class Impulse(base.AbstractBoundary):
    """Total force [N] on the particles of a region, or acceleration [m/s^2] of each, in a window of time [s].

    Either may be a tensor of three, and the trajectory is differentiable with respect to it. For a momentum P [N s]
    take force = P/duration."""

    force: base.Vector | Tensor | None = None  # in total [N]
    acceleration_of_each: base.Vector | Tensor | None = None  # of each particle there, whatever it weighs [m/s^2]
    centre: base.Vector | None = None  # of the ball, or what the nearest particles are near [m]
    radius: Length | None = None  # of the ball [m]
    nearest: Count | None = None  # so many particles, those nearest to the centre
    lower: base.Vector | None = None  # corners of a box [m]
    upper: base.Vector | None = None
    start: Time = 0.0
    duration: Duration

    RULES = (
        exactly_one("force", "acceleration_of_each"),
        Corners("lower", "upper"),
        exactly_one("radius", "nearest", "lower"),
        exactly_one("centre", "lower"),
    )

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        if self.lower is not None and self.upper is not None:
            selected = base.inside_box(setting.position, self.lower, self.upper)
        else:
            distance = (setting.position - setting.position.new_tensor(self.centre)).norm(dim=1)
            if self.radius is not None:
                selected = (distance <= self.radius).to(torch.float64)
            else:
                selected = torch.zeros_like(distance)
                selected[distance.argsort(stable=True)[: self.nearest]] = 1.0
        base.require_selected(self, selected)
        return selected

    def parameters(self, setting: base.Setting) -> Float[Tensor, "3"]:
        if self.acceleration_of_each is not None:
            return torch.as_tensor(self.acceleration_of_each, dtype=torch.float64).cpu()
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


def excited(
    excitation: tuple[base.AbstractBoundary, ...], force: Mapping[str, float] | None
) -> tuple[base.AbstractBoundary, ...]:
    """The excitation with `force` [N] in place of that of every impulse, and without impulses of no force."""
    if force is None:
        return tuple(excitation)
    vector = (float(force["x"]), float(force["y"]), float(force["z"]))
    pushed = tuple(replace(b, force=vector) if has_force(b) else b for b in excitation)
    return tuple(b for b in pushed if any(vector) or not has_force(b))


def has_force(boundary: base.AbstractBoundary) -> TypeGuard[Impulse]:
    """Whether it pushes with a total force."""
    return isinstance(boundary, Impulse) and boundary.force is not None
