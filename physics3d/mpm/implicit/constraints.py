"""P = dB/du: what the boundaries make of a change of node velocities.

Each node has a 3 x 3 block, unless walls mirror or something grips: then nodes depend on each other, and P is applied
by the adjoint of the boundaries or by differences. Where P is a projector (sticky, slip, separate) the unknowns move in
its range.
"""

import torch
import warp as wp
from torch import Tensor

from physics3d.mpm.implicit.system import System, dot


class Constraints:
    """P at the last residual."""

    def __init__(self, system: System, *, bounded: bool):
        """`bounded`: a boundary acts on the nodes."""
        self.system = system
        self.P: Tensor | None = None  # [node, 3, 3]
        self.projectors: bool = True
        momentum = system.momentum
        if system.coupled:
            x = torch.rand((2, *momentum.shape), dtype=momentum.dtype, device=momentum.device) - 0.5
            images = [self.derivative(y) for y in x]
            off = abs(dot(system.mass * x[0], images[1]) - dot(system.mass * x[1], images[0]))
            off += abs(dot(system.mass * x[0], self.derivative(images[1]) - images[1]))
            self.projectors = off <= 1e-4 * system.norm(x[0]) * system.norm(x[1])
        elif bounded:
            self.P = momentum.new_empty((system.count, 3, 3))
            for k in range(3):
                x = torch.zeros_like(momentum)
                x[:, k] = 1
                self.P[:, k] = self._pull(x) * system.mass
            away = (self.P - self.P.mT).abs().amax((1, 2)) + (self.P - self.P @ self.P).abs().amax((1, 2))
            self.projectors = bool(away.max() < 1e-3)

    def derivative(self, x: Tensor, *, transposed: bool = False) -> Tensor:
        """P x or P^T x."""
        system = self.system
        if system.coupled:
            if transposed:
                return system.mass * self._pull(x)
            # P/M is symmetric, unless something slides with friction
            return self._pull(system.mass * x) if self.projectors else self._difference(x)
        if self.P is None:
            return system.present * x
        return ((self.P.mT if transposed else self.P) * x[:, None, :]).sum(2)

    def _pull(self, x: Tensor) -> Tensor:
        """Adjoint of momentum -> bounded velocity, at what the grid holds."""
        launches, count = self.system.launches, self.system.count
        grid = wp.to_torch(launches.probe_grid)[:count]
        grid.zero_()
        wp.to_torch(launches.probe_velocity)[:count] = x
        launches.on_nodes("probe" if self.system.falls else "probe_still")
        return grid[:, :3].clone()

    def _difference(self, x: Tensor) -> Tensor:
        """P x by central differences."""
        system = self.system
        there = system.grid.clone()
        size = system.norm(there[:, :3] / system.safe_mass) / max(system.norm(x), torch.finfo(x.dtype).tiny)
        h = system.rounding ** (1 / 3) * size
        ends = []
        for sign in (1, -1):
            system.grid[:, :3] = there[:, :3] + sign * h * system.mass * x
            ends.append(system.update(gravity=system.falls))
        system.grid.copy_(there)
        return (ends[0] - ends[1]) / (2 * h) if h > 0 else torch.zeros_like(x)
