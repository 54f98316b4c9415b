"""Numbers of one frame for a person to look at: speeds, stretches, energies, momenta, and what the solver had to do.

An APIC particle is a cloud of m dx^2/4 along each axis; the motion inside it has a part in kinetic energy and angular
momentum, without which a body that is torn or crushed seems to gain some.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from physics3d.materials.tensors.eigen import principal_values
from physics3d.materials.tensors.volume import determinant
from physics3d.mpm.body import Body
from physics3d.mpm.limits import wave_speed
from physics3d.mpm.state import State


@dataclass
class Work:
    """What a frame has cost so far."""

    rejected: int = 0  # tries of the frame
    lost: int = 0  # times that a particle was outside the grid
    newton: int = 0  # iterations
    products: int = 0  # with the stiffness


def health(body: Body, now: State, work: Work, substeps: int) -> dict[str, float]:
    """SI. `energy` counts kinetic, elastic and potential energy; momenta are about the origin. `substeps` is 0 in the
    initial state."""
    world = body.problem.world
    F = now.H.double() + torch.eye(3, dtype=torch.float64, device=now.H.device)
    J, stretch = determinant(F), principal_values(F.mT @ F)[2].sqrt()
    mass, v = body.mass.double(), now.v.double()
    x = body.rest.double() + now.u.double()
    momentum = (mass[:, None] * v).sum(0)
    L = now.L.double()
    spin = torch.stack([L[:, 2, 1] - L[:, 1, 2], L[:, 0, 2] - L[:, 2, 0], L[:, 1, 0] - L[:, 0, 1]], 1)
    angular = (mass[:, None] * (torch.linalg.cross(x, v) + world.dx**2 / 4 * spin)).sum(0)
    kinetic = 0.5 * float((mass * (v.square().sum(1) + world.dx**2 / 4 * L.square().sum((1, 2)))).sum())
    psi = world.material.energy(body.coefficients, now.H, now.memory).double()
    elastic = float((psi * body.volume.double()).sum())
    potential = -float((mass * (x @ x.new_tensor(world.gravity))).sum())
    dt = body.problem.frame_dt / substeps if substeps else 0.0
    seen = body.look(now)
    return {
        "speed_max": float(v.norm(dim=1).max()),
        "cfl": dt * (wave_speed(world, seen) + seen.speed) / world.dx,
        "J_min": float(J.min()),
        "J_max": float(J.max()),
        "stretch_max": float(stretch.max()),
        "inverted": float((J <= 0).sum()),
        "isolated": float(_isolated(x, world.dx)),
        "kinetic_energy": kinetic,
        "elastic_energy": elastic,
        "potential_energy": potential,
        "energy": kinetic + elastic + potential,
        "momentum_x": float(momentum[0]),
        "momentum_y": float(momentum[1]),
        "momentum_z": float(momentum[2]),
        "angular_momentum_x": float(angular[0]),
        "angular_momentum_y": float(angular[1]),
        "angular_momentum_z": float(angular[2]),
        "substeps": float(substeps),
        "rejected": float(work.rejected),
        "out_of_grid": float(work.lost),
        "newton_iterations": float(work.newton),
        "stiffness_products": float(work.products),
    }


def _isolated(position: Tensor, dx: float) -> int:
    """Particles with no other particle in their own cell or the 26 around it."""
    cell = (position / dx).floor().long()
    cell = cell - cell.amin(0) + 1
    size = cell.amax(0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    occupied, count = torch.unique(key, return_counts=True)
    alone = occupied[count == 1]
    lonely = torch.ones(len(alone), dtype=torch.bool, device=alone.device)
    for step in _neighbours(int(size[1]), int(size[2])):
        at = torch.searchsorted(occupied, alone + step).clamp(max=len(occupied) - 1)
        lonely &= occupied[at] != alone + step
    return int(lonely.sum())


def _neighbours(ny: int, nz: int) -> Iterator[int]:
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            for k in (-1, 0, 1):
                if i or j or k:
                    yield (i * ny + j) * nz + k
