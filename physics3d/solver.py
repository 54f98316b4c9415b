"""Which solver moves a body, and why: the grid, or vibration modes where the body touches nothing.

    grid    everything: contact, tearing, plastic strain, fluids                                    (`mpm/rollout.py`)
    modes   bodies that are held or float freely and touch nothing, of a material that recovers   (`modes/rollout.py`)
    auto    modes where they serve; the grid elsewhere, and from the first frame in which the body would touch a wall

Both answer with the same Trajectory and are differentiable in the parameters, the velocity and the forces.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.matter import Matter
from physics3d.modes import rollout as modes
from physics3d.modes.conditions import WALLS, Refused, touched
from physics3d.modes.dynamics import NotSolved
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
    feels_walls: bool = True  # False: the modes go on through a wall that they do not feel
    said: set[str] = field(default_factory=set)  # what was said already: a body is moved hundreds of times

    def __call__(
        self, parameters: Values, *, velocity: Tensor | None = None, frames: int, frame_dt: float, log: Log
    ) -> Trajectory:
        """Raises ValueError as `rollout` of the solver does."""
        timing: dict[str, Any] = dict(velocity=velocity, frames=frames, frame_dt=frame_dt, device=self.device, log=log)
        if self.modes is not None:
            motion = self._by_modes(parameters, timing)
            if motion is not None:
                return motion
        return grid.rollout(self.world, parameters, self.position, self.volume, excitation=self.excitation, **timing)

    def passes_a_wall(self, parameters: Values, *, velocity: Tensor | None, frames: int, frame_dt: float) -> bool:
        """Whether modes move the body and this motion reaches a wall, which they do not feel; it is said once."""
        if self.modes is None or self.world.solver == "modes" or not self.modes.model.conditions.walls:
            return False
        timing: dict[str, Any] = dict(
            velocity=velocity, frames=frames, frame_dt=frame_dt, device=self.device, log=Log(None)
        )
        with torch.no_grad():
            return replace(self, feels_walls=True)._by_modes(parameters, timing) is None

    def report(self, parameters: Values) -> None:
        """Say how the body vibrates with these parameters, if it is moved by its modes."""
        if self.modes is None:
            return
        found = self.modes.modes(parameters, 3)
        self.log.info(f"first {len(found)} frequencies: {', '.join(str(mode) for mode in found)} Hz")
        for number, mode in enumerate(found, 1):
            self.log.metric(f"frequency/{number}", mode.frequency)
            self.log.metric(f"loss_factor/{number}", mode.loss_factor)

    def _by_modes(self, parameters: Values, timing: dict[str, Any]) -> Trajectory | None:
        """None, and a word about it, where the grid has to do it."""
        assert self.modes is not None
        try:
            motion = self.modes.rollout(parameters, **timing)
        except NotSolved as reason:
            if self.world.solver == "modes":
                raise
            why = str(reason).partition("; take ")[0]  # its remedies are for those who want no grid
            self._say("no motion", f"the modes find no motion ({why}): the grid takes over")
            return None
        touch = _touched(self.modes, self.volume, motion.position) if self.feels_walls else None
        if touch is None:
            return motion
        wall, frame = touch
        kind = type(wall).__name__
        what = f"the body reaches the {kind} in frame {frame}, which the modes do not feel"
        if self.world.solver == "modes":
            self._say(kind, f"{what}; take world.solver='grid' or 'auto'")
            return motion
        self._say(kind, f"{what}: the grid takes over")
        return None

    def _say(self, kind: str, what: str) -> None:
        """Once of a kind: the same wall, in whichever frame, does not become truer by being repeated."""
        if kind not in self.said:
            self.said.add(kind)
            self.log.warn(what)


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
            chosen = modes_of(
                world, position, volume, excitation=excitation, part=part, matter=matter, most=MOST_PIECES, log=log
            )
            if world.solver == "auto":
                why = "the body touches nothing and comes back to its shape"
        except Refused as reason:
            why = str(reason)
            if world.solver == "modes":
                raise ValueError(f"world.solver is 'modes', but {why}; take 'grid' or 'auto'") from None
    log.info(f"solver: {'grid' if chosen is None else 'modes'}, for {why}")
    return Motion(
        world=world, position=position, volume=volume, excitation=excitation, modes=chosen, device=device, log=log
    )


def modes_of(
    world: World,
    position: Tensor,
    volume: Tensor,
    *,
    excitation: tuple[AbstractBoundary, ...],
    part: Callable[[Values], Values],
    matter: Matter | None,
    most: int,
    log: Log,
) -> modes.Solver:
    """The solver without a grid, arguments as of `motion_of`, for a body of `most` particles at most. Raises Refused
    with the reason where it does not serve."""
    if not world.material.recovers:
        raise Refused(f"the material ({type(world.material).__name__}) may flow")
    if len(position) > most:
        raise Refused(f"{len(position)} particles are more than {most}")
    start = part({name: torch.tensor(value, dtype=torch.float64) for name, value in world.start.items()})
    _refuse_a_fall(world, excitation)
    found = modes.Solver.of(
        world, position, volume, excitation=excitation, part=start.get(modes.PART), matter=matter, log=log
    )
    touch = _touched(found, volume, position[None])
    if touch is not None:
        raise Refused(f"the body touches the {type(touch[0]).__name__} where it stands")
    return found


def _refuse_a_fall(world: World, excitation: tuple[AbstractBoundary, ...]) -> None:
    """Raises Refused, before anything is computed, where nothing holds a body that falls or flies towards a wall."""
    every = (*world.boundaries, *excitation)
    walls = [type(boundary).__name__ for boundary in every if isinstance(boundary, WALLS)]
    holds = any(not isinstance(boundary, (*WALLS, Impulse)) for boundary in every)
    if walls and not holds and (any(world.gravity) or any(world.velocity)):
        raise Refused(f"the body is held nowhere and falls towards its {', '.join(walls)}")


def _touched(solver: modes.Solver, volume: Tensor, position: Tensor) -> tuple[AbstractBoundary, int] | None:
    """The first wall that matter which is not held reaches at `position` [t, p, 3] m, and in which frame."""
    conditions = solver.model.conditions
    free = torch.from_numpy(~conditions.held)
    radius = volume.detach().cpu().double()[free] ** (1 / 3) / 2
    return touched(conditions.walls, position.detach().cpu().double()[:, free], radius)
