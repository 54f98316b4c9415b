"""The exact adjoint of an implicit step.

By the implicit function theorem, (1 + K^T P^T/M) x = adj v once per step, tight; x then goes back through the terms of
the residual by the adjoints of the kernels. C is exact there, symmetric or not.
"""

import math

import numpy as np
import warp as wp
from torch import Tensor

from physics3d.mpm.adjoint import Adjoint
from physics3d.mpm.implicit.constraints import Constraints
from physics3d.mpm.implicit.krylov import bicgstab
from physics3d.mpm.implicit.launches import StepLaunches, total
from physics3d.mpm.implicit.newton import NotConverged, projected_gradients
from physics3d.mpm.implicit.system import System, dot
from physics3d.mpm.implicit.tangent import Tangent


def reverse(
    launches: StepLaunches,
    adjoint: Adjoint,
    clock: np.ndarray,
    i: int,
    j: int,
    side: int,
    node_velocity: Tensor,
    *,
    bounded: bool,
) -> int:
    """Carry the adjoint of state j, in adjoint set `side`, to state i; which set holds it then.

    State i and the window must be as they were; `node_velocity` as Newton found it. Raises NotConverged if the linear
    system does not let itself be solved."""
    adjoint.follow_grid()
    launches.between(i, j, adjoint=adjoint, side=side)
    system = System(launches, clock, i, j)
    system.forces(node_velocity)
    adjoint.states[1 - side].flat.zero_()
    if adjoint.v_pushed is not None:
        adjoint.v_pushed.zero_()
    from_nodes = wp.to_torch(adjoint.node_velocity)[:, : system.count]
    from_nodes.zero_()
    launches.on_particles("advance_back", "steer_back", "gather_back")
    wanted = total(from_nodes).clone()
    tangent = Tangent(system, symmetric=False)
    constraints = Constraints(system, bounded=bounded)
    from_nodes[0] = _solve(system, tangent, constraints, wanted)
    for array in (adjoint.grid, adjoint.gripped, adjoint.depth, adjoint.imposed, adjoint.mass, adjoint.volume):
        array.zero_()
    launches.on_nodes("update_back")
    if launches.arrays.grips:
        launches.on_nodes("face_back")
    # the forces on the nodes, and through them stress, material, velocity gradient and places
    for array in launches.own.values():
        array.zero_()
    launches.on_particles("force_back", "stress_back", "advance_again", "steer_again")
    if not launches.arrays.steered:
        wp.to_torch(launches.own["L_gathered"]).copy_(wp.to_torch(launches.own["L"]))
    launches.on_particles("gather_again", "scatter_back", "push_back", "hold_back")
    return 1 - side


def _solve(system: System, tangent: Tangent, constraints: Constraints, wanted: Tensor) -> Tensor:
    """x with (1 + K^T P^T/M) x = wanted."""
    relative = 1e-13 if system.rounding < 1e-10 else 1e-6
    if tangent.symmetric and constraints.projectors:
        rhs = constraints.derivative(wanted, transposed=True)
        target = relative * math.sqrt(dot(rhs, system.inverse_mass * rhs))
        slow = system.launches.slow
        slow.follow(system.kick, system.launches.arrays.lowest, system.launches.arrays.size)
        y, _, solved = projected_gradients(system, tangent, constraints, rhs, target, slow)
        if solved:
            return wanted - tangent.stiff(y)

    def product(x: Tensor) -> Tensor:
        return x + tangent.stiff(system.inverse_mass * constraints.derivative(x, transposed=True), transposed=True)

    def precondition(x: Tensor) -> Tensor:
        return x + constraints.derivative(system.mass * tangent.block(x) - x, transposed=True)

    size = relative * system.norm(wanted)
    x, _ = bicgstab(product, wanted, precondition=precondition, size=system.norm, target=size)
    if system.norm(product(x) - wanted) > 1e3 * size:
        raise NotConverged("the linear system of the adjoint has no accurate solution")
    return x
