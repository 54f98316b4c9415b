"""Half-space: a floor or a wall of any direction, sticky, slipping or separating, with Coulomb friction.

For nodes behind the plane, n . (x - point) <= 0, with v_n = v . n and v_t = v - v_n n:
    sticky     v = 0
    slip       v = friction(v_t, |v_n|)
    separate   the same where v_n < 0, else v unchanged
    friction(v_t, j) = v_t max(0, 1 - mu j/|v_t|)
Ground that sticks, or slips without friction, across an axis and on nodes of the grid mirrors (`mirror_nodes`).

A node has momentum of particles up to 1.5 dx away, so these rules alone stop a body a cell before it arrives. Ground
that separates therefore acts only on nodes of particles that touch it, n . (x_p - point) <= V_p^(1/3)/2, and then up to
dx/2 in front of the plane too, so that some layer of nodes is near it wherever it lies. Ground of the other kinds holds
what is on it from the start; what falls on it is caught a cell early.
Source: Stomakhin et al. (2013) A material point method for snow simulation, sec. 8; contact by the distance of the
particles, not by the velocity of the nodes alone: Nairn et al. (2020) New material point method contact algorithms.
"""

import functools
import math
from dataclasses import dataclass
from typing import Literal

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries import base
from physics3d.checks import Direction, NotNegative
from physics3d.warp_types import vector

Kind = Literal["sticky", "slip", "separate"]


@dataclass(frozen=True, kw_only=True)
class HalfSpace(base.AbstractBoundary):
    """Solid ground on the side the normal points away from."""

    point: base.Vector  # of the plane [m]
    normal: Direction  # out of the ground, any length
    kind: Kind = "sticky"
    friction: NotNegative = 0.0  # Coulomb coefficient, for slip and separate

    def parameters(self, setting: base.Setting) -> Float[Tensor, "9"]:
        """Point of the plane (3) [m], unit normal (3), friction, how far in front of it nodes belong to it and what is
        forgiven a particle [m]."""
        normal = torch.tensor(self.normal, dtype=torch.float64)
        # what is on the plane belongs to the ground whatever the rounding
        slack = 1e-3 * setting.dx
        rest = [self.friction, base.NEAREST * setting.dx if self.kind == "separate" else slack, slack]
        return torch.cat(
            [
                torch.tensor(self.point, dtype=torch.float64),
                normal / normal.norm(),
                torch.tensor(rest, dtype=torch.float64),
            ]
        )

    def behind(self, setting: base.Setting) -> Float[Tensor, " p"]:
        normal = setting.position.new_tensor(self.normal)
        return (setting.position.new_tensor(self.point) - setting.position) @ normal / normal.norm()

    def walls(self, setting: base.Setting) -> tuple[base.Wall, ...]:
        length = math.hypot(*self.normal)
        axis = max(range(3), key=lambda i: abs(self.normal[i]))
        slips = self.kind == "slip" and self.friction == 0
        if abs(self.normal[axis]) < (1 - 1e-12) * length or not (slips or self.kind == "sticky"):
            return ()
        side = 1 if self.normal[axis] > 0 else -1
        return (base.Wall(axis=axis, side=side, place=self.point[axis], sticky=not slips),)

    def node(self, real: type) -> wp.Function:
        return _node(real, self.kind)

    def touch(self, real: type) -> wp.Function | None:
        return _touch(real) if self.kind == "separate" else None


@functools.cache
def coulomb(real: type) -> wp.Function:
    """Warp function (v_t, j, mu) -> v_t max(0, 1 - mu j/|v_t|), with a finite adjoint at v_t = 0."""
    vec3 = vector(real)

    @wp.func(name=f"coulomb_{real.__name__}")
    def friction(vt: vec3, j: real, mu: real):
        result = vt
        if mu > real(0.0):
            result = vec3()
            square = wp.dot(vt, vt)
            if square > mu * mu * j * j:
                result = (real(1.0) - mu * j / wp.sqrt(square)) * vt
        return result

    return friction


@functools.cache
def _touch(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"half_space_touch_{real.__name__}")
    def touch(
        x: vec3,
        radius: real,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        n = vec3(q[a + 3], q[a + 4], q[a + 5])
        return wp.dot(n, x - vec3(q[a], q[a + 1], q[a + 2])) <= radius + q[a + 8]

    return touch


@functools.cache
def _node(real: type, kind: str) -> wp.Function:
    vec3 = vector(real)
    friction = coulomb(real)
    sticky, separate = kind == "sticky", kind == "separate"

    @wp.func(name=f"half_space_{kind}_{real.__name__}")
    def node(
        x: vec3,
        v: vec3,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        n = vec3(q[a + 3], q[a + 4], q[a + 5])
        result = v
        if wp.dot(n, x - vec3(q[a], q[a + 1], q[a + 2])) <= q[a + 7]:
            vn = wp.dot(n, v)
            if wp.static(sticky):
                result = vec3()
            elif wp.static(separate):
                if vn < real(0.0):
                    result = friction(v - vn * n, -vn, q[a + 6])
            else:
                result = friction(v - vn * n, wp.abs(vn), q[a + 6])
        return result

    return node
