"""A body that a hand pulls at, in real time: the solver without a grid, step by step (`modes/stepping.py`).

It serves where something holds the body, the material recovers, and the modal solver does; else `Live.of` says why not.
Stiffness multiplies every modulus of the material, damping is the rate at which all velocities decay. Steps are
short enough to follow the first three modes; where they cannot keep up with the clock, time passes more slowly.
"""

import math
import re
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.base import Setting
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.body import Body
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.modes.conditions import touched
from physics3d.modes.dynamics import NotSolved
from physics3d.modes.stepping import Stepper
from physics3d.solver import modes_of
from physics3d.view.poke import Record, place
from physics3d.view.quantities import Stress
from physics3d.world import World

FOLLOWED = 3  # modes
STEPS = 16  # in a period of the last of them: the midpoint rule is then late by a hundredth of a period in each
LONGEST, SHORTEST = 1 / 60, 1 / 480  # [s] of a step
MOST = 0.1  # of the clock that one call makes up for [s]
STIFFEST = 0.02  # of the compliance of the softest place: near its hold the body resists no more than that
MOST_PIECES = 100_000  # particles: modes of 78 000 take a core 50 s, once, and 5 GB; a step of them then takes 3 ms
STILL = 1e-4  # of its size per second: who moves less for a second has come to rest


@dataclass
class Hold:
    """Where a hand has got hold of the body, and how far it has pulled."""

    share: np.ndarray  # [r] of a force there
    compliance: float  # [m/N]
    displacement: np.ndarray  # of the hand since then [m]


class Live:
    """The present state of a body, and the hand that pulls at it."""

    def __init__(self, stepper: Stepper, body: Body, parameters: Values, *, damping: float):
        self.stepper, self.body, self.parameters = stepper, body, parameters
        self.stiffness, self.damping = 1.0, damping
        self.hold: Hold | None = None
        self.record: Record | None = None
        self.trouble = ""  # what a person should know, in one line
        self.late = 0.0  # of the clock [s]
        self.quiet = 0.0  # for how long it has not moved [s]
        self._size = float((body.position.amax(0) - body.position.amin(0)).max())
        self.stress = self._unstressed()

    @classmethod
    def of(cls, world: World, body: Body, parameters: Values, *, log: Log) -> "Live":
        """At rest. `parameters` with everything that the material has to know of the body. Raises ValueError with the
        reason where the body cannot be pulled at live."""
        part = lambda values: world.material.per_part(values, body.part, body.parts)
        solver = modes_of(
            world, body.position, body.volume,
            excitation=body.held, part=part, matter=body.matter, most=MOST_PIECES, log=log,
        )  # fmt: skip
        model = solver.model
        if not any(math.isinf(spring.until) for spring in model.springs):
            raise ValueError("nothing holds the body: a poke would carry it away")
        period = 2 * math.pi / float(np.sort(model.omega)[:FOLLOWED].max())
        dt = min(LONGEST, max(SHORTEST, period / STEPS))
        return cls(Stepper(solver, parameters, dt=dt), body, parameters, damping=world.damping)

    @property
    def world(self) -> World:
        return self.stepper.solver.world

    def grab(self, particle: int) -> None:
        """Take hold of the body around a particle."""
        model = self.stepper.solver.model
        if model.conditions.held[particle]:
            self.trouble = "this place is held and cannot be pulled; take another"
            return
        x = self.body.position.double()
        centre, radius = place(x[particle].numpy(), self.world.dx)
        push = Impulse(force=(0.0, 0.0, 1.0), centre=centre, radius=radius, duration=1.0)
        lower, upper = ((float(a), float(b), float(c)) for a, b, c in (x.amin(0), x.amax(0)))
        mass = torch.from_numpy(model.particle_mass)
        volume = torch.from_numpy(model.particle_mass / self.world.density)
        setting = Setting(position=x, mass=mass, volume=volume, lower=lower, upper=upper, dx=self.world.dx)
        share = self.stepper.share(push.selection(setting).numpy())
        # that of the first mode, where it moves most
        softest = (np.linalg.norm(model.values @ model.shapes[0], axis=1).max() / model.omega[0]) ** 2
        compliance = max(self.stepper.compliance(share), STIFFEST * softest)
        hold = Hold(share=share, compliance=compliance, displacement=np.zeros(3))
        self.trouble, self.quiet = "", 0.0
        self.record = Record(centre=centre, radius=radius, dt=self.stepper.dt)
        self.hold = hold

    def pull(self, displacement: Float[np.ndarray, "3"]) -> None:
        """The hand is this far from where it took hold [m]."""
        if self.hold is not None:
            self.hold.displacement = displacement

    def let_go(self) -> None:
        self.hold, self.quiet = None, 0.0  # it may have been held still for long

    @property
    def force(self) -> Float[np.ndarray, "3"]:
        """Of the hand [N]."""
        return np.zeros(3) if self.hold is None else self.hold.displacement / self.hold.compliance

    def change(self, *, stiffness: float, damping: float) -> None:
        """Another factor of every modulus, and another rate of decay [1/s]."""
        if (stiffness, damping) != (self.stiffness, self.damping):
            self.stiffness, self.damping = stiffness, damping
            parameters, self.quiet = scaled(self.parameters, stiffness), 0.0
            self.stepper.change(parameters, damping=damping)
            self.stress.change(parameters)

    def rest(self) -> None:
        """Undeformed and still, as at the start."""
        before = self.stepper
        self.stepper = Stepper(before.solver, self.parameters, dt=before.dt)
        self.stepper.change(scaled(self.parameters, self.stiffness), damping=self.damping)
        self.hold, self.late, self.quiet = None, 0.0, 0.0
        self.stress = self._unstressed()

    def _unstressed(self) -> Stress:
        return Stress(self.world.material, scaled(self.parameters, self.stiffness), len(self.body.position))

    def advance(self, seconds: float) -> float:
        """Onwards by what the clock says, in whole steps; how much that was [s]: none once the body has come to rest.
        A pull that is too much for the solver ends, and the body is put to rest."""
        if self.quiet > 1 and self.hold is None:
            return 0.0
        self.late = min(self.late + seconds, MOST)
        dt, hold = self.stepper.dt, self.hold
        count = int(self.late / dt + 1e-9)
        force, share = self.force, np.zeros(self.stepper.solver.model.count) if hold is None else hold.share
        for _ in range(count):
            try:
                self.stepper.step(force, share)
            except NotSolved:
                self.rest()
                self.trouble = "this was too much for the solver, and the body was put to rest; pull less far"
                return 0.0
            if hold is not None and self.record is not None:
                self.record.forces.append(force)
        self.late -= count * dt
        speed = np.abs(self.stepper.solver.model.values @ self.stepper.v).max()
        self.quiet = self.quiet + count * dt if speed < STILL * self._size else 0.0
        return count * dt

    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        """Positions [m], deformation gradients and velocities [m/s]; says so where a wall would be felt."""
        x, F, v = self.stepper.particles()
        conditions = self.stepper.solver.model.conditions
        if conditions.walls:
            free = torch.from_numpy(~conditions.held)
            wall = touched(conditions.walls, x[None, free], self.body.volume.double()[free] ** (1 / 3) / 2)
            if wall is not None:
                self.trouble = f"the body reaches the {type(wall[0]).__name__}, which is not felt here"
        return x, F, v


def scaled(parameters: Values, factor: float) -> Values:
    """The parameters with every modulus [Pa] times `factor`: all stresses times that."""
    stiff = re.compile(r"_(modulus|coefficient)(_[23])?$")  # Yeoh's quadratic coefficient is a modulus as well
    return {name: value * factor if stiff.search(name) else value for name, value in parameters.items()}
