"""The body on its device as the solver sees it, and the arrays and kernels made for it and its boundaries."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from physics3d.boundaries.base import mirror_nodes
from physics3d.cores import usable
from physics3d.mpm.arrays import Arrays
from physics3d.mpm.hooks import Hooks, hooks_of
from physics3d.mpm.problem import Problem
from physics3d.mpm.state import State
from physics3d.mpm.substep import Substeps
from physics3d.mpm.survey import Survey, survey

RUN = 32  # substeps between two looks at the particles, and between two checkpoints


@dataclass(frozen=True, kw_only=True)
class Body:
    """Sorted by cell."""

    problem: Problem
    coefficients: Tensor  # [k, p] of the material
    modulus: Tensor  # [p] or [1] wave modulus at rest, Pa
    rest: Tensor  # [p, 3] m
    mass: Tensor  # [p] kg
    volume: Tensor  # [p] m^3
    hooks: Hooks
    substeps: Substeps

    def look(self, now: State) -> Survey:
        """What the time step and the grid must know of the particles."""
        setting, material = self.problem.setting, self.problem.world.material
        modulus = self.modulus * material.stiffening(self.coefficients, now.memory)
        slack = 1.5 * setting.dx
        low, high = self.rest.new_tensor(setting.lower) - slack, self.rest.new_tensor(setting.upper) + slack
        return survey(now, self.substeps.arrays.constant, modulus, setting.dx, low, high)


def make_body(problem: Problem, coefficients: Tensor, q: Tensor, position: Tensor, selection: Tensor) -> Body:
    """`coefficients` [k, p], `q` parameters of the boundaries, `position` [p, 3] at rest in float64, `selection`
    [boundary, p]; sorted by cell."""
    world, setting = problem.world, problem.setting
    kind: dict[str, Any] = {"device": problem.device, "dtype": world.dtype}
    origin = setting.position.new_tensor(setting.lower)
    cells = (position - origin.to(position.device)) / world.dx
    cell = cells.floor()
    rest = position.to(**kind)
    mass = setting.mass.to(position.device)[problem.order].to(**kind)
    volume = mass / world.density
    real = wp.float32 if world.dtype == torch.float32 else wp.float64
    hooks = hooks_of(problem.boundaries, problem.widths, real)
    threads = problem.threads
    if threads is None:
        threads = min(usable(), 8, 1 + len(position) // 4000)
    arrays = Arrays(
        dx=world.dx,
        origin=setting.lower,
        gravity=world.gravity,
        mass=mass,
        volume=volume,
        rest=rest,
        cell=cell.to(torch.int32).contiguous(),
        offset=(cells - cell).to(**kind),
        coefficients=coefficients.contiguous(),
        q=q,
        selection=selection,
        hooks=hooks,
        walls=mirror_nodes(problem.boundaries, setting),
        memory_rows=world.material.memory_rows,
        longest_run=RUN,
        threads=threads,
    )
    return Body(
        problem=problem,
        coefficients=coefficients,
        modulus=world.material.wave_modulus(coefficients),
        rest=rest,
        mass=mass,
        volume=volume,
        hooks=hooks,
        substeps=Substeps(arrays, hooks, world.material.advance(real)),
    )
