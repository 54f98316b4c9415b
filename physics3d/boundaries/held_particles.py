"""Held particles: the body does not move where these particles are at rest (a flower where it touches its pot).

What `FixedRegion` is for a box, this is for any set of places, found rather than written down by hand. A grid node has
no velocity if it is the nearest one of a held particle, or gets three tenths of its mass from held ones at rest (a
layer of them half a cell thick gives that); of the particles in a box these are the nodes of the box.

The nodes are a table over the box around them, in `parameters`:
    corner (3) [m], 1/dx [1/m], nodes along each axis (3), then 1 or 0 for each node.
"""

import functools
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.boundaries import base
from physics3d.warp_types import vector

SHARE = 0.3  # of a node's mass


@dataclass(frozen=True, kw_only=True)
class HeldParticles(base.AbstractBoundary):
    """Holds the particles that are nearest to the positions [m] at rest."""

    position: Float[Tensor, "h 3"] | tuple[base.Vector, ...]

    def check(self) -> None:
        try:
            shape, finite = self._positions().shape, bool(torch.isfinite(self._positions()).all())
        except (TypeError, ValueError):
            shape, finite = torch.Size(), False
        right = len(shape) == 2 and shape[0] > 0 and shape[1] == 3
        base.require(right and finite, self, "position", "finite positions [h, 3] in metres, at least one")

    def parameters(self, setting: base.Setting) -> Float[Tensor, " k"]:
        held = self._nearest(setting)
        lower = torch.tensor(setting.lower, dtype=torch.float64)
        cells = (setting.position - lower) / setting.dx
        reach = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
        node = cells.round().long()[:, None] + reach  # [p, 27, 3]
        distance = (cells[:, None] - node).abs()
        weight = torch.where(distance < 0.5, 0.75 - distance**2, 0.5 * (1.5 - distance) ** 2).prod(2)
        mass = weight * setting.mass[:, None]
        first = node[held].amin((0, 1))
        count = node[held].amax((0, 1)) - first + 1
        near = ((node >= first) & (node < first + count)).all(2)
        flat = ((node - first) * torch.tensor([int(count[1] * count[2]), int(count[2]), 1])).sum(2)
        mine = torch.zeros(len(node), 1, dtype=torch.bool)
        mine[held] = True
        total, own = (
            torch.zeros(int(count.prod()), dtype=torch.float64).index_add_(0, flat[chosen], mass[chosen])
            for chosen in (near, near & mine)
        )
        still = (own > 0) & (own >= SHARE * total)
        still[flat[held, len(reach) // 2]] = True
        head = torch.cat([lower + first * setting.dx, torch.tensor([1 / setting.dx], dtype=torch.float64)])
        return torch.cat([head, count.double(), still.double()])

    def holds(self, setting: base.Setting) -> Float[Tensor, " p"]:
        held = torch.zeros(len(setting.position), dtype=torch.float64)
        held[self._nearest(setting)] = 1.0
        return held

    def node(self, real: type) -> wp.Function:
        return _node(real)

    def _nearest(self, setting: base.Setting) -> np.ndarray:
        """Index of the particle nearest to each position."""
        return cKDTree(setting.position.numpy()).query(self._positions().numpy())[1]

    def _positions(self) -> Float[Tensor, "h 3"]:
        return torch.as_tensor(self.position, dtype=torch.float64).detach().cpu()


@functools.cache
def _node(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"held_particles_{real.__name__}")
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
        per_metre, half = q[a + 3], real(0.5)
        i = int(wp.floor((x[0] - q[a]) * per_metre + half))
        j = int(wp.floor((x[1] - q[a + 1]) * per_metre + half))
        k = int(wp.floor((x[2] - q[a + 2]) * per_metre + half))
        nx, ny, nz = int(q[a + 4]), int(q[a + 5]), int(q[a + 6])
        inside = i >= 0 and j >= 0 and k >= 0 and i < nx and j < ny and k < nz
        at = wp.where(inside, (i * ny + j) * nz + k, 0)
        if inside and q[a + 7 + at] > half:
            result = vec3()
        return result

    return node
