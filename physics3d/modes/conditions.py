"""What the boundary conditions of a scene are to a body without a grid: matter that is held, forces, springs.

    FixedRegion, HeldParticles   for good: their matter is no part of the problem, its interface is pinned
    the same for some time, EnforcedTranslation, EnforcedRotation
                                 from the start on: springs to the prescribed place, for as long as they act
    Impulse                      a force on the matter of the particles it selects
    HalfSpace, BoundingBox       nothing, as long as the body does not touch them; `touched` looks at that

Everything else, and holds that begin later, need the grid: `Refused` says so.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.boundaries.bounding_box import BoundingBox
from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.enforced_translation import EnforcedTranslation
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.boundaries.impulse import Impulse
from physics3d.matter import Matter
from physics3d.modes.cuts import Pins, outside_box, outside_particles

WALLS = (HalfSpace, BoundingBox)


class Refused(ValueError):
    """This needs the grid."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """acceleration * signal on particles with a weight."""

    boundary: Impulse
    weight: np.ndarray  # [p]
    acceleration: Tensor  # [3] [m/s^2], differentiable


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Particles that are held or moved until a time; afterwards they are free."""

    particles: np.ndarray  # [p] bool
    until: float  # [s]
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m/s]
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the axis [m]
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # angular velocity [rad/s]

    def motion(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """(R - I, d): the target of X is X + (R - I)(X - point) + d."""
        w = np.array(self.spin)
        angle = float(np.linalg.norm(w)) * t
        k = w / max(float(np.linalg.norm(w)), 1e-300)
        K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        return math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K), t * np.array(self.velocity)


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """The free matter of a body, and what acts on it."""

    matter: Matter
    pins: tuple[Pins, ...]
    held: np.ndarray  # [p] bool: particles that never move
    loads: tuple[Load, ...]
    grips: tuple[Grip, ...]
    walls: tuple[HalfSpace | BoundingBox, ...]


def conditions(boundaries: Sequence[AbstractBoundary], setting: Setting, matter: Matter) -> Conditions:
    """Raises Refused, naming the boundary."""
    boxes, held_particles, loads, grips, walls = [], [], [], [], []
    p = len(setting.position)
    for boundary in boundaries:
        boundary.check()
        name = type(boundary).__name__
        start = getattr(boundary, "start", 0.0)
        if isinstance(boundary, Impulse):
            weight = boundary.selection(setting).numpy()
            loads.append(Load(boundary=boundary, weight=weight, acceleration=boundary.parameters(setting)))
        elif isinstance(boundary, WALLS):
            walls.append(boundary)
        elif isinstance(boundary, HeldParticles):
            places = torch.as_tensor(boundary.position, dtype=torch.float64).detach().cpu().numpy()
            mask = np.zeros(p, bool)
            mask[cKDTree(setting.position.numpy()).query(places)[1]] = True
            held_particles.append(mask)
        elif not isinstance(boundary, FixedRegion | EnforcedTranslation | EnforcedRotation):
            raise Refused(f"{name} acts on nodes of the grid")
        elif start > 0:
            raise Refused(f"{name} begins at {start:g} s, on a body that moves")
        elif isinstance(boundary, FixedRegion) and math.isinf(boundary.duration):
            boxes.append((boundary.lower, boundary.upper))
        else:
            until = boundary.start + boundary.duration
            if isinstance(boundary, FixedRegion):
                x = setting.position
                inside = ((x >= x.new_tensor(boundary.lower)) & (x <= x.new_tensor(boundary.upper))).all(1).numpy()
                grips.append(Grip(particles=inside, until=until))
            elif isinstance(boundary, EnforcedTranslation):
                chosen = boundary.selection(setting).numpy() > 0
                grips.append(Grip(particles=chosen, until=until, velocity=boundary.velocity))
            else:
                axis = np.array(boundary.axis) / np.linalg.norm(boundary.axis)
                grips.append(
                    Grip(
                        particles=boundary.selection(setting).numpy() > 0,
                        until=until,
                        point=boundary.point,
                        spin=tuple(boundary.angular_velocity * axis),
                    )
                )
    pins: list[Pins] = []

    def take(cut: tuple[Matter, Pins, np.ndarray]) -> Matter:
        rest, more, keep = cut
        pins[:] = [*(old.renumbered(keep) for old in pins), more]
        return rest

    for lower, upper in boxes:
        matter = take(outside_box(matter, lower, upper))
        if not len(pins[-1]):
            raise Refused(f"FixedRegion from {lower} to {upper} m holds nothing that the body hangs on; enlarge it")
    for mask in held_particles:
        matter = take(outside_particles(matter, mask))
    if not len(matter.position):
        raise Refused("the body is held everywhere")
    free = np.unique(matter.owner.numpy())
    held = np.ones(p, bool)
    held[free] = False
    return Conditions(
        matter=matter, pins=tuple(pins), held=held, loads=tuple(loads), grips=tuple(grips), walls=tuple(walls)
    )


def touched(
    walls: Sequence[HalfSpace | BoundingBox], position: Float[Tensor, "t p 3"], radius: Float[Tensor, " p"]
) -> tuple[AbstractBoundary, int] | None:
    """The first wall that particles at `position` [m], half the edge of a cube large, reach, and in which frame."""
    first = None
    for wall in walls:
        if isinstance(wall, HalfSpace):
            normal = position.new_tensor(wall.normal)
            depth = (position - position.new_tensor(wall.point)) @ (normal / normal.norm()) - radius
        else:
            low, high = (position - position.new_tensor(wall.lower)), (position.new_tensor(wall.upper) - position)
            depth = torch.minimum(low, high).amin(-1) - radius
        frames = (depth < 0).any(1).nonzero()
        if len(frames) and (first is None or int(frames[0]) < first[1]):
            first = wall, int(frames[0])
    return first
