"""A body that a hand pulls at, moved by its modes of vibration (`modes/stepping.py`).

The hand's force is F = d/c, d how far it has gone, c how far the place gives way to a force before anything relaxes.
Steps are short enough to follow the first three modes.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.impulse import Impulse
from physics3d.filling.body import Body
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.modes.conditions import WALLS, Refused, touched
from physics3d.modes.dynamics import NotSolved
from physics3d.modes.stepping import Stepper
from physics3d.solver import modes_of
from physics3d.view.mover import AbstractMover, TooMuch
from physics3d.world import World

FOLLOWED = 3  # modes
STEPS = 16  # in a period of the last of them: the midpoint rule is then late by a hundredth of a period in each
LONGEST, SHORTEST = 1 / 60, 1 / 480  # [s] of a step
STIFFEST = 0.02  # of the compliance of the softest place: near its hold the body resists no more than that
FREE = "nothing holds the body: a poke would carry it away"
MOST_PIECES = 100_000  # particles: modes of 78 000 take a core 50 s, once, and 5 GB; a step of them then takes 3 ms


class ByModes(AbstractMover):
    still, how, notes = 1e-4, "Moved by its modes of vibration, without a grid.", ()

    def __init__(self, stepper: Stepper, body: Body, parameters: Values, *, damping: float):
        self.stepper, self._body, self._parameters, self._damping = stepper, body, parameters, damping
        self._nobody = np.zeros(stepper.solver.model.count)
        self.share = self._nobody  # [r] of a force of the hand
        self._compliance = math.inf  # of the place that it holds [m/N]
        self.dt = stepper.dt

    @classmethod
    def of(cls, world: World, body: Body, parameters: Values, *, log: Log) -> "ByModes":
        """At rest. Raises Refused with the reason where modes do not serve."""
        if all(isinstance(boundary, (*WALLS, Impulse)) for boundary in (*world.boundaries, *body.held)):
            raise Refused(FREE)
        part = lambda values: world.material.per_part(values, body.part, body.parts)
        solver = modes_of(
            world.starting_at(parameters), body.position, body.volume,
            excitation=body.held, part=part, matter=body.matter, most=MOST_PIECES, log=log,
        )  # fmt: skip
        model = solver.model
        if not any(math.isinf(spring.until) for spring in model.springs):
            raise Refused(FREE)
        period = 2 * math.pi / float(np.sort(model.omega)[:FOLLOWED].max())
        dt = min(LONGEST, max(SHORTEST, period / STEPS))
        return cls(Stepper(solver, parameters, dt=dt), body, parameters, damping=world.damping)

    @property
    def time(self) -> float:
        return self.stepper.time

    def take(self, particle: int, weight: Float[np.ndarray, " p"]) -> str:
        model = self.stepper.solver.model
        if model.conditions.held[particle]:
            return "this place is held and cannot be pulled; take another"
        self.share = self.stepper.share(weight)
        # that of the first mode, where it moves most
        softest = (np.linalg.norm(model.values @ model.shapes[0], axis=1).max() / model.omega[0]) ** 2
        self._compliance = max(self.stepper.compliance(self.share), STIFFEST * softest)
        return ""

    def force(self, displacement: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        return displacement / self._compliance

    def let_go(self) -> None:
        self.share, self._compliance = self._nobody, math.inf

    def step(self, force: Float[np.ndarray, "3"]) -> None:
        try:
            self.stepper.step(force, self.share)
        except NotSolved as reason:
            raise TooMuch(str(reason)) from None

    def change(self, parameters: Values, *, damping: float) -> None:
        self._parameters, self._damping = parameters, damping
        self.stepper.change(parameters, damping=damping)

    def rest(self) -> None:
        self.let_go()
        self.stepper = Stepper(self.stepper.solver, self._parameters, dt=self.dt)
        self.stepper.change(self._parameters, damping=self._damping)

    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        return self.stepper.particles()

    def speed(self) -> float:
        return float(np.abs(self.stepper.solver.model.values @ self.stepper.v).max())

    def unfelt(self, position: Float[Tensor, "p 3"]) -> str:
        conditions = self.stepper.solver.model.conditions
        if not conditions.walls:
            return ""
        free = torch.from_numpy(~conditions.held)
        wall = touched(conditions.walls, position[None, free], self._body.volume.double()[free] ** (1 / 3) / 2)
        return "" if wall is None else f"the body reaches the {type(wall[0]).__name__}, which is not felt here"
