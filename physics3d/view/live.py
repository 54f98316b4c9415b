"""A body that a hand pulls at, in real time: without a grid where that serves (`by_modes.py`), else by a grid that is
small enough (`by_grid.py`).

Stiffness multiplies every modulus of the material, damping is the rate at which all velocities decay. Where steps
cannot keep up with the clock, time passes more slowly.
"""

import re
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.base import Setting
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.body import Body
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.modes.conditions import Refused
from physics3d.view.by_grid import ByGrid
from physics3d.view.by_modes import ByModes
from physics3d.view.mover import AbstractMover, TooMuch
from physics3d.view.poke import Record, place
from physics3d.view.quantities import Stress
from physics3d.world import World

MOST = 0.1  # of the clock that one call makes up for [s]
LONGEST = 0.025  # that one call takes, and the step that it is in [s]: there are to be 15 pictures a second
RECENT = 30  # calls, of which it is said how fast time passes


@dataclass
class Hold:
    """How far a hand that has got hold of the body has gone since then."""

    displacement: Float[np.ndarray, "3"]  # [m]


class Live:
    """The present state of a body, and the hand that pulls at it."""

    def __init__(self, mover: AbstractMover, world: World, body: Body, parameters: Values):
        self.mover, self.world, self.body, self.parameters = mover, world, body, parameters
        self.stiffness, self.damping = 1.0, world.damping
        self.hold: Hold | None = None
        self.record: Record | None = None
        self.trouble = ""  # what a person should know, in one line
        self.late = 0.0  # of the clock [s]
        self.quiet = 0.0  # for how long it has not moved [s]
        self._passed: deque[tuple[float, float]] = deque(maxlen=RECENT)  # (of the clock, of the body) [s]
        self._size = float((body.position.amax(0) - body.position.amin(0)).max())
        self._stress = self._unstressed()
        self._stressed_at = 0.0  # time of the last stress that was asked of the material [s]

    @classmethod
    def of(cls, world: World, body: Body, parameters: Values, *, log: Log) -> "Live":
        """At rest. `parameters` with everything that the material has to know of the body. Raises ValueError with the
        reason where the body cannot be pulled at live."""
        mover: AbstractMover
        try:
            mover = ByModes.of(world, body, parameters, log=log)
        except Refused:
            mover = ByGrid(world, body, parameters)
            mover.step(np.zeros(3))  # compiles what is not compiled yet
            mover.rest()
        return cls(mover, world, body, parameters)

    @property
    def time(self) -> float:
        """Since it was at rest [s]."""
        return self.mover.time

    @property
    def pace(self) -> float:
        """How much of the clock's time passes for the body, of late."""
        clock, done = (sum(part) for part in zip(*self._passed)) if self._passed else (0.0, 0.0)
        return min(1.0, done / clock) if clock > 0 else 1.0

    def grab(self, particle: int) -> None:
        """Take hold of the body around a particle."""
        x = self.body.position.double()
        centre, radius = place(x[particle].numpy(), self.world.dx)
        push = Impulse(force=(0.0, 0.0, 1.0), centre=centre, radius=radius, duration=1.0)
        lower, upper = ((float(a), float(b), float(c)) for a, b, c in (x.amin(0), x.amax(0)))
        volume = self.body.volume.double()
        mass = self.world.density * volume
        setting = Setting(position=x, mass=mass, volume=volume, lower=lower, upper=upper, dx=self.world.dx)
        self.trouble = self.mover.take(particle, push.selection(setting).numpy())
        if not self.trouble:
            self.quiet = 0.0
            self.record = Record(centre=centre, radius=radius, dt=self.mover.dt, begin=self.time)
            self.hold = Hold(displacement=np.zeros(3))

    def pull(self, displacement: Float[np.ndarray, "3"]) -> None:
        """The hand is this far from where it took hold [m]."""
        if self.hold is not None:
            self.hold.displacement = displacement

    def let_go(self) -> None:
        self.mover.let_go()
        self.hold, self.quiet = None, 0.0  # it may have been held still for long

    @property
    def force(self) -> Float[np.ndarray, "3"]:
        """Of the hand [N]."""
        return np.zeros(3) if self.hold is None else self.mover.force(self.hold.displacement)

    def change(self, *, stiffness: float, damping: float) -> None:
        """Another factor of every modulus, and another rate of decay [1/s]."""
        if (stiffness, damping) != (self.stiffness, self.damping):
            self.stiffness, self.damping = stiffness, damping
            parameters, self.quiet = scaled(self.parameters, stiffness), 0.0
            self.mover.change(parameters, damping=damping)
            if self._stress is not None:
                self._stress.change(parameters)

    def rest(self) -> None:
        """Undeformed and still, as at the start."""
        self.mover.rest()
        self.hold, self.late, self.quiet = None, 0.0, 0.0
        self._stress, self._stressed_at = self._unstressed(), 0.0

    def _unstressed(self) -> Stress | None:
        """None: the mover knows it, or the material flows and keeps none."""
        if self.mover.stress() is not None or not self.world.material.recovers:
            return None
        return Stress(self.world.material, scaled(self.parameters, self.stiffness), len(self.body.position))

    def advance(self, seconds: float) -> float:
        """Onwards by what the clock says, in whole steps; how much that was [s]: none once the body has come to rest.
        A pull that is too much for the solver ends, and the body is put to rest, until somebody touches it."""
        if self.quiet > 1 and self.hold is None:
            return 0.0
        self.late = min(self.late + seconds, MOST)
        begun, dt, done = time.perf_counter(), self.mover.dt, 0
        for _ in range(int(self.late / dt + 1e-9)):
            force = self.force
            try:
                self.mover.step(force)
            except TooMuch:
                self.rest()
                self.quiet = 2.0
                self.trouble = "this was too much for the solver, and the body was put to rest; pull less far"
                return 0.0
            done += 1
            if self.hold is not None and self.record is not None:
                self.record.forces.append(force)
            if time.perf_counter() - begun > LONGEST:
                self.late = done * dt  # what it is late by is not made up for
                break
        self.late -= done * dt
        self._passed.append((seconds, done * dt))
        self.quiet = self.quiet + done * dt if self.mover.speed() < self.mover.still * self._size else 0.0
        return done * dt

    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        """Positions [m], deformation gradients and velocities [m/s]; says so where a wall would be felt."""
        x, F, v = self.mover.particles()
        self.trouble = self.mover.unfelt(x) or self.trouble
        return x, F, v

    def stress(self, F: Float[Tensor, "p 3 3"]) -> Float[np.ndarray, " p"] | None:
        """Von Mises [Pa] at the present deformation; to be asked in every picture, for a material may remember. None
        where no stress is shown, of a material that flows."""
        if not self.world.material.recovers:
            return None
        if self._stress is None:
            return self.mover.stress()
        found = self._stress.after(F, max(self.time - self._stressed_at, 1e-9))
        self._stressed_at = self.time
        return found


def scaled(parameters: Values, factor: float) -> Values:
    """The parameters with every modulus, yield stress [Pa] and viscosity times `factor`: all stresses times that."""
    # Yeoh's quadratic coefficient is a modulus as well, and so is whatever else a stress is proportional to
    stiff = re.compile(r"_(modulus|coefficient)(_[23])?$|(^|\.)(yield_stress|consistency|viscosity)$")
    return {name: value * factor if stiff.search(name) else value for name, value in parameters.items()}
