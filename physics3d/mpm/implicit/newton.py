"""Newton's method for an implicit step.

The tangent of the step before serves as long as an iteration with it brings a digit. The linear systems
P^T (M + K) P d = -P^T r are solved without assembling K; C is taken symmetric, and a direction of
negative curvature ends the solve. The line search asks for the slope of the energy, r(v + a d) . d, which needs no
energy. Where P is a projector Newton runs in its range, the active set taken anew in each iteration. Where it is none
(sliding with friction) the system is not symmetric, and BiCGStab takes over. Convergence is judged by the residual
alone.

Sources: Gast et al. (2015) Optimization integrator for large time steps; Nocedal and Wright (2006) ch. 7.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from physics3d.mpm.implicit.constraints import Constraints
from physics3d.mpm.implicit.krylov import bicgstab, conjugate_gradients
from physics3d.mpm.implicit.slow import Course, SlowModes
from physics3d.mpm.implicit.system import System, dot
from physics3d.mpm.implicit.tangent import Tangent

ITERATIONS = 30
TRIES = 10  # of one line search
PAYS = 2  # iterations with the tangent of the step before; after more of them the next OWN steps make their own
OWN = 4
SERVES = 0.1  # a tangent that left the residual smaller than this share of it is used once more


class NotConverged(Exception):
    """The step is too long for Newton; the message says how it failed."""


@dataclass(frozen=True)
class Step:
    """What came of one step."""

    node_velocity: Tensor  # [node, 3] m/s: the solution, from which the next state can be made again
    newton: int  # iterations
    products: int  # with K, in all linear solves


def solve(system: System, *, bounded: bool) -> Step:
    """Node velocities at the end of the step, and the state that they make. Raises NotConverged.

    `bounded`: a boundary acts on the nodes."""
    free = system.update(gravity=True)
    v = system.bounded(system.present * system.momentum / system.safe_mass)  # as if nothing happened
    if not system.forces(v):
        raise NotConverged("particles left the grid, or their motion would fold them in one step")
    launches = system.launches
    launches.slow.follow(system.kick, launches.arrays.lowest, launches.arrays.size)
    tangent = Tangent(system, symmetric=True, again=launches.own_tangents == 0)
    launches.own_tangents = max(0, launches.own_tangents - 1)
    own = tangent.fresh
    if not system.coupled:
        blocks = torch.linalg.inv(tangent.inverse_blocks).diagonal(dim1=1, dim2=2).mean(1)[:, None]
        system.reach = torch.where(system.present > 0, system.mass / blocks, 1.0)
    tolerance = 1e-4 if v.dtype == torch.float32 else 1e-11
    newton = products = 0
    before, residual = math.inf, system.residual(v)
    size = system.norm(residual)
    newly = tangent.fresh
    while True:
        # a body that falls from rest has no spread and, so far, no speed
        rounding = system.noise(v, tangent.norm) + system.rounding * system.norm(free)
        goal = tolerance * (system.spread(free) + system.spread(v)) + rounding
        # within thirty of it, a residual that has stopped falling is rounding too
        if size <= goal or (newly and 0.5 * before <= size <= 30 * goal):
            if not own and newton > PAYS:
                launches.own_tangents = OWN
            return Step(v, newton, products)
        if newton == ITERATIONS:
            raise NotConverged(f"Newton has not converged in {ITERATIONS} iterations")
        if newton == 1:
            launches.reached[own] = size / before
        # a tangent serves as long as it brings a digit
        newly = newton > 0 and size > SERVES * before
        if newly:
            tangent = Tangent(system, symmetric=True)
        constraints = Constraints(system, bounded=bounded)
        newton += 1
        # more than the tangent is true to is not asked of a linear solve
        left = size / before if newton > 1 else launches.reached[own]
        true = 0.5 * left**1.6 if newly and newton > 1 else 0.3 * left
        forcing = max(min(0.1, true), 0.3 * goal / size)
        d, used = _direction(system, tangent, constraints, residual, forcing * size)
        products += used
        found = _searched(system, constraints, v, d, residual)
        if found is not None:
            before, (v, residual, size) = size, found
            continue
        system.forces(v)
        if size <= 30 * goal:
            return Step(v, newton, products)
        if newly:
            raise NotConverged(f"the line search of Newton iteration {newton} found no way down")
        before = size  # the tangent was an old one, and is made anew


def _searched(
    system: System, constraints: Constraints, v: Tensor, d: Tensor, residual: Tensor
) -> tuple[Tensor, Tensor, float] | None:
    """Velocities on the way from v along d that are nearer to the root, their residual and its size; None if there are
    none. The system is left at those that were tried last."""
    size, slope, a = system.norm(residual), dot(system.mass * residual, d), 1.0
    for _ in range(TRIES):
        trial = v + a * d
        trial_size, trial_slope = math.inf, math.inf
        if system.forces(trial):
            trial_residual = system.residual(trial)
            trial_size, trial_slope = system.norm(trial_residual), dot(system.mass * trial_residual, d)
        downhill = constraints.projectors and slope < 0 and trial_slope <= -0.5 * slope
        if math.isfinite(trial_size) and (trial_size <= 0.9 * size or downhill):
            return trial, trial_residual, trial_size
        secant = slope / (slope - trial_slope) if slope < 0 < trial_slope < math.inf else 0.5
        a *= min(max(secant, 0.1), 0.5)
    return None


def _direction(
    system: System, tangent: Tangent, constraints: Constraints, residual: Tensor, target: float
) -> tuple[Tensor, int]:
    """d of one Newton step, with a residual up to `target` [kg^1/2 m/s]; and the count of products with K.

    Inside the range of P, P^T (M + K) d = -P^T r; outside, d restores the constraints."""
    s = system.reach
    if not constraints.projectors:
        return bicgstab(
            lambda x: (x - constraints.derivative(x - s * (x + system.inverse_mass * tangent.stiff(x)))) / s,
            -residual,
            precondition=lambda x: s * x + constraints.derivative(tangent.block(system.mass * x) - s * x),
            size=system.norm,
            target=target,
        )
    inside = constraints.derivative(residual)
    outside = s * (residual - inside)
    rhs = -system.mass * inside
    extra = int(bool(outside.any()))
    if extra:
        rhs = rhs + constraints.derivative(tangent.stiff(outside), transposed=True)
    slow, course = system.launches.slow, Course()
    d, used, solved = projected_gradients(system, tangent, constraints, rhs, target, slow, course)
    if solved:
        slow.learn(course, used, math.log10(system.norm(residual) / target))
    return d - outside, used + extra


def projected_gradients(
    system: System,
    tangent: Tangent,
    constraints: Constraints,
    rhs: Tensor,
    target: float,
    slow: SlowModes,
    course: Course | None = None,
) -> tuple[Tensor, int, bool]:
    """x = P x with P^T (M + K) x = rhs = P^T rhs; products with K; is the residual at most `target` [kg^1/2 m/s]?

    Preconditioned by P (D^-1 + W) P^T, D the diagonal blocks of M + K, W the correction by slow modes. All residuals
    are P^T of themselves."""
    return conjugate_gradients(
        lambda p: constraints.derivative(system.mass * p + tangent.stiff(p), transposed=True),
        rhs,
        precondition=lambda r: constraints.derivative(tangent.block(r) + slow.correction(r)),
        size=lambda r: math.sqrt(dot(r, system.inverse_mass * r)),
        target=target,
        course=course,
    )
