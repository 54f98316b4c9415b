"""Which solver moves a body, and why: the grid, or vibration modes where the body touches nothing.

    grid    everything: contact, tearing, plastic strain, fluids                                    (`mpm/rollout.py`)
    modes   bodies that are held or float freely and touch nothing, of a material that recovers   (`modes/rollout.py`)
    auto    modes where they serve; the grid elsewhere, and from the first frame in which the body would touch a wall

Both answer with the same Trajectory and are differentiable in the parameters, the velocity and the forces.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.matter import Matter
from physics3d.modes import rollout as modes
from physics3d.modes.conditions import Refused, touched
from physics3d.mpm import rollout as grid
from physics3d.trajectory import Trajectory
from physics3d.world import World

MOST_PIECES = 40_000  # of matter, for which modes are computed in a minute


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A body, ready to be moved by any parameters and start; what costs time only once has been done."""

    world: World
    position: Tensor  # [p, 3] at rest [m]
    volume: Tensor  # [p] [m^3]
    excitation: tuple[AbstractBoundary, ...]
    modes: modes.Solver | None  # None: the grid
    device: str
    log: Log

    def __call__(
        self, parameters: Values, *, velocity: Tensor | None = None, frames: int, frame_dt: float, log: Log
    ) -> Trajectory:
        """Raises ValueError as `rollout` of the solver does."""
        timing: dict[str, Any] = dict(velocity=velocity, frames=frames, frame_dt=frame_dt, device=self.device, log=log)
        if self.modes is not None:
            motion = self.modes.rollout(parameters, **timing)
            walls = self.modes.model.conditions.walls
            touch = touched(walls, motion.position.detach().cpu().double(), self.volume.cpu().double() ** (1 / 3) / 2)
            if touch is None:
                return motion
            wall, frame = touch
            what = f"the body reaches the {type(wall).__name__} in frame {frame}, which the modes do not feel"
            if self.world.solver == "modes":
                self.log.warn(f"{what}; take world.solver='grid' or 'auto'")
                return motion
            self.log.warn(f"{what}: the grid takes over")
        return grid.rollout(self.world, parameters, self.position, self.volume, excitation=self.excitation, **timing)


def motion_of(
    world: World,
    position: Tensor,
    volume: Tensor,
    *,
    excitation: tuple[AbstractBoundary, ...] = (),
    part: Callable[[Values], Values] = lambda values: values,
    matter: Matter | None = None,
    device: str,
    log: Log,
) -> Motion:
    """The body under the world's boundaries and its excitation, with the solver that `world.solver` asks for.

    `part` completes parameters by what a mixture has to know of the body (`AbstractMaterial.per_part`); `matter` are
    the pieces that filling found, if it did. Raises ValueError naming the field, the value and the remedy, also where
    world.solver is "modes" and they do not serve."""
    world.check()
    chosen = None
    why = "world.solver says so"
    if world.solver != "grid":
        try:
            chosen = _modes(world, position, volume, excitation, part, matter, log)
        except Refused as reason:
            why = str(reason)
            if world.solver == "modes":
                raise ValueError(f"world.solver is 'modes', but {why}; take 'grid' or 'auto'") from None
    if chosen is None:
        log.info(f"solver: grid, for {why}")
    else:
        first = ", ".join(str(mode) for mode in chosen.modes(part(world.estimate().parameters))[:4])
        log.info(f"solver: modes, for nothing touches the body and it recovers; its first frequencies: {first} Hz")
    return Motion(
        world=world, position=position, volume=volume, excitation=excitation, modes=chosen, device=device, log=log
    )


def _modes(world, position, volume, excitation, part, matter, log) -> modes.Solver:
    """Raises Refused where the grid is needed."""
    if not world.material.recovers:
        raise Refused(f"the material ({type(world.material).__name__}) may flow")
    if len(position) > MOST_PIECES:
        raise Refused(f"{len(position)} particles are more than {MOST_PIECES}")
    start = part({name: torch.tensor(value, dtype=torch.float64) for name, value in world.start.items()})
    found = modes.Solver.of(
        world, position, volume, excitation=excitation, part=start.get(modes.PART), matter=matter, log=log
    )
    conditions = found.model.conditions
    falls = any(world.gravity) or any(world.velocity)
    if conditions.walls and falls and not conditions.held.any() and not conditions.grips:
        names = ", ".join(type(wall).__name__ for wall in conditions.walls)
        raise Refused(f"the body is held nowhere and falls towards its {names}")
    return found
