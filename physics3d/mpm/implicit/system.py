"""The equations of one implicit step on the nodes: v = B(u(v)) for the node velocities v at its end.

    u_i = e^(-c h) [ (p_i + h f_i(v))/m_i + h g ]                                                      [m/s]
    f_i = -(4/dx^2) sum_p V_p w_ip T_p (x_i - x_p)                                                        [N]

B is what the boundaries make of u; h is dt, and after an explicit substep also what its velocities lag behind; weights
and places are those of the start of the step.
"""

import math

import numpy as np
import torch
import warp as wp
from torch import Tensor

from physics3d.mpm.hooks import DECAY, KICK
from physics3d.mpm.implicit.launches import StepLaunches, total


class System:
    """Begun from state i; `forces` makes state j of node velocities, `residual` says how far they are from the root."""

    def __init__(self, launches: StepLaunches, clock: np.ndarray, i: int, j: int):
        """Scatter mass and momentum of state i, without stress, for the step by the first row of the clock."""
        arrays = launches.arrays
        self.launches = launches
        self.coupled: bool = arrays.coupled
        self.dx: float = arrays.dx
        self.kick, self.decay = float(clock[0, KICK]), float(clock[0, DECAY])
        self.gravity: Tensor = torch.tensor(list(arrays.gravity), dtype=arrays.dtype, device=arrays.device)
        self.rounding: float = float(torch.finfo(arrays.dtype).eps)
        self.particle_mass: Tensor = wp.to_torch(arrays.constant["whole_mass"])  # [p] kg
        self.volume: Tensor = wp.to_torch(arrays.constant["volume"])  # [p] m^3
        self.count: int = arrays.node_count
        self.sums: Tensor = wp.to_torch(arrays.sums)[:, : self.count]  # [worker, node, 4]
        self.grid: Tensor = wp.to_torch(arrays.grid)[: self.count]  # [node, 4]
        self.nodes: Tensor = wp.to_torch(arrays.node_velocity)[: self.count]  # [node, 3]
        arrays.set_clock(clock)
        for w in range(arrays.workers):
            arrays.set_row(w, 0)
        self.sums.zero_()
        if "mark" in launches.substeps.kernels:
            for w in range(arrays.workers):
                arrays.new_stamp(w)
        launches.grip()
        launches.on_particles("push", "scatter", "mark")
        self.grid.copy_(total(self.sums))
        if arrays.grips:
            launches.on_nodes("face")
            launches.on_nodes("lead")
        self.base: Tensor = self.grid.clone()  # [node, 4] at the start of the step
        self.momentum, m = self.base.split((3, 1), 1)  # [node, 3], [node, 1]
        self.present: Tensor = (m > arrays.mass_floor).to(m.dtype)
        self.safe_mass: Tensor = torch.where(m > arrays.mass_floor, m, 1.0)
        # the inertia that dt f works against: damping takes its part of the impulse too
        self.mass: Tensor = self.present * self.safe_mass / self.decay
        self.inverse_mass: Tensor = self.present / self.safe_mass * self.decay
        self.reach: Tensor = torch.ones_like(m)  # s of `residual`
        self.falls: bool = True  # the nodes were last updated with gravity

    def forces(self, v: Tensor) -> bool:
        """State j as v makes it, and the momentum on the grid that its stress makes; False if v folds a particle."""
        self.nodes.copy_(v)
        self.sums.zero_()
        counts = (*self.launches.folded, *self.launches.arrays.lost)
        for count in counts:
            count.zero_()
        self.launches.on_particles("gather", "steer", "advance", "stress", "force")
        self.grid.copy_(total(self.sums))
        self.grid += self.base
        self.falls = True
        return not any(int(count.numpy()[0]) for count in counts) and bool(torch.isfinite(self.grid).all())

    def residual(self, v: Tensor) -> Tensor:
        """(v - B(v + s (u(v) - v)))/s [m/s] after `forces`. The root is the same for any s > 0; m over the diagonal of
        M + K guesses the nodes that separate far better than s = 1, which nodes that depend on each other need."""
        if self.coupled:
            return v - self.update(gravity=True)
        u = self.present * self.decay * (self.grid[:, :3] / self.safe_mass + self.kick * self.gravity)
        return (v - self.bounded(v + self.reach * (u - v))) / self.reach

    def bounded(self, v: Tensor) -> Tensor:
        """B(v)."""
        self.grid[:, :3] = self.present * self.safe_mass * (v / self.decay)
        return self.update(gravity=False)

    def update(self, *, gravity: bool) -> Tensor:
        """Velocities of what the grid holds, after damping, boundaries and perhaps gravity, a copy."""
        self.falls = gravity
        self.launches.on_nodes("update" if gravity else "update_still")
        return self.nodes.clone()

    def noise(self, v: Tensor, stiffness: Tensor) -> float:
        """What rounding leaves of a residual [kg^1/2 m/s]: of the velocities, and of the impulse of each particle, the
        tangent of which has the norm `stiffness` [p]."""
        stress = wp.to_torch(self.launches.T).flatten(1).norm(dim=1) + stiffness * (float(v.abs().max()) / self.dx)
        impulse = (2 * self.kick / self.dx) * self.volume * stress
        return self.rounding * (self.norm(v) + math.sqrt(float((impulse**2 / self.particle_mass).sum())))

    def norm(self, v: Tensor) -> float:
        """sqrt(2 x kinetic energy) of node velocities."""
        square = dot(self.mass * v, v)
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def spread(self, v: Tensor) -> float:
        """`norm` of the velocities against the mean one: what a change of frame leaves."""
        return self.norm(v - (self.mass * v).sum(0) / self.mass.sum())


def dot(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum(dtype=torch.float64))
