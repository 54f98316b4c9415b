"""P = dB/du: what the boundaries make of a change of node velocities.

Each node has a 3 x 3 block, unless walls mirror or something grips: then nodes depend on each other, and P is applied
by the adjoint of the boundaries or by differences. Where P is a projector (sticky, slip, separate) the unknowns move in
its range.
"""

import torch
import warp as wp
from torch import Tensor

from physics3d.mpm.hold import HELD
from physics3d.mpm.implicit.system import System, dot


class Groups:
    """The derivative of node velocities by node momenta where nodes near what is gripped follow others (`hold`), and
    no other boundary acts: with r_i the share of the velocity of node k that node i has,

        sum_j r_i r_j x_j/sum_j r_j^2 m_j        over the nodes j that follow the same k, and k itself

    It is symmetric. The kernel of the update says the same, node by node, at twenty times the cost."""

    def __init__(self, system: System):
        arrays, mass = system.launches.arrays, system.base[:, 3]
        leader = wp.to_torch(arrays.leader)[: system.count].long()
        depth = wp.to_torch(arrays.depth)[: system.count]
        alone = torch.arange(system.count, device=leader.device)
        top = torch.where(leader >= 0, leader, alone)
        follows = leader >= 0
        ratio = torch.where(follows, depth / torch.where(follows, depth[top], 1.0), 1.0)
        # nodes that are held have no part, nor have light ones that nobody follows
        ratio = torch.where((leader == HELD) | (~follows & (system.present[:, 0] == 0)), 0.0, ratio)
        inertia = torch.zeros_like(mass).index_add_(0, top, ratio.square() * mass)
        self.ratio: Tensor = ratio[:, None]
        self.mobility: Tensor = (system.decay / torch.where(inertia > 0, inertia, torch.inf))[top, None] * self.ratio
        self.followers: Tensor = follows.nonzero()[:, 0]  # few; who is followed follows nobody
        self.followed: Tensor = leader[self.followers]

    def __call__(self, x: Tensor) -> Tensor:
        y = self.ratio * x
        y.index_add_(0, self.followed, y[self.followers])
        y[self.followers] = y[self.followed]
        return y.mul_(self.mobility)


class Constraints:
    """P at the last residual."""

    def __init__(self, system: System, *, bounded: bool):
        """`bounded`: a boundary acts on the nodes."""
        self.system = system
        self.P: Tensor | None = None  # [node, 3, 3]
        self.projectors: bool = True
        self.groups: Groups | None = None  # P where nothing but these acts
        momentum = system.momentum
        if system.coupled and not system.launches.arrays.mirrored:
            x = _anything(momentum, 1)[0]
            groups, there = Groups(system), self._pull(x)
            if float((groups(x) - there).abs().max()) <= 100 * system.rounding * float(there.abs().max()):
                self.groups = groups
        if system.coupled and self.groups is None:
            x = _anything(momentum, 2)
            images = [self.derivative(y) for y in x]
            off = abs(dot(system.mass * x[0], images[1]) - dot(system.mass * x[1], images[0]))
            off += abs(dot(system.mass * x[0], self.derivative(images[1]) - images[1]))
            self.projectors = off <= 1e-4 * system.norm(x[0]) * system.norm(x[1])
        elif bounded and not system.coupled:
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
        return torch.bmm(self.P.mT if transposed else self.P, x[:, :, None])[:, :, 0]

    def _pull(self, x: Tensor) -> Tensor:
        """Adjoint of momentum -> bounded velocity, at what the grid holds."""
        if self.groups is not None:
            return self.groups(x)
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


def _anything(like: Tensor, count: int) -> Tensor:
    """Vectors to try P with, the same at every call: whatever was computed before must not matter."""
    generator = torch.Generator(like.device).manual_seed(0)
    return torch.rand((count, *like.shape), dtype=like.dtype, device=like.device, generator=generator) - 0.5
