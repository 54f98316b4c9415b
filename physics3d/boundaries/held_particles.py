"""Held particles: the body does not move where these particles are at rest (a flower where it touches its pot).

What `FixedRegion` is for a box, this is for any set of places, found rather than written down by hand. The face of what
is held lies halfway between it and the particles next to it: a facet for each particle at the face, across the mean
way to its free neighbours. A place is as far before the face as it is before the nearest facet. In `parameters`:
    number of facets, then for each its centre (3) [m] and its unit normal (3), out of what is held.
"""

import functools
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.boundaries import base, gripped
from physics3d.warp_types import vector

BESIDE = 1.3  # particles so far apart are neighbours [of the least distance from a held one to a free one]


@dataclass(frozen=True, kw_only=True)
class HeldParticles(base.AbstractBoundary):
    """Holds the particles that are nearest to the positions [m] at rest."""

    position: Float[Tensor, "h 3"] | tuple[base.Vector, ...]  # the nearest particle to each is held [m]

    def check(self) -> None:
        try:
            shape, finite = self._positions().shape, bool(torch.isfinite(self._positions()).all())
        except (TypeError, ValueError):
            shape, finite = torch.Size(), False
        right = len(shape) == 2 and shape[0] > 0 and shape[1] == 3
        base.require(right and finite, self, "position", "finite positions [h, 3] in metres, at least one")

    def parameters(self, setting: base.Setting) -> Float[Tensor, " k"]:
        facets = self._facets(setting)
        return torch.cat([torch.tensor([float(len(facets))], dtype=torch.float64), facets.flatten()])

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        return self.holds(setting)

    def holds(self, setting: base.Setting) -> Float[Tensor, " p"]:
        held = torch.zeros(len(setting.position), dtype=torch.float64)
        held[self._nearest(setting)] = 1.0
        return held

    def grip(self, real: type) -> wp.Function:
        return _grip(real)

    def ahead(self, real: type) -> wp.Function:
        return _ahead(real)

    def steer(self, real: type) -> wp.Function:
        return gripped.still(real)

    def _facets(self, setting: base.Setting) -> Float[Tensor, "f 6"]:
        """Differentiable in the places of the particles."""
        position, mine = setting.position.double(), self.holds(setting) > 0
        held, free = position[mine], position[~mine]
        far = position.new_tensor([[0.0, 0.0, 1e9, 0.0, 0.0, 1.0]])  # nothing free anywhere near: all is behind it
        if not len(free):
            return far
        tree, at = cKDTree(free.detach().numpy()), held.detach().numpy()
        spacing = float(tree.query(at)[0].min())
        facets = []
        for place, others in zip(held, tree.query_ball_point(at, BESIDE * spacing), strict=True):
            way = (free[others] - place).mean(0) if others else torch.zeros_like(place)
            length = torch.linalg.norm(way)
            if length > 1e-6 * spacing:  # free matter on two sides of one particle has no one face with it
                facets.append(torch.cat([place + way / 2, way / length]))
        return torch.stack(facets) if facets else far

    def _nearest(self, setting: base.Setting) -> np.ndarray:
        """Index of the particle nearest to each position."""
        return cKDTree(setting.position.detach().numpy()).query(self._positions().numpy())[1]

    def _positions(self) -> Float[Tensor, "h 3"]:
        return torch.as_tensor(self.position, dtype=torch.float64).detach().cpu()


@functools.cache
def _ahead(real: type) -> wp.Function:
    vec3 = vector(real)

    @wp.func(name=f"nearest_facet_{real.__name__}")
    def nearest(x: vec3, q: wp.array(dtype=real), a: int):
        found, least = a + 1, real(1e30)
        for k in range(int(q[a])):
            at = a + 1 + 6 * k
            distance = wp.length_sq(x - vec3(q[at], q[at + 1], q[at + 2]))
            if distance < least:
                least = distance
                found = at
        return found

    # apart from the search: what a loop of unknown length overwrites has no right adjoint
    @wp.func(name=f"before_held_particles_{real.__name__}")
    def ahead(x: vec3, q: wp.array(dtype=real), a: int):
        at = nearest(x, q, a)
        return wp.dot(x - vec3(q[at], q[at + 1], q[at + 2]), vec3(q[at + 3], q[at + 4], q[at + 5]))

    return ahead


@functools.cache
def _grip(real: type) -> wp.Function:
    @wp.func(name=f"held_particles_{real.__name__}")
    def grip(weight: real, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        return weight

    return grip
