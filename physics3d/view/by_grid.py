"""A body that a hand pulls at, moved by the grid: what falls, lies on something, flows, or is held by nothing.

So that it keeps up with the clock its cells and its particles may be larger than those of the scene (`coarse.py`), by

    f = (particles * substeps a second / RATE)^(1/4),     for there are f^3 times fewer particles, and f fewer substeps,

but not so large that fewer than CELLS of them go along the body; then time passes more slowly than the clock.

The hand is a damped spring between it and the fingertip's worth of matter,

    F = K d - C v,   K = min(M (2 pi/PERIOD)^2, m/(4 dt^2)),   C = min(2 (K M)^(1/2), m/(2 dt)),

d [m] from there to the hand, v [m/s] its velocity, M the mass of the body (of one that flows, m), m the mass that a
force there feels in one step: the grid is asked for it. The bounds keep the hand stable, for it learns once a step
where it is.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from physics3d.filling.body import Body
from physics3d.materials.base import Values
from physics3d.mpm.stepping import Stepper
from physics3d.view.coarse import Coarse, coarser
from physics3d.view.mover import AbstractMover, TooMuch
from physics3d.view.quantities import von_mises_of_kirchhoff
from physics3d.world import World

RATE = 4e5  # particles times substeps, in a second of the clock: a fifth of what a core does that has other work too
CELLS = 8  # along the longest side of the body, at least
ONE = 2e4  # particles times substeps in one step, at most: between two pictures there is to be time for one
ALIKE = 1.2  # factor below which the body is moved with its own particles
STEP = 1 / 120  # the longest [s]
PERIOD = 0.3  # in which the hand would swing with the body, were it not damped [s]
ROOM = 10  # around the body, in which it may go about [of its size]


class ByGrid(AbstractMover):
    still = 1e-3  # what lies on something trembles in single precision

    def __init__(self, world: World, body: Body, parameters: Values):
        """At rest. Raises ValueError as `rollout` does."""
        size = float((body.position.amax(0) - body.position.amin(0)).max()) + body.spacing
        factor = min(_factor(world, body, parameters), max(1.0, size / (CELLS * world.dx)))
        factor = factor if factor >= ALIKE else 1.0
        self.coarse: Coarse = coarser(body, world, factor)
        self._world, self._parameters, self._size = _roomy(world, body, factor * world.dx), parameters, size
        self.dt = STEP
        self._stepper = self._started()
        self.dt = STEP / math.ceil(len(self.coarse.position) * self._stepper.substeps / ONE)
        self._stepper = self._started()
        self._flows = not world.material.recovers
        setting = self._stepper.setting
        self._mass = setting.mass.numpy()
        self._held = np.zeros(len(self._mass))
        for boundary in (*world.boundaries, *self.coarse.held):
            self._held += boundary.holds(setting).numpy()
        self._share = np.zeros(len(self._mass))  # of each particle in what the hand holds
        self._from: np.ndarray | None = None  # where that was when it took hold [m]
        few, many = len(self.coarse.position), len(body.position)
        mine, theirs = f"cells of {1e3 * factor * world.dx:.3g} mm", f"{1e3 * world.dx:.3g} mm"
        self.how, self.notes = f"Moved by the grid, {mine}.", ()
        if factor > 1:
            self.how = f"Moved by the grid at a reduced size: {few} of {many} particles, {mine} instead of {theirs}."
            self.notes = (f"poked with {mine}, those of the scene are {theirs}",)

    @property
    def time(self) -> float:
        return self._stepper.time

    def take(self, particle: int, weight: Float[np.ndarray, " p"]) -> str:
        if self._held[self.coarse.own[particle]] > 0:
            return "this place is held and cannot be pulled; take another"
        weight = self.coarse.mean(weight)
        self._stepper.push(weight)
        self._share = weight * self._mass / (weight * self._mass).sum()
        self._from, _ = self._hand()
        whole = float(self._mass.sum())
        try:
            m = min(self._stepper.inertia(), whole)  # of a place that is held nearby it may be more
        except ValueError:
            return "the body moves too fast to take hold of; put it to rest"
        M = m if self._flows else whole
        self._spring = min(M * (2 * math.pi / PERIOD) ** 2, 0.25 * m / self.dt**2)
        self._damper = min(2 * math.sqrt(self._spring * M), 0.5 * m / self.dt)
        return ""

    def _hand(self) -> tuple[np.ndarray, np.ndarray]:
        """Where what the hand holds is [m], and how fast [m/s]."""
        x, _, v = self._stepper.particles()
        return self._share @ x.numpy(), self._share @ v.numpy()

    def force(self, displacement: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        if self._from is None:
            return np.zeros(3)
        x, v = self._hand()
        d = self._from + displacement - x
        d *= min(1.0, self._size / max(float(np.linalg.norm(d)), 1e-300))  # a hand far away pulls no harder
        return self._spring * d - self._damper * v

    def let_go(self) -> None:
        self._share = np.zeros(len(self._mass))
        self._from = None

    def step(self, force: Float[np.ndarray, "3"]) -> None:
        try:
            self._stepper.step(force)
        except ValueError as reason:
            raise TooMuch(str(reason)) from None

    def change(self, parameters: Values, *, damping: float) -> None:
        self._parameters, self._world = parameters, replace(self._world, damping=damping)
        self._stepper.change(self.coarse.parameters(parameters), damping=damping)

    def rest(self) -> None:
        self.let_go()
        self._stepper = self._started()

    def _started(self) -> Stepper:
        values = self.coarse.parameters(self._parameters)
        return Stepper(self._world, values, self.coarse.position, self.coarse.volume, held=self.coarse.held, dt=self.dt)

    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        return self.coarse.fine(*self._stepper.particles())

    def stress(self) -> Float[np.ndarray, " p"] | None:
        _, F, _ = self._stepper.particles()
        return self.coarse.blend(von_mises_of_kirchhoff(self._stepper.stress().numpy(), F.numpy()))

    def speed(self) -> float:
        return float(self._stepper.particles()[2].norm(dim=1).max())


def _factor(world: World, body: Body, parameters: Values) -> float:
    """f as above, of the cells of the scene."""
    whole = Stepper(world, parameters, body.position, body.volume, held=body.held, dt=STEP)
    return (len(body.position) * whole.substeps / STEP / RATE) ** 0.25


def _roomy(world: World, body: Body, dx: float) -> World:
    """With cells of `dx` [m], at nodes that are whole multiples of it, in a region to go about in."""
    x = body.position.double().cpu()
    room = ROOM * float((x.amax(0) - x.amin(0)).max()) + 4 * dx
    low, high = (x.amin(0) - room) / dx, (x.amax(0) + room) / dx
    lower, upper = (tuple((dx * n).tolist()) for n in (low.floor(), high.ceil()))
    if world.lower is not None and world.upper is not None:
        lower, upper = world.lower, world.upper
    return replace(world, dx=dx, dt=None, lower=lower, upper=upper)
