"""A body with fewer particles, and how its own ride on them: what a grid can move while somebody looks.

Particles of the same part that are held alike and lie in one cube, `factor` spacings wide, become one at their centre
of mass, of their volume together: mass, centre of mass, and which force acts on what, are kept exactly. Parameters that
vary over the body are their means. The body's own particles follow as Gaussians follow particles
(`gaussians/carry.py`).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.filling.body import Body
from physics3d.gaussians.embedding import embed
from physics3d.materials.base import Values
from physics3d.materials.mixture import PART
from physics3d.view.riders import Carried
from physics3d.world import World


@dataclass(frozen=True, kw_only=True)
class Coarse:
    """c particles for the p of a body."""

    position: Float[Tensor, "c 3"]  # at rest [m], float64
    volume: Float[Tensor, " c"]  # [m^3], float64
    held: tuple[AbstractBoundary, ...]  # what holds it where the body is attached
    own: Int[np.ndarray, " p"]  # which of them stands for each particle of the body
    share: Float[np.ndarray, " p"]  # of its volume
    carried: Carried | None  # how the body's particles follow; None: they are these

    def mean(self, value: Float[np.ndarray, " p"]) -> Float[np.ndarray, " c"]:
        """Of a number of the body's particles, by volume."""
        return np.bincount(self.own, weights=self.share * value, minlength=len(self.position))

    def parameters(self, values: Values) -> Values:
        """Those of the body: numbers as they are, one per particle as their means."""
        first = np.unique(self.own, return_index=True)[1]
        found = {}
        for name, value in values.items():
            value = torch.as_tensor(value)
            if value.ndim == 0:
                found[name] = value
            elif name == PART:  # the same of all that became one
                found[name] = value[torch.from_numpy(first)]
            else:
                found[name] = torch.from_numpy(self.mean(value.detach().double().cpu().numpy()))
        return found

    def fine(
        self, x: Float[Tensor, "c 3"], F: Float[Tensor, "c 3 3"], v: Float[Tensor, "c 3"]
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        """Positions [m], deformation gradients and velocities [m/s] of the body's particles; in float32 if carried."""
        if self.carried is None:
            return x, F, v
        place, G = self.carried(x, F)
        return _tensor(place.T), _tensor(G.transpose(2, 0, 1)), _tensor(self.blend(v.numpy()))

    def blend(self, value: Float[np.ndarray, "c *k"]) -> Float[np.ndarray, "p *k"]:
        """Numbers of these particles, at the body's own."""
        return value if self.carried is None else self.carried.blend(value.astype(np.float32))


def coarser(body: Body, world: World, factor: float) -> Coarse:
    """The body with particles `factor` times as far apart; with its own for a factor of 1."""
    x, volume = body.position.double().cpu().numpy(), body.volume.double().cpu().numpy()
    p = len(x)
    if factor <= 1:
        own, carried, position = np.arange(p), None, body.position.double().cpu()
        return Coarse(
            position=position, volume=torch.from_numpy(volume), held=body.held, own=own, share=np.ones(p), carried=None
        )
    cell = np.floor((x - x.min(0) + body.spacing / 2) / (factor * body.spacing)).astype(np.int64)
    attached = np.zeros(p, bool) if body.attached is None else body.attached.cpu().numpy()
    alike = np.column_stack([cell, body.part.cpu().numpy(), attached, *_holds(body, world)])
    _, own = np.unique(alike, axis=0, return_inverse=True)
    own = own.reshape(-1)
    total = np.bincount(own, weights=volume)
    share = volume / total[own]
    position = torch.from_numpy(np.stack([np.bincount(own, weights=share * x[:, k]) for k in range(3)], 1))
    first = np.unique(own, return_index=True)[1]
    held_at = position[torch.from_numpy(attached[first])]
    parts = (body.part.long().cpu(), body.part.long().cpu()[torch.from_numpy(first)])
    embedding = embed(body.position.cpu(), torch.arange(p), position, factor * body.spacing, parts=parts)
    carried = Carried(embedding, position, body.position.cpu())
    return Coarse(
        position=position,
        volume=torch.from_numpy(total),
        held=(HeldParticles(position=held_at),) if len(held_at) else (),
        own=own,
        share=share,
        carried=carried,
    )


def _tensor(value: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(value))


def _holds(body: Body, world: World) -> list[np.ndarray]:
    """Which particles each boundary of the world holds at rest."""
    x, volume = body.position.double().cpu(), body.volume.double().cpu()
    lower, upper = (tuple(v.tolist()) for v in (x.amin(0), x.amax(0)))
    setting = Setting(position=x, mass=world.density * volume, volume=volume, lower=lower, upper=upper, dx=world.dx)
    return [boundary.holds(setting).numpy() for boundary in world.boundaries]
