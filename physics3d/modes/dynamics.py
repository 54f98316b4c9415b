"""Motion in time: the implicit midpoint rule, Newton's method on it, and its exact adjoint.

    x = (q_n + q_n+1)/2,   w = (v_n + v_n+1)/2 = (x - q_n) 2/dt,   v_n+1 - v_n = dt a(x)
    R(x) = M (2/dt (w - v_n) + c w) + f(x) + K_s (x - target) - load = 0,      f = sum_q w P(grad s x) : grad s

Of second order; without damping of its own: energies that are quadratic, momentum and angular momentum are kept
exactly, others without drift, for it is symplectic. What swings faster than a few steps is followed too slowly, not
damped. Stresses are asked for at midpoints only, each a step after the last, so that branches with a memory stay of
second order as well.

Newton takes the matrix of an earlier state as long as the error halves in every iteration, then that of the present
one; a step that does not lessen the error is halved, and if that is of no use the step is refused (`NotSolved`).

The adjoint of a step solves A^T lam = x_bar by a Krylov method (GCR) with the matrix that Newton had as its
preconditioner; the products with A^T are adjoints of the constitutive function, so it is that of the very same steps.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from scipy import linalg, sparse

from physics3d.modes.stress import Points
from physics3d.modes.vibration import STUCK, stiffness
from physics3d.trajectory import NotMoved

# of the last correction, of the largest first one of the run, in the norm of the matrix; by the precision asked for
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}
ROUND_OFF = 1e-7  # the same, where no step is better
MOST_ITERATIONS = 60
SLOW = 0.5  # an error that falls by less asks for a new matrix
SHORTEST = 1e-3  # share of a Newton step
LINEAR = 1e-6  # deformation in which the second order is lost


class NotSolved(NotMoved):
    """Newton's method found no end of this step."""


@dataclass(frozen=True, kw_only=True)
class Pull:
    """What a spring does at rest of the body, for a target that moves rigidly: X + (R - I) (X - point) + d."""

    motion: Callable[[float], tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]  # R - I [1], d [m] at a time
    first: Float[np.ndarray, "r 4"]  # int k s_j (1, X - point) [N/m], [N]

    def __call__(self, t: float) -> Float[np.ndarray, "r 3"]:
        """Force [N] at a time [s]: the matrix of the spring times the displacement of the target."""
        turn, way = self.motion(t)
        return self.first[:, :1] * way + self.first[:, 1:] @ turn.T


@dataclass(frozen=True, kw_only=True)
class Spring:
    """Holds part of the body at a target while it is on; `matrix` [r, r] N/m, of each component."""

    matrix: np.ndarray | sparse.csr_matrix  # [r, r] [N/m]
    pull: Pull | None = None  # None: the target is at rest
    until: float = np.inf  # [s]


@dataclass(frozen=True, kw_only=True)
class Step:
    """One step of a plan: from `time`, `dt` long, with the share of it that every load acts."""

    time: float  # [s]
    dt: float  # [s]
    signals: tuple[float, ...]


@dataclass
class _Taken:
    """What the reverse pass has to know of a step."""

    step: Step
    after: float  # time since the last midpoint [s]
    x: np.ndarray
    state: tuple[np.ndarray, np.ndarray]  # history before the step
    matrix: "_Matrix"


class _Matrix:
    """A = (M (4/dt^2 + 2 c/dt) + springs) x I + K, factored."""

    def __init__(self, A: np.ndarray):
        self.factor = linalg.lu_factor(A, check_finite=False)

    def solve(self, b: np.ndarray, transposed: bool = False) -> np.ndarray:
        return linalg.lu_solve(self.factor, b.reshape(-1), trans=int(transposed), check_finite=False).reshape(b.shape)


@dataclass
class _Way:
    """A step of Newton's method, and A times it."""

    way: np.ndarray
    force: np.ndarray

    @property
    def size(self) -> float:
        """Its square in the norm of A."""
        return float(np.vdot(self.way, self.force)) or 1e-300


@dataclass
class System:
    """A body in a basis of r functions."""

    gradient: Float[np.ndarray, "rows r"]  # of the functions at the points [1/m]
    mass: Float[np.ndarray, "r r"]  # [kg]
    points: Points
    springs: tuple[Spring, ...] = ()
    drag: float = 0.0  # c [1/s]
    tolerance: float = TOLERANCE[torch.float64]
    since: float = 0.0  # from the last midpoint to the start of the coming step [s]
    iterations: int = 0  # of Newton so far
    matrices: int = 0  # factored so far
    scale: float = 0.0  # of the corrections
    _work: float = 0.0  # of the loads and of the springs that pull, so far [J]
    _work_at: float = 0.0  # the same at the last midpoint
    _matrix: _Matrix | None = field(default=None, repr=False)
    _matrix_of: tuple = ()
    _K: object = field(default=None, repr=False)
    # dt, x and w of the last midpoints
    _past: list[tuple[float, np.ndarray, np.ndarray]] = field(default_factory=list, repr=False)

    def __post_init__(self):
        self._back = self.gradient.T.copy()

    def run(
        self, q: np.ndarray, v: np.ndarray, loads: np.ndarray, plan: Sequence[Step], keep: list | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """(q, v) [r, 3] after the steps of the plan, under loads [b, r, 3] N. With `keep`, a list, what
        the reverse pass needs is put there. Raises NotSolved; the state is then that of the start."""
        begin = self.points.state(), self.since, self._work
        try:
            for step in plan:
                q, v = self._step(q, v, loads, step, keep)
        except NotSolved:
            self.points.set_state(begin[0])
            self.since, self._work = begin[1:]
            self._past = []
            raise
        return q, v

    @property
    def midpoint(self) -> tuple[np.ndarray, np.ndarray, float]:
        """(x, w) of the last one, and the work [J] of the loads and of the springs that pull until then. There history
        and deformation belong together, and a balance of energy is right."""
        _, x, w = self._past[-1]
        return x, w, self._work_at

    def stored(self, x: Float[np.ndarray, "t r 3"], memory: Float[np.ndarray, "t m n"]) -> Float[np.ndarray, " t"]:
        """Elastic energy [J] of the body and of the springs that hold it at rest, with its history."""
        H = (self.gradient @ x).reshape(len(x), -1, 3, 3)
        springs = [np.einsum("tri,rs,tsi->t", x, s.matrix, x) for s in self.springs if s.pull is None]
        return self.points.energy(H, memory) + 0.5 * sum(springs, np.zeros(len(x)))

    def force(self, x: np.ndarray, after: float) -> np.ndarray:
        """f(x) [r, 3]."""
        P = self.points.stress((self.gradient @ x).reshape(-1, 3, 3), after)
        return self._back @ P.reshape(-1, 3)

    def quotient(self, shape: np.ndarray) -> float:
        """Rayleigh's quotient omega^2 [1/s^2] of a shape [r, 3] of unit mass about the undeformed state, all dash-pots
        stuck. The state is as it was."""
        H = (self.gradient @ shape).reshape(-1, 3, 3)
        small = LINEAR / max(float(np.abs(H).max()), 1e-300)
        state = self.points.state()
        self.points.set_state((np.zeros_like(state[0]), state[1]))
        P = self.points.stress(small * H, STUCK)
        self.points.set_state(state)
        springs = sum(float(np.vdot(shape, s.matrix @ shape)) for s in self.springs if s.pull is None)
        return float(np.vdot(H, P)) / small + springs

    def statics(self, x: np.ndarray, load: np.ndarray, time: float = 1e12) -> np.ndarray:
        """Equilibrium under a load [r, 3] N after a long time, in as many steps of the load as it takes.
        Raises NotSolved."""
        done, share = 0.0, 1.0
        while done < 1:
            share = min(share, 1 - done)
            part = (done + share) * load
            try:
                x = self._solve(
                    x, lambda y, part=part: self.force(y, time) + self._held(y, 0.0)[0] - part, 0.0, time, 0.0
                )
                done += share
                share *= 2
            except NotSolved:
                share /= 2
                if share < 1e-3:
                    raise
        return x

    def _held(self, x: np.ndarray, t: float) -> tuple[np.ndarray | float, tuple]:
        """(force of the springs that are on at t, which they are)."""
        total, on = 0.0, []
        for k, spring in enumerate(self.springs):
            if t < spring.until:
                on.append(k)
                total = total + spring.matrix @ x
                if spring.pull is not None:
                    total = total - spring.pull(t)
        return total, tuple(on)

    def _step(self, q, v, loads, step: Step, keep: list | None):
        dt, c = step.dt, self.drag
        t, after = step.time + dt / 2, self.since + dt / 2
        load = np.tensordot(np.array(step.signals), loads, 1) if len(loads) else 0.0
        inertia = lambda y: self.mass @ ((4 / dt**2 + 2 * c / dt) * (y - q) - (2 / dt) * v)
        residual = lambda y: inertia(y) + self.force(y, after) + self._held(y, t)[0] - load
        before = self.points.state() if keep is not None else None
        inertial = 4 / dt**2 + 2 * c / dt
        # a step at the present speed, in the same norm
        self.scale = max(self.scale, float(np.sqrt(max(np.vdot(v, self.mass @ v), 0.0))))
        try:
            x = self._solve(self._guess(q, v, dt), residual, inertial, after, t)
        except NotSolved:  # going straight on may stretch what in truth turns
            self._refresh(q, after, (inertial, self._held(q, t)[1]))
            x = self._solve(q, residual, inertial, after, t)
        self._past = [*self._past[-2:], (dt, x, (x - q) * (2 / dt))]
        outer = sum((s.pull(t) - s.matrix @ x for s in self.springs if s.pull and t < s.until), load)
        half = float(np.vdot(outer, x - q)) if len(loads) or self.springs else 0.0
        self._work_at, self._work = self._work + half, self._work + 2 * half
        if keep is not None and before is not None:
            keep.append(_Taken(step, after, x, before, self._factored))
        self.points.keep()
        self.since = dt / 2
        return 2 * x - q, (4 / dt) * (x - q) - v

    def _guess(self, q: np.ndarray, v: np.ndarray, dt: float) -> np.ndarray:
        """The coming midpoint: on the parabola through the last three, for what turns does not go straight on."""
        if len(self._past) == 3 and all(old[0] == dt for old in self._past):
            a, b, c = (old[1] for old in self._past)
            return 3 * (c - b) + a
        return q + dt / 2 * v

    def _solve(self, x, residual, inertia: float, after: float, t: float) -> np.ndarray:
        """The root of the residual near x; the points are left at it."""
        which = (inertia, self._held(x, t)[1])
        if self._matrix is None:
            self._refresh(x, after, which)
        elif which != self._matrix_of:
            self._factor(which)
        fresh = False
        r = residual(x)
        step, error = self._newton(r, [])
        self.scale = max(self.scale, error)
        steps: list[_Way] = []  # taken with the present matrix
        for _ in range(MOST_ITERATIONS):
            self.iterations += 1
            if error <= self.tolerance * self.scale:
                return x
            share = 1.0
            while True:
                y = x - share * step.way
                r_new = residual(y)
                new, new_error = self._newton(r_new, [*steps, step] if share == 1 else [])
                if new_error < (1 - share / 4) * error:
                    break
                if steps or not fresh:
                    self._refresh(x, after, which)
                    fresh, share, steps = True, 1.0, []
                    step, error = self._newton(r, [])
                elif share > SHORTEST:
                    share /= 2
                elif error <= ROUND_OFF * self.scale:
                    residual(x)
                    return x
                else:
                    raise NotSolved("Newton's method finds no step that lessens the error")
            slow = new_error > SLOW * error
            steps = [*steps, step] if share == 1 else []
            x, r, step, error, fresh = y, r_new, new, new_error, False
            if slow:
                self._refresh(x, after, which)
                fresh, steps = True, []
                step, error = self._newton(r, [])
        raise NotSolved(f"Newton's method does not converge in {MOST_ITERATIONS} iterations")

    def _newton(self, r: np.ndarray, steps: list["_Way"]) -> tuple["_Way", float]:
        """(the next step to subtract, the size of A^-1 r in the norm of A); infinite where the residual is no number.
        Broyden's update by the steps so far (Kelley 1995, sec. 7.3), in the inner product of A."""
        if not np.isfinite(r).all():
            return _Way(r, r), np.inf
        way, force = self._factored.solve(r), r
        error = float(np.sqrt(abs(np.vdot(way, r))))
        for s, after in itertools.pairwise(steps):
            share = np.vdot(s.force, way) / s.size
            way, force = way + share * after.way, force + share * after.force
        if steps:
            factor = 1 / (1 - np.vdot(steps[-1].force, way) / steps[-1].size)
            way, force = factor * way, factor * force
        return _Way(way, force), error

    @property
    def _factored(self) -> _Matrix:
        assert self._matrix is not None, "no step has begun"
        return self._matrix

    def _refresh(self, x, after: float, which: tuple) -> None:
        D = self.points.tangent((self.gradient @ x).reshape(-1, 3, 3), after)
        self._K = stiffness(self.gradient, D)
        if not np.isfinite(self._K.sum()):
            raise NotSolved("the stiffness is not finite")
        self._factor(which)

    def _factor(self, which: tuple) -> None:
        inertia, on = which
        scalar = inertia * self.mass
        for k in on:
            scalar = scalar + self.springs[k].matrix
        self._matrix = _Matrix(self._K + np.kron(scalar, np.eye(3)))
        self._matrix_of = which
        self.matrices += 1

    # --- the reverse pass -------------------------------------------------------------------------------------------

    def pull(self, taken: Sequence[_Taken], adjoint: dict[str, np.ndarray], loads: np.ndarray) -> None:
        """Back through the steps, in the reverse order. `adjoint` holds those of q, v [r, 3], of the history H_0
        [n, 3, 3] and memory [m, n], which are replaced, and of coefficients and loads, which grow."""
        points = self.points
        for step in reversed(taken):
            dt, c = step.step.dt, self.drag
            points.set_state(step.state)
            points.stress((self.gradient @ step.x).reshape(-1, 3, 3), step.after)
            q_bar, v_bar = adjoint["q"], adjoint["v"]
            # q' = 2 x - q, v' = 4/dt (x - q) - v; x is also the history of the next step
            x_bar = 2 * q_bar + 4 / dt * v_bar + self._back @ adjoint["H_0"].reshape(-1, 3)
            memory_bar = adjoint["memory"] if points.rows else None
            if memory_bar is not None:
                x_bar = x_bar + self._back @ points.pull(None, memory_bar, step.after)["H"].reshape(-1, 3)
            lam = self._solve_transposed(x_bar, step)
            pulled = points.pull(-(self.gradient @ lam).reshape(-1, 3, 3), memory_bar, step.after)
            inertia = self.mass @ lam
            adjoint["q"] = (4 / dt**2 + 2 * c / dt) * inertia - q_bar - 4 / dt * v_bar
            adjoint["v"] = 2 / dt * inertia - v_bar
            adjoint["H_0"] = pulled["H_0"].copy()
            adjoint["memory"] = pulled["memory"].copy()
            adjoint["coefficients"] += pulled["coefficients"]
            for b, share in enumerate(step.step.signals):
                adjoint["loads"][b] += share * lam

    def _solve_transposed(self, b: np.ndarray, step: _Taken) -> np.ndarray:
        """A^T lam = b at the state of a step, by GCR."""
        dt, t = step.step.dt, step.step.time + step.step.dt / 2
        inertia = 4 / dt**2 + 2 * self.drag / dt
        on = [self.springs[k].matrix for k in self._held(step.x, t)[1]]

        def product(y: np.ndarray) -> np.ndarray:
            H = self.points.pull((self.gradient @ y).reshape(-1, 3, 3), None, step.after)["H"]
            found = inertia * (self.mass @ y) + self._back @ H.reshape(-1, 3)
            for matrix in on:
                found = found + matrix.T @ y
            return found

        lam, r, size = np.zeros_like(b), b, np.linalg.norm(step.matrix.solve(b, True))
        directions: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for _ in range(MOST_ITERATIONS):
            p = step.matrix.solve(r, True)
            if np.linalg.norm(p) <= self.tolerance * size:
                return lam
            Ap = product(p)
            # orthogonal in the norm of the preconditioned residual
            z = step.matrix.solve(Ap, True)
            for z_old, p_old, Ap_old in directions:
                share = np.vdot(z_old, z)
                z, p, Ap = z - share * z_old, p - share * p_old, Ap - share * Ap_old
            scale = np.linalg.norm(z)
            if scale == 0:
                return lam
            z, p, Ap = z / scale, p / scale, Ap / scale
            directions.append((z, p, Ap))
            share = np.vdot(z, step.matrix.solve(r, True))
            lam, r = lam + share * p, r - share * Ap
        raise NotSolved("the adjoint of a step does not converge")
