"""A body on the grid that is moved one step at a time, by a force that nobody knows beforehand: what a hand at a screen
needs where `modes/stepping.py` does not serve.

    m_p a_p = (what the grid gives) + s_p F,    s_p = m_p w_p / sum_p m_p w_p

F [N] acts on the particles of weight w as an `Impulse` does, the same acceleration on each of weight 1. A step is a
frame of `frames.py`: as many substeps as the limit asks for.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.mpm.frames import Frames
from physics3d.mpm.problem import Problem, check_inputs, region, sorted_by_cell
from physics3d.warp_start import start_warp
from physics3d.world import World

FOR_GOOD = 1e9  # [s]


class Stepper:
    """The state of a body on a CPU, from rest on; gravity and the boundaries act."""

    def __init__(
        self,
        world: World,
        parameters: Values,
        position: Float[Tensor, "p 3"],
        volume: Float[Tensor, " p"],
        *,
        held: tuple[AbstractBoundary, ...] = (),
        dt: float,
    ):
        """`position` [m] and `volume` [m^3] at rest; `held`: boundaries besides those of the world; `dt` of a step [s].
        Raises ValueError as `rollout` does."""
        world.check()
        # one acceleration that is not known yet, on particles that `push` chooses
        hand = Impulse(acceleration_of_each=(0.0,) * 3, centre=(0.0,) * 3, nearest=len(position), duration=FOR_GOOD)
        self._boundaries = (*world.boundaries, *held, hand)
        check_inputs(position, volume, None, self._boundaries, 1, dt)
        self.world, self.dt, self._step = world, dt, 0
        x, volume = position.detach().double().cpu(), volume.detach().double().cpu()
        lower, upper = region(world, x, torch.zeros(3), dt)
        self.setting = Setting(
            position=x, mass=world.density * volume, volume=volume, lower=lower, upper=upper, dx=world.dx
        )
        self._order = sorted_by_cell(x, world.dx)
        self._back = torch.argsort(self._order)
        self._weight = torch.zeros(len(x), dtype=torch.float64)  # that the force has on each particle
        self._frames = self._started(parameters)

    @property
    def time(self) -> float:
        """Since rest [s]."""
        return self._step * self.dt

    @property
    def substeps(self) -> int:
        """That the coming step needs. Raises ValueError if they are more than world.max_substeps."""
        return self._frames.count(self._step + 1)

    def change(self, parameters: Values, *, damping: float) -> None:
        """Other parameters and another rate at which all velocities decay [1/s] from now on; the motion goes on."""
        before, self.world = self._frames, replace(self.world, damping=damping)
        self._frames = self._started(parameters)
        self._frames.now.flat.copy_(before.now.flat)
        self._frames.behind = before.behind

    def push(self, weight: Float[np.ndarray, " p"]) -> None:
        """The force acts on particles of this weight from now on. Raises ValueError if there is no weight."""
        w = torch.from_numpy(weight).double()
        if not float((w * self.setting.mass).sum()) > 0:
            raise ValueError("no particle has a weight above 0; take others")
        self._weight = w
        self._selection[-1] = w[self._order].to(self._selection)

    def step(self, force: Float[np.ndarray, "3"]) -> None:
        """`dt` onwards under a force [N]. Raises ValueError as `rollout` does; the state is then of no use."""
        pushed = max(float((self._weight * self.setting.mass).sum()), 1e-300)  # [kg]
        self._q[-3:] = (torch.from_numpy(force) / pushed).to(self._q)
        self._frames.onward(self._step + 1)
        self._step += 1

    def inertia(self) -> float:
        """Mass [kg] that a force feels in one step where it acts now: what it holds, and what moves with that so soon.
        Infinite if it moves nothing."""
        frames, step = self._frames, self._step
        state, behind, current = frames.now.flat.clone(), frames.behind, frames.current
        pushed = self._weight * self.setting.mass
        force = np.full(3, float(pushed.sum()))  # 1 m/s^2 along each axis, if nothing moved with it
        speeds = []
        for tried in (np.zeros(3), force):
            self.step(tried)
            speeds.append((pushed @ self.particles()[2] / pushed.sum()).numpy())
            frames.behind, frames.current, self._step = behind, current, step
            frames.now.flat.copy_(state)
        gain = float(np.linalg.norm(speeds[1] - speeds[0]))
        return float(np.linalg.norm(force)) * self.dt / gain if gain > 0 else np.inf

    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        """Positions [m], deformation gradients and velocities [m/s] of the particles, float64; velocities are those of
        half a substep before."""
        now = self._frames.now
        u, H, v = (value[self._back].double() for value in (now.u, now.H, now.v))
        return self.setting.position + u, H + torch.eye(3, dtype=torch.float64), v

    def stress(self) -> Float[Tensor, "p 3 3"]:
        """Kirchhoff stress of the particles at present [Pa]."""
        return self._frames.now.tau[self._back].double()

    def _started(self, parameters: Values) -> Frames:
        """At rest, with these parameters; the hand keeps what it has chosen."""
        start_warp()
        world, setting, n = self.world, self.setting, len(self._order)
        values = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
        coefficients = world.material.coefficients(values)
        kind: dict[str, Any] = {"dtype": world.dtype}
        q = [boundary.parameters(setting) for boundary in self._boundaries]
        selection = torch.stack([boundary.selection(setting) for boundary in self._boundaries])
        selection[-1] = self._weight
        # Warp reads the memory of these two: what is written there later, the next step obeys
        self._q = torch.cat(q).to(**kind)
        self._selection = selection[:, self._order].to(**kind).contiguous()
        problem = Problem(
            world=world,
            setting=setting,
            boundaries=self._boundaries,
            widths=tuple(len(k) for k in q),
            order=self._order,
            frames=1,
            frame_dt=self.dt,
            device="cpu",
            threads=None,
            log=Log(None),
        )
        frames = Frames(
            problem,
            coefficients.expand(len(coefficients), n)[:, self._order].to(**kind),
            self._q,
            setting.position[self._order],
            self._selection,
            keep=False,
        )
        frames.begin(torch.zeros((n, 3), **kind), torch.zeros((n, 3, 3), **kind))
        return frames
