"""Bounding box: six walls around the simulated region, or around a box of one's own.

On nodes at or beyond a wall: sticky, v = 0; slip, no velocity across the wall; separate, none outwards. A corner obeys
all its walls. Nothing passes, so particles cannot leave the region. Sticky and slip walls on nodes of the grid mirror
(`mirror_nodes`), which is what their accuracy comes from.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.boundaries.half_space import Kind
from physics3d.checks import Corners
from physics3d.warp_types import vector


@dataclass(frozen=True, kw_only=True)
class BoundingBox(base.AbstractBoundary):
    """Walls at lower and upper [m]; None takes the border of the simulated region."""

    kind: Kind = "slip"
    lower: base.Vector | None = None
    upper: base.Vector | None = None

    RULES = (Corners("lower", "upper"),)

    def parameters(self, setting: base.Setting) -> Float[Tensor, "6"]:
        lower = torch.tensor(self.lower or setting.lower, dtype=torch.float64)
        upper = torch.tensor(self.upper or setting.upper, dtype=torch.float64)
        slack = 1e-3 * setting.dx  # a node on the wall belongs to it whatever the rounding
        return torch.cat([lower + slack, upper - slack])

    def behind(self, setting: base.Setting) -> Float[Tensor, " p"]:
        lower, upper = (
            setting.position.new_tensor(c) for c in (self.lower or setting.lower, self.upper or setting.upper)
        )
        return torch.maximum(lower - setting.position, setting.position - upper).amax(1)

    def walls(self, setting: base.Setting) -> tuple[base.Wall, ...]:
        if self.kind == "separate":
            return ()
        sides = ((1, self.lower or setting.lower), (-1, self.upper or setting.upper))
        return tuple(
            base.Wall(axis=axis, side=side, place=corner[axis], sticky=self.kind == "sticky")
            for side, corner in sides
            for axis in range(3)
        )

    def node(self, real: type) -> wp.Function:
        return _node(real, self.kind)


@functools.cache
def _node(real: type, kind: str) -> wp.Function:
    vec3 = vector(real)
    sticky, separate = kind == "sticky", kind == "separate"

    @wp.func(name=f"bounding_box_{kind}_{real.__name__}")
    def node(
        x: vec3,
        v: vec3,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        zero = real(0.0)
        keep = vec3(real(1.0), real(1.0), real(1.0))
        below = vec3(q[a] - x[0], q[a + 1] - x[1], q[a + 2] - x[2])
        above = vec3(x[0] - q[a + 3], x[1] - q[a + 4], x[2] - q[a + 5])
        if wp.static(sticky):
            if wp.max(below) >= zero or wp.max(above) >= zero:
                keep = vec3()
        else:
            for i in range(3):
                if wp.static(separate):
                    if (below[i] >= zero and v[i] < zero) or (above[i] >= zero and v[i] > zero):
                        keep[i] = zero
                else:
                    if below[i] >= zero or above[i] >= zero:
                        keep[i] = zero
        return wp.cw_mul(keep, v)

    return node
