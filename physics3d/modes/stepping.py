"""A body that is moved one step at a time, by forces that nobody knows beforehand: what a hand at a screen needs.

    M a + c M v + f(q) + K_s q = load + s F,    s_j = sum_p m_p w_p s_j(X_p) / sum_p m_p w_p

F [N] acts on the particles of weight w as an `Impulse` does, the same acceleration on each. Every step is one of the
implicit midpoint rule (`dynamics.py`), all of one length: so the factored matrix serves from step to step.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import Values
from physics3d.modes.dynamics import Step
from physics3d.modes.rollout import Solver


class Stepper:
    """The state of a body in its basis, from rest on; gravity acts."""

    def __init__(self, solver: Solver, parameters: Values, *, dt: float):
        """`dt` of a step [s]."""
        if not dt > 0:
            raise ValueError(f"dt is {dt} s; take a time above 0")
        self.solver, self.dt, self.time = solver, dt, 0.0
        body = solver.model
        self.q, self.v = np.zeros((body.count, 3)), np.zeros((body.count, 3))
        self._weight = body.first_moment[:, None] * np.array(solver.world.gravity)
        self._system = body.system(solver.coefficients(parameters).detach().numpy())

    def change(self, parameters: Values, *, damping: float) -> None:
        """Other parameters and another rate at which all velocities decay [1/s] from now on; the motion goes on."""
        before = self._system
        system = self.solver.model.system(self.solver.coefficients(parameters).detach().numpy())
        system.points.set_state(before.points.state())
        system.since, system.drag = before.since, damping
        self._system = system

    def share(self, weight: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        """s of a force on particles of this weight; a held particle takes its part of the force, and does not move.
        Raises ValueError if there is no weight."""
        mass = weight * self.solver.model.particle_mass
        if not mass.sum() > 0:
            raise ValueError("no particle has a weight above 0; take others")
        return mass @ self.solver.model.values / mass.sum()

    def compliance(self, share: Float[np.ndarray, " r"]) -> float:
        """Displacement per force [m/N] of where a force acts, in the direction that gives way most, at rest."""
        K, S = self.solver.model.stiffness, np.kron(share[:, None], np.eye(3))
        return float(np.linalg.eigvalsh(S.T @ np.linalg.solve(K, S)).max())

    def step(self, force: Float[np.ndarray, "3"], share: Float[np.ndarray, " r"]) -> None:
        """`dt` onwards under a force [N] on what `share` says. Raises NotSolved; the state is then as it was."""
        loads = np.stack([self._weight, share[:, None] * force])
        plan = [Step(time=self.time, dt=self.dt, signals=(1.0, 1.0))]
        self.q, self.v = self._system.run(self.q, self.v, loads, plan, None)
        self.time += self.dt

    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        """Positions [m], deformation gradients and velocities [m/s] of the particles, float64."""
        body = self.solver.model
        u, v = body.values @ self.q, body.values @ self.v
        Ht = (body.slopes @ self.q).reshape(-1, 3, 3)
        position = self.solver.position.detach().cpu().double() + torch.from_numpy(u)
        return position, torch.from_numpy(Ht).mT + torch.eye(3, dtype=torch.float64), torch.from_numpy(v)
