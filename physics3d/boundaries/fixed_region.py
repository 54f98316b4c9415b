"""Fixed region: nothing moves in this box, as if it were clamped (a stem in its pot, the held end of a bar).

For good, or for start <= t < start + duration (held, then let go). Matter that is in the box AT REST is gripped, and of
a particle that its face cuts, a cube at rest, the part inside: the body is held where the face is written, and what
moves is smooth in the place of the face. Nodes in the box with nothing of that matter have no velocity, so what comes
later is stopped at the last of them."""

import functools
import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base, gripped
from physics3d.checks import Corners, Lasting, Time
from physics3d.warp_types import vector


@dataclass(frozen=True, kw_only=True)
class FixedRegion(base.AbstractBoundary):
    """Holds what is between the corners lower and upper [m]."""

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

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        """Share of each particle that is in the box."""
        edge = setting.volume.to(setting.position)[:, None] ** (1 / 3)
        lower, upper = setting.position.new_tensor(self.lower), setting.position.new_tensor(self.upper)
        x = setting.position
        inside = torch.minimum(x + edge / 2, upper) - torch.maximum(x - edge / 2, lower)
        share = (inside / edge).clamp(0, 1).prod(1)
        # what is inside but for rounding is inside
        return torch.where(share > 1 - 1e-9, torch.ones_like(share), torch.where(share < 1e-9, 0.0 * share, share))

    def holds(self, setting: base.Setting) -> Float[Tensor, " p"]:
        inside = base.inside_box(setting.position, self.lower, self.upper)
        return inside if self.start <= 0 else torch.zeros_like(inside)

    def grip(self, real: type) -> wp.Function:
        return gripped.while_on(real)

    def ahead(self, real: type) -> wp.Function:
        return _ahead(real)

    def steer(self, real: type) -> wp.Function:
        return gripped.still(real)

    def node(self, real: type) -> wp.Function:
        return _node(real)


@functools.cache
def _ahead(real: type) -> wp.Function:
    """Signed distance from a box."""
    vec3 = vector(real)

    @wp.func(name=f"before_region_{real.__name__}")
    def ahead(x: vec3, q: wp.array(dtype=real), a: int):
        lower, upper = vec3(q[a], q[a + 1], q[a + 2]), vec3(q[a + 3], q[a + 4], q[a + 5])
        out = wp.max(lower - x, x - upper)
        return wp.length(wp.max(out, vec3())) + wp.min(wp.max(out[0], wp.max(out[1], out[2])), real(0.0))

    return ahead


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
