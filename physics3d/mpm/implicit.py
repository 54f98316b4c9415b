"""One implicit substep of MLS-MPM, backward Euler, and its exact adjoint: for waves that are too fast to follow.

The unknowns are the node velocities v at the end of the step; weights and places are those of its start:

    v_i = B_i(u_i),   u_i = e^(-c dt) [ (p_i + dt f_i(v))/m_i + dt g ]            B: walls, held regions, colliders
    f_i = -(4/dx^2) sum_p V_p w_ip T_p (x_i - x_p)                                                          [N]
    T_p = tau(L_p) (I + dt L_p)^-T,   L_p(v) as in the gather, tau from the material as it is              [Pa]

T_p = P F_n^T, so dt f is minus the gradient by v of the potential sum V_p psi((I + dt L_p) F_n): its Jacobian K is
symmetric for every material that has a potential, and f has no torque about the places at the end of the step.

Newton. C_p = dT/dL, 9 x 9 per particle, comes from nine launches of the adjoint that the material has anyway. The
linear systems P^T (M + K) P d = -P^T r are solved by conjugate gradients without assembling K; C is taken symmetric,
and a direction of negative curvature ends the solve. The line search asks for the slope of the energy,
r(v + a d) . d, which needs no energy. P is the derivative of B; where it is a projector (sticky, slip, separate) Newton
runs in its range, the active set taken anew in each iteration. Where it is none (sliding with friction) the system is
not symmetric, and BiCGStab takes over. Convergence is judged by the residual alone.

Adjoint. By the implicit function theorem, (1 + K^T P^T/M) x = adj v once per step, tight; x then goes back through the
terms of the residual by the adjoints of the kernels. C is exact there, symmetric or not.

Sources: Jiang et al. (2016) The material point method for simulating continuum materials, sec. 10; Gast et al. (2015)
Optimization integrator for large time steps; Nocedal and Wright (2006) ch. 7; van der Vorst (1992) for BiCGStab.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import warp as wp
from torch import Tensor

from physics3d.mpm import columns, transfer
from physics3d.mpm.stencil import stencil
from physics3d.mpm.substep import Substeps
from physics3d.warp_types import matrix, vector, vector4

NEWTON = 30  # iterations
SOLVER = 2000  # products with K in one linear solve
TRIES = 10  # of one line search
FLATTEST = 0.05  # det(I + dt L): a step that squeezes a particle to less is too long


@cache
def _stress(real) -> wp.Kernel:
    """Kernel: T = tau (I + dt L)^-T, and a count of the particles that the step would fold."""
    mat33 = matrix(real)

    @wp.kernel(module="unique", enable_backward=False)
    def stress_kernel(
        # in
        first: int,
        clock: wp.array2d(dtype=real),
        row: wp.array(dtype=int),
        L: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        # out
        T: wp.array(dtype=mat33),  # [Pa]
        folded: wp.array(dtype=int),  # [1] added to
    ):
        p = wp.tid() + first
        A = wp.identity(n=3, dtype=real) + clock[row[0], 0] * L[p]
        if wp.determinant(A) > real(FLATTEST):
            T[p] = tau[p] * wp.transpose(wp.inverse(A))
        else:
            T[p] = mat33()
            wp.atomic_add(folded, 0, 1)

    return stress_kernel


@cache
def _stress_adjoint(real) -> wp.Kernel:
    """Kernel: adjoint of `_stress`, written, not added: adj tau = E A^-1, adj L = -dt A^-T E^T T, A = I + dt L."""
    mat33 = matrix(real)

    @wp.kernel(module="unique", enable_backward=False)
    def stress_adjoint_kernel(
        # in
        first: int,
        clock: wp.array2d(dtype=real),
        row: wp.array(dtype=int),
        L: wp.array(dtype=mat33),
        T: wp.array(dtype=mat33),
        adjoint_T: wp.array(dtype=mat33),
        # out
        adjoint_tau: wp.array(dtype=mat33),
        adjoint_L: wp.array(dtype=mat33),
    ):
        p = wp.tid() + first
        dt = clock[row[0], 0]
        inverse = wp.inverse(wp.identity(n=3, dtype=real) + dt * L[p])
        E = adjoint_T[p]
        adjoint_tau[p] = E * inverse
        adjoint_L[p] = -dt * (wp.transpose(inverse) * wp.transpose(E) * T[p])

    return stress_adjoint_kernel


@cache
def _stiffness(real) -> wp.Kernel:
    """Kernel: K w of node velocities w: gather L_p(w), C_p : L_p, scatter, in one pass over the particles."""
    vec3, mat33 = vector(real), matrix(real)
    first_node, local, weights, _ = stencil(real)
    gathered, spread = columns.gathered(real, fast=False), columns.spread_vectors(real)

    @wp.kernel(module="unique", enable_backward=False)
    def stiffness_kernel(
        # in
        first: int,
        dx: real,
        window: wp.array(dtype=int),
        clock: wp.array2d(dtype=real),
        row: wp.array(dtype=int),
        volume: wp.array(dtype=real),
        cell: wp.array(dtype=wp.vec3i),
        offset: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        C: wp.array2d(dtype=real),  # [p, 81] dT_ab/dL_ce [Pa s], at 27 a + 9 b + 3 c + e
        w: wp.array(dtype=vec3),  # [node]
        # out
        Kw: wp.array(dtype=vec3),  # [node], added to [kg times the unit of w]
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            weight = weights(f)
            S = gathered(w, node, ny, nz, f, weight)
            L = mat33(S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2])
            A = mat33()
            for a in range(3):
                for b in range(3):
                    total = real(0.0)
                    for c in range(3):
                        for e in range(3):
                            total = total + C[p, 27 * a + 9 * b + 3 * c + e] * L[c, e]
                    A[a, b] = total
            A = (real(16.0) * clock[row[0], 0] * volume[p] / (dx * dx)) * A
            spread(Kw, node, ny, nz, weight, -(A * f), A)

    return stiffness_kernel


@cache
def _diagonal(real) -> wp.Kernel:
    """Kernel: the 3 x 3 blocks of K on its diagonal, C_p replaced by the isotropic tensor with the same means:
    C_ab,cd r_b r_d -> c_1 |r|^2 I + c_2 r r^T."""
    vec3, mat33 = vector(real), matrix(real)
    first_node, local, weights, _ = stencil(real)

    @wp.kernel(module="unique", enable_backward=False)
    def diagonal_kernel(
        # in
        first: int,
        dx: real,
        window: wp.array(dtype=int),
        clock: wp.array2d(dtype=real),
        row: wp.array(dtype=int),
        volume: wp.array(dtype=real),
        cell: wp.array(dtype=wp.vec3i),
        offset: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        moduli: wp.array2d(dtype=real),  # [p, 2] c_1, c_2 [Pa s]
        # out
        blocks: wp.array(dtype=mat33),  # [node], added to [kg]
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            weight = weights(f)
            factor = real(16.0) * clock[row[0], 0] * volume[p] / (dx * dx)
            c1, c2 = factor * moduli[p, 0], factor * moduli[p, 1]
            unit, one = wp.identity(n=3, dtype=real), real(1.0)
            rx = -f[0]
            for i in range(3):
                ry = -f[1]
                for j in range(3):
                    rz = -f[2]
                    for k in range(3):
                        s = weight[0, i] * weight[1, j] * weight[2, k]
                        r = vec3(rx, ry, rz)
                        block = (s * s * c1 * wp.dot(r, r)) * unit + (s * s * c2) * wp.outer(r, r)
                        wp.atomic_add(blocks, node + (i * ny + j) * nz + k, block)
                        rz = rz + one
                    ry = ry + one
                rx = rx + one

    return diagonal_kernel


class NotConverged(Exception):
    """The step is too long for Newton; the message says how it failed."""


@dataclass(frozen=True)
class Step:
    """What came of one step."""

    node_velocity: Tensor  # [node, 3] m/s: the solution, from which `replay` makes the next state again
    newton: int  # iterations
    products: int  # with K, in all linear solves


class ImplicitSubsteps:
    """Implicit substeps between the numbered states of a `Substeps`, on its grid, window and threads."""

    def __init__(self, substeps: Substeps, *, bounded: bool):
        """`bounded`: a boundary acts on the nodes."""
        self.substeps, self.bounded, self.mirrored = substeps, bounded, substeps.mirrored
        n, real = substeps.n, substeps.real
        self.real = real
        vec3, mat33 = vector(real), matrix(real)
        self.nothing = substeps._zeros(n, real)  # mass or volume of a scatter without inertia or without stress
        self.no_adjoint = substeps._zeros(n, mat33)  # of arguments that are multiplied by zero
        self.no_vector, self.no_matrix = substeps._zeros(n, vec3), substeps._zeros(n, mat33)
        self.T, self.E = substeps._zeros(n, mat33), substeps._zeros(n, mat33)
        self.adjoint = {name: substeps._zeros(n, mat33) for name in ("T", "tau", "L", "L_gathered")}
        self.adjoint |= {name: substeps._zeros(n, vec3) for name in ("v", "v_gathered", "unused")}
        self.C = substeps._zeros((n, 81), real)
        self.moduli = substeps._zeros((n, 2), real)
        self.folded = [substeps._zeros(1, wp.int32) for _ in substeps.ranges]
        self.capacity = self.side = 0
        self.tolerance = 1e-4 if substeps.dtype == torch.float32 else 1e-11
        self.gravity = torch.tensor(list(substeps.gravity), dtype=substeps.dtype, device=substeps.device)
        self.rounding = float(torch.finfo(substeps.dtype).eps)
        self.particle_mass = wp.to_torch(substeps.constant["mass"])
        self.volume = wp.to_torch(substeps.constant["volume"])

    # ------------------------------------------------------------------------------------------------ forward

    def step(self, clock: np.ndarray, i: int, j: int) -> Step:
        """State j from state i by the first row of the clock. Raises NotConverged."""
        self._begin(clock, i, j)
        free = self._update(gravity=True)
        v = self._bounded(self.present * self.momentum / self.safe_mass)  # as if nothing happened
        if not self._forces(v):
            raise NotConverged("particles left the grid, or their motion would fold them in one step")
        self._linearise(symmetric=True)
        if not self.mirrored:
            blocks = torch.linalg.inv(self.inverse_blocks).diagonal(dim1=1, dim2=2).mean(1)[:, None]
            self.reach = torch.where(self.present > 0, self.mass / blocks, 1.0)
        newton = products = 0
        before, residual = math.inf, self._residual(v)
        size = self._norm(residual)
        while True:
            # a body that falls from rest has no spread and, so far, no speed
            rounding = self._noise(v) + self.rounding * self._norm(free)
            goal = self.tolerance * (self._spread(free) + self._spread(v)) + rounding
            # within thirty of it, a residual that has stopped falling is rounding too
            if size <= goal or 0.5 * before <= size <= 30 * goal:
                return Step(v, newton, products)
            if newton == NEWTON:
                raise NotConverged(f"Newton has not converged in {NEWTON} iterations")
            if newton:
                self._linearise(symmetric=True)
            self._differentiate_boundaries()
            newton += 1
            forcing = max(min(0.1, 0.5 * (size / before) ** 1.6), 0.3 * goal / size)
            d, used = self._newton_direction(residual, forcing * size)
            products += used
            slope = self._dot(self.mass * residual, d)
            a = 1.0
            for _ in range(TRIES):
                trial = v + a * d
                trial_size, trial_slope = math.inf, math.inf
                if self._forces(trial):
                    trial_residual = self._residual(trial)
                    trial_size, trial_slope = self._norm(trial_residual), self._dot(self.mass * trial_residual, d)
                downhill = self.projectors and slope < 0 and trial_slope <= -0.5 * slope
                if math.isfinite(trial_size) and (trial_size <= 0.9 * size or downhill):
                    v, residual, before, size = trial, trial_residual, size, trial_size
                    break
                secant = slope / (slope - trial_slope) if slope < 0 < trial_slope < math.inf else 0.5
                a *= min(max(secant, 0.1), 0.5)
            else:
                if size <= 30 * goal:
                    self._forces(v)
                    return Step(v, newton, products)
                raise NotConverged(f"the line search of Newton iteration {newton} found no way down")

    def replay(self, clock: np.ndarray, i: int, j: int, node_velocity: Tensor) -> None:
        """State j from state i with the node velocities that `step` found: the same bytes, without a solve."""
        self._begin(clock, i, j)
        self._forces(node_velocity)

    def _begin(self, clock: np.ndarray, i: int, j: int) -> None:
        """Scatter mass and momentum of state i, without stress; the step is i -> j from now on."""
        sub = self.substeps
        if sub.capacity != self.capacity:
            self.capacity, self.launches = sub.capacity, {}
            vec3, mat33 = vector(self.real), matrix(self.real)
            self.w, self.blocks = sub._zeros(self.capacity, vec3), sub._zeros((sub.workers, self.capacity), mat33)
            self.Kw = sub._zeros((sub.workers, self.capacity), vec3)
            self.probe_velocity = sub._zeros(self.capacity, vec3)
            self.probe_grid = sub._zeros(self.capacity, vector4(self.real))
        sub._set_clock(clock)
        for w in range(sub.workers):
            sub._set_row(w, 0)
        self.pair, self.count = (i, j), sub.node_count
        self.dt, self.decay = float(clock[0, 0]), float(clock[0, 1])
        self.grid = wp.to_torch(sub.grid)[:, : self.count]
        self.nodes = wp.to_torch(sub.node_velocity)[: self.count]
        self.grid.zero_()
        if "mark" in sub.kernels:
            for w in range(sub.workers):
                sub._new_stamp(w)
        self._on_particles("push", "scatter", "mark")
        self._sum(self.grid)
        self.base = self.grid[0].clone()
        self.momentum, m = self.base.split((3, 1), 1)
        self.present = (m > sub.mass_floor).to(m.dtype)
        self.safe_mass = torch.where(m > sub.mass_floor, m, 1.0)
        # the inertia that dt f works against: damping takes its part of the impulse too
        self.mass = self.present * self.safe_mass / self.decay
        self.inverse_mass = self.present / self.safe_mass * self.decay
        self.reach = torch.ones_like(m)

    def _forces(self, v: Tensor) -> bool:
        """State j as v makes it, and the momentum on the grid that its stress makes; False if v folds a particle."""
        self.nodes.copy_(v)
        self.grid.zero_()
        counts = (*self.folded, *self.substeps.lost)
        for count in counts:
            count.zero_()
        self._on_particles("gather", "steer", "advance", "stress", "force")
        self._sum(self.grid)
        self.grid[0] += self.base
        self.falls = True
        return not any(int(count.numpy()[0]) for count in counts) and bool(torch.isfinite(self.grid[0]).all())

    def _residual(self, v: Tensor) -> Tensor:
        """(v - B(v + s (u(v) - v)))/s [m/s] after `_forces`. The root is the same for any s > 0; m over the diagonal
        of M + K guesses the nodes that separate far better than s = 1, which mirrored walls need."""
        if self.mirrored:
            return v - self._update(gravity=True)
        u = self.present * self.decay * (self.grid[0, :, :3] / self.safe_mass + self.dt * self.gravity)
        return (v - self._bounded(v + self.reach * (u - v))) / self.reach

    def _bounded(self, v: Tensor) -> Tensor:
        """B(v)."""
        self.grid[0, :, :3] = self.present * self.safe_mass * (v / self.decay)
        return self._update(gravity=False)

    def _update(self, *, gravity: bool) -> Tensor:
        """Velocities of what the grid holds, after damping, boundaries and perhaps gravity, a copy."""
        self.falls = gravity
        self._on_nodes("update" if gravity else "update_still")
        return self.nodes.clone()

    def _noise(self, v: Tensor) -> float:
        """What rounding leaves of a residual [kg^1/2 m/s]: of the velocities, and of the impulse of each particle."""
        dx = self.substeps.dx
        stress = wp.to_torch(self.T).flatten(1).norm(dim=1) + self.stiffness * (float(v.abs().max()) / dx)
        impulse = (2 * self.dt / dx) * self.volume * stress
        return self.rounding * (self._norm(v) + math.sqrt(float((impulse**2 / self.particle_mass).sum())))

    # ------------------------------------------------------------------------------------------------ linear algebra

    def _linearise(self, *, symmetric: bool) -> None:
        """C and the diagonal blocks of M + K at the last forces."""
        sub, n = self.substeps, self.substeps.n
        E, C = wp.to_torch(self.E), wp.to_torch(self.C)
        steered = "steer" in sub.kernels
        adjoint_L = wp.to_torch(self.adjoint["L_gathered" if steered else "L"])
        for k in range(9):
            E.zero_()
            E.view(n, 9)[:, k] = 1
            if steered:
                adjoint_L.zero_()
                wp.to_torch(self.adjoint["v"]).zero_()
            self._on_particles("stress_adjoint", "advance_adjoint", "steer_adjoint")
            C.view(n, 9, 9)[:, k] = adjoint_L.view(n, 9)
        square = C.view(n, 9, 9)
        self.symmetric = symmetric or bool((square - square.mT).abs().max() <= 1e-5 * square.abs().max())
        if symmetric:
            square.copy_(0.5 * (square + square.mT))
        self.stiffness = C.norm(dim=1)
        c = C.view(n, 3, 3, 3, 3)
        trace = torch.einsum("nabab->n", c)
        both = (torch.einsum("naabb->n", c) + trace + torch.einsum("nabba->n", c)) / 15
        c2 = (3 * both - trace / 3) / 2
        moduli = wp.to_torch(self.moduli)
        moduli[:, 0] = (both - c2).clamp(min=0)
        moduli[:, 1] = torch.maximum(c2, -moduli[:, 0])
        blocks = wp.to_torch(self.blocks)[:, : self.count]
        blocks.zero_()
        self._on_particles("diagonal")
        self._sum(blocks)
        eye = torch.eye(3, dtype=c.dtype, device=c.device)
        inertia = torch.where(self.present > 0, self.mass, 1.0)
        total = blocks[0] + inertia[:, :, None] * eye
        inverse, singular = torch.linalg.inv_ex(total)
        # a light node may lose its mass to rounding against one stiff particle; the preconditioner need not be exact
        spare = eye / total.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        self.inverse_blocks = torch.where((singular > 0)[:, None, None], spare, inverse)

    def _differentiate_boundaries(self) -> None:
        """P, dv/du of each node; or, where walls mirror and nodes depend on each other, how to apply it."""
        self.P, self.projectors = None, True
        if self.mirrored:
            x = torch.rand((2, *self.momentum.shape), dtype=self.momentum.dtype, device=self.momentum.device) - 0.5
            images = [self._derivative(y) for y in x]
            off = abs(self._dot(self.mass * x[0], images[1]) - self._dot(self.mass * x[1], images[0]))
            off += abs(self._dot(self.mass * x[0], self._derivative(images[1]) - images[1]))
            self.projectors = off <= 1e-4 * self._norm(x[0]) * self._norm(x[1])
        elif self.bounded:
            self.P = self.momentum.new_empty((self.count, 3, 3))
            for k in range(3):
                x = torch.zeros_like(self.momentum)
                x[:, k] = 1
                self.P[:, k] = self._pull(x) * self.mass
            off = (self.P - self.P.mT).abs().amax((1, 2)) + (self.P - self.P @ self.P).abs().amax((1, 2))
            self.projectors = bool(off.max() < 1e-3)

    def _pull(self, x: Tensor) -> Tensor:
        """Adjoint of momentum -> bounded velocity, at what the grid holds."""
        grid = wp.to_torch(self.probe_grid)[: self.count]
        grid.zero_()
        wp.to_torch(self.probe_velocity)[: self.count] = x
        self._on_nodes("probe" if self.falls else "probe_still")
        return grid[:, :3].clone()

    def _difference(self, x: Tensor) -> Tensor:
        """P x by central differences."""
        there = self.grid[0].clone()
        size = self._norm(there[:, :3] / self.safe_mass) / max(self._norm(x), torch.finfo(x.dtype).tiny)
        h = self.rounding ** (1 / 3) * size
        ends = []
        for sign in (1, -1):
            self.grid[0, :, :3] = there[:, :3] + sign * h * self.mass * x
            ends.append(self._update(gravity=self.falls))
        self.grid[0] = there
        return (ends[0] - ends[1]) / (2 * h) if h > 0 else torch.zeros_like(x)

    def _newton_direction(self, residual: Tensor, target: float) -> tuple[Tensor, int]:
        """d of one Newton step, with a residual up to `target` [kg^1/2 m/s]; and the count of products with K.

        Inside the range of P, P^T (M + K) d = -P^T r; outside, d restores the constraints."""
        s = self.reach
        if not self.projectors:
            return self._bicgstab(
                lambda x: (x - self._derivative(x - s * (x + self.inverse_mass * self._stiff(x)))) / s,
                -residual,
                lambda x: s * x + self._derivative(self._block(self.mass * x) - s * x),
                target,
            )
        inside = self._derivative(residual)
        outside = s * (residual - inside)
        rhs = -self.mass * inside
        extra = int(bool(outside.any()))
        if extra:
            rhs = rhs + self._derivative(self._stiff(outside), transposed=True)
        d, used, _ = self._cg(rhs, target)
        return d - outside, used + extra

    def _cg(self, rhs: Tensor, target: float) -> tuple[Tensor, int, bool]:
        """x = P x with P^T (M + K) x = rhs = P^T rhs; products with K; is the residual below target?"""
        x, r = torch.zeros_like(rhs), rhs.clone()
        z = self._precondition(r)
        p, rz = z.clone(), self._dot(r, z)
        for used in range(SOLVER):
            if math.sqrt(self._dot(r, self.inverse_mass * r)) <= target:
                return x, used, True
            Ap = self._derivative(self.mass * p + self._stiff(p), transposed=True)
            curvature = self._dot(p, Ap)
            if not curvature > 0:
                return (x if used else p), used + 1, False
            a = rz / curvature
            x += a * p
            r -= a * Ap
            z = self._precondition(r)
            rz, last = self._dot(r, z), rz
            p = z + (rz / last) * p
        return x, SOLVER, False

    def _precondition(self, r: Tensor) -> Tensor:
        """P D^-1 P^T r, D the diagonal blocks of M + K."""
        return self._derivative(self._block(self._derivative(r, transposed=True)))

    def _bicgstab(
        self, product: Callable[[Tensor], Tensor], rhs: Tensor, precondition: Callable[[Tensor], Tensor], target: float
    ) -> tuple[Tensor, int]:
        """x with product(x) = rhs up to `target`, or the best that was found; and the count of products."""
        x, r = torch.zeros_like(rhs), rhs.clone()
        shadow, rho, alpha, omega = rhs.clone(), 1.0, 1.0, 1.0
        v = p = torch.zeros_like(rhs)
        best, lowest, used = x, self._norm(r), 0
        while lowest > target and used < SOLVER:
            rho, last = self._dot(shadow, r), rho
            if abs(rho) < 1e-300 or omega == 0:
                break
            p = r + (rho / last) * (alpha / omega) * (p - omega * v)
            y = precondition(p)
            v = product(y)
            alpha = rho / self._dot(shadow, v)
            s = r - alpha * v
            z = precondition(s)
            t = product(z)
            square = self._dot(t, t)
            omega = self._dot(t, s) / square if square > 0 else 0.0
            x = x + alpha * y + omega * z
            r = s - omega * t
            used += 2
            size = self._norm(r)
            if not math.isfinite(size):
                break
            if size < lowest:
                best, lowest = x, size
        return best, used

    def _stiff(self, x: Tensor, *, transposed: bool = False) -> Tensor:
        """K x or K^T x [kg x]."""
        wp.to_torch(self.w)[: self.count] = x
        product = wp.to_torch(self.Kw)[:, : self.count]
        product.zero_()
        square = wp.to_torch(self.C).view(-1, 9, 9)
        turned = transposed and not self.symmetric
        if turned:
            square.copy_(square.mT.clone())
        self._on_particles("stiffness")
        if turned:
            square.copy_(square.mT.clone())
        self._sum(product)
        return product[0].clone()

    def _block(self, x: Tensor) -> Tensor:
        return (self.inverse_blocks * x[:, None, :]).sum(2)

    def _derivative(self, x: Tensor, *, transposed: bool = False) -> Tensor:
        """P x: what the boundaries make of a change of velocity; or P^T x."""
        if self.mirrored:
            if transposed:
                return self.mass * self._pull(x)
            # P/M is symmetric, unless something slides with friction
            return self._pull(self.mass * x) if self.projectors else self._difference(x)
        if self.P is None:
            return self.present * x
        return ((self.P.mT if transposed else self.P) * x[:, None, :]).sum(2)

    def _dot(self, a: Tensor, b: Tensor) -> float:
        return float((a * b).sum(dtype=torch.float64))

    def _norm(self, v: Tensor) -> float:
        """sqrt(2 x kinetic energy) of node velocities."""
        square = self._dot(self.mass * v, v)
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def _spread(self, v: Tensor) -> float:
        """`_norm` of the velocities against the mean one: what a change of frame leaves."""
        return self._norm(v - (self.mass * v).sum(0) / self.mass.sum())

    # ------------------------------------------------------------------------------------------------ adjoint

    def reverse(self, clock: np.ndarray, i: int, j: int, side: int, node_velocity: Tensor) -> int:
        """Carry the adjoint of state j, in adjoint set `side` of the substeps, to state i; which set holds it then.

        State i must be as it was; `node_velocity` as `step` found it. Raises NotConverged if the linear system does
        not let itself be solved."""
        sub = self.substeps
        assert sub.adjoint is not None
        self.replay(clock, i, j, node_velocity)
        self.side = side
        sub.adjoint["states"][1 - side].flat.zero_()
        if sub.v_pushed is not None:
            sub.adjoint["v_pushed"].zero_()
        from_nodes = wp.to_torch(sub.adjoint_node_velocity)[:, : self.count]
        from_nodes.zero_()
        self._on_particles("advance_back", "steer_back", "gather_back")
        self._sum(from_nodes)
        wanted = from_nodes[0].clone()
        self._linearise(symmetric=False)
        self._differentiate_boundaries()
        from_nodes[0] = self._solve_transposed(wanted)
        adjoint_grid = wp.to_torch(sub.adjoint_grid)
        adjoint_grid.zero_()
        self._on_nodes("update_back")
        # the forces on the nodes, and through them stress, material, velocity gradient and places
        for array in self.adjoint.values():
            array.zero_()
        self._on_particles("force_back", "stress_back", "advance_again", "steer_again")
        if "steer" not in sub.kernels:
            wp.to_torch(self.adjoint["L_gathered"]).copy_(wp.to_torch(self.adjoint["L"]))
        self._on_particles("gather_again", "scatter_back", "push_back")
        return 1 - side

    def _solve_transposed(self, wanted: Tensor) -> Tensor:
        """x with (1 + K^T P^T/M) x = wanted."""
        relative = 1e-13 if self.rounding < 1e-10 else 1e-6
        if self.symmetric and self.projectors:
            rhs = self._derivative(wanted, transposed=True)
            target = relative * math.sqrt(self._dot(rhs, self.inverse_mass * rhs))
            y, _, solved = self._cg(rhs, target)
            if solved:
                return wanted - self._stiff(y)

        def product(x: Tensor) -> Tensor:
            return x + self._stiff(self.inverse_mass * self._derivative(x, transposed=True), transposed=True)

        def precondition(x: Tensor) -> Tensor:
            return x + self._derivative(self.mass * self._block(x) - x, transposed=True)

        x, _ = self._bicgstab(product, wanted, precondition, relative * self._norm(wanted))
        if self._norm(product(x) - wanted) > 1e3 * relative * self._norm(wanted):
            raise NotConverged("the linear system of the adjoint has no accurate solution")
        return x

    # ------------------------------------------------------------------------------------------------ launches

    def _on_particles(self, *names: str) -> None:
        """Launch over all particles, each thread its own; those that the solver does not have are left out."""
        work = [[x for name in names if (x := self._launch(name, w)) is not None] for w in range(self.substeps.workers)]

        def worker(w: int, wait: Callable[[], object]) -> None:
            for launch in work[w]:
                launch.launch()

        self.substeps._on_all(worker)

    def _on_nodes(self, name: str) -> None:
        launch = self._launch(name, 0)
        assert launch is not None
        if launch.bounds.size != self.count:
            launch.set_dim(self.count)
        launch.launch()

    def _launch(self, name: str, w: int) -> wp.Launch | None:
        key = (name, w, *self.pair, self.side)
        if key not in self.launches:
            self.launches[key] = self._record(name, w)
        return self.launches[key]

    def _record(self, name: str, w: int) -> wp.Launch | None:
        sub, own, c = self.substeps, self.adjoint, self.substeps.constant
        arguments = sub._arguments(w, *self.pair)
        a, b = (sub.state(k).warp for k in self.pair)
        if name.endswith("_still"):
            arguments["update"][0][3] = vector(self.real)()  # gravity
        first, count = sub.ranges[w]
        clock = [sub.clock, sub.row[w]]
        place = [c["cell"], c["offset"], a["u"]]
        v = a["v"] if sub.v_pushed is None else sub.v_pushed
        scattered = [first, sub.dx, sub.window, *clock, c["mass"], self.nothing, *place, v, a["L"], self.no_matrix]
        forced = [first, sub.dx, sub.window, *clock, self.nothing, c["volume"], *place, self.no_vector, self.no_matrix]
        forced.append(self.T)
        gathered = [first, sub.dx, sub.window, *place, sub.node_velocity]

        def launch(kernel, inputs: list, outputs: list, adjoint: tuple[list, list] | None = None) -> wp.Launch:
            return sub._record(kernel, count, inputs, outputs, adjoint)

        def again(kernel: str, inputs: dict[int, wp.array], outputs: dict[int, wp.array]) -> wp.Launch | None:
            """Adjoint of a kernel of the substep, with adjoint arrays for some of its arguments."""
            if kernel not in sub.kernels:
                return None
            adjoints = tuple(
                [which.get(k, which.get(k - len(values))) for k in range(len(values))]
                for which, values in zip((inputs, outputs), arguments[kernel])
            )
            return launch(sub.kernels[kernel], *arguments[kernel], adjoints)

        real = self.real
        if name in ("push", "mark", "gather", "steer", "advance"):
            return launch(sub.kernels[name], *arguments[name]) if name in sub.kernels else None
        if name in ("update", "update_still"):
            return launch(sub.kernels["update"], *arguments["update"])
        if name == "scatter":
            return launch(transfer.scatter(real), scattered, [sub.grid[w], sub.lost[w]])
        if name == "stress":
            return launch(_stress(real), [first, *clock, b["L"], b["tau"]], [self.T, self.folded[w]])
        if name == "force":
            return launch(transfer.scatter(real), forced, [sub.grid[w], sub.lost[w]])
        if name == "stress_adjoint":
            return launch(_stress_adjoint(real), [first, *clock, b["L"], self.T, self.E], [own["tau"], own["L"]])
        if name == "advance_adjoint":
            return again("advance", {5: own["L"]}, {-1: own["tau"]})
        if name == "steer_adjoint":
            return again("steer", {-2: own["v_gathered"], -1: own["L_gathered"]}, {0: own["v"], 1: own["L"]})
        if name == "diagonal":
            inputs = [first, sub.dx, sub.window, *clock, c["volume"], *place, self.moduli]
            return launch(_diagonal(real), inputs, [self.blocks[w]])
        if name == "stiffness":
            inputs = [first, sub.dx, sub.window, *clock, c["volume"], *place, self.C, self.w]
            return launch(_stiffness(real), inputs, [self.Kw[w]])
        if name in ("probe", "probe_still"):
            return again("update", {-1: self.probe_grid}, {0: self.probe_velocity})
        adjoint = sub.adjoint
        assert adjoint is not None
        later, now = adjoint["states"][self.side].warp, adjoint["states"][1 - self.side].warp
        adjoint_v = now["v"] if sub.v_pushed is None else adjoint["v_pushed"]
        q, rest = adjoint["q"][w], adjoint["rest"]
        material = {3: now["u"], 6: now["H"], 7: adjoint["coefficients"], 8: now["memory"]}
        hooked = {4: rest, 5: q, 6: now["u"]}
        from_places = [adjoint["offset"], now["u"]]
        if name == "advance_back":
            outputs = dict(enumerate(later[key] for key in ("u", "H", "memory", "tau")))
            return again("advance", material | {4: later["v"], 5: later["L"]}, outputs)
        if name == "steer_back":
            inputs = hooked | {7: later["v_gathered"], 8: later["L_gathered"]}
            return again("steer", inputs, {0: later["v"], 1: later["L"]})
        if name == "gather_back":
            inputs = [*gathered, later["v_gathered"], later["L_gathered"]]
            return launch(transfer.gather_adjoint(real), inputs, [*from_places, sub.adjoint_node_velocity[w]])
        if name == "update_back":
            return again("update", {-2: q, -1: sub.adjoint_grid}, {0: sub.adjoint_node_velocity[0]})
        if name == "force_back":
            outputs = [*from_places, own["unused"], self.no_adjoint, own["T"]]
            return launch(transfer.scatter_adjoint(real), [*forced, sub.adjoint_grid], outputs)
        if name == "stress_back":
            return launch(_stress_adjoint(real), [first, *clock, b["L"], self.T, own["T"]], [own["tau"], own["L"]])
        if name == "advance_again":
            return again("advance", material | {5: own["L"]}, {-1: own["tau"]})
        if name == "steer_again":
            inputs = hooked | {7: own["v_gathered"], 8: own["L_gathered"]}
            return again("steer", inputs, {0: own["v"], 1: own["L"]})
        if name == "gather_again":
            inputs = [*gathered, own["v_gathered"], own["L_gathered"]]
            return launch(transfer.gather_adjoint(real), inputs, [*from_places, sub.adjoint_node_velocity[w]])
        if name == "scatter_back":
            outputs = [*from_places, adjoint_v, now["L"], self.no_adjoint]
            return launch(transfer.scatter_adjoint(real), [*scattered, sub.adjoint_grid], outputs)
        if name == "push_back":
            return again("push", hooked | {7: now["v"]}, {0: adjoint["v_pushed"]})
        raise ValueError(f"{name} is no launch of an implicit step")

    def _sum(self, grids: Tensor) -> None:
        """The grids of all threads into the first, in a fixed order."""
        for other in grids[1:]:
            grids[0] += other
