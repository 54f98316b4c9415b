"""Held particles: the body does not move where these particles are at rest (a flower where it touches its pot).

What `FixedRegion` is for a box, this is for any set of places, found rather than written down by hand. The face of what
is held lies halfway to the next particle.
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

    def parameters(self, setting: base.Setting) -> Float[Tensor, "0"]:
        return torch.zeros(0, dtype=torch.float64)

    def selection(self, setting: base.Setting) -> Float[Tensor, " p"]:
        return self.holds(setting)

    def holds(self, setting: base.Setting) -> Float[Tensor, " p"]:
        held = torch.zeros(len(setting.position), dtype=torch.float64)
        held[self._nearest(setting)] = 1.0
        return held

    def grip(self, real: type) -> wp.Function:
        return _grip(real)

    def steer(self, real: type) -> wp.Function:
        return gripped.still(real)

    def _nearest(self, setting: base.Setting) -> np.ndarray:
        """Index of the particle nearest to each position."""
        return cKDTree(setting.position.detach().numpy()).query(self._positions().numpy())[1]

    def _positions(self) -> Float[Tensor, "h 3"]:
        return torch.as_tensor(self.position, dtype=torch.float64).detach().cpu()


@functools.cache
def _grip(real: type) -> wp.Function:
    @wp.func(name=f"held_particles_{real.__name__}")
    def grip(weight: real, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        return weight

    return grip
