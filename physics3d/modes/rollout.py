"""A whole trajectory as one differentiable function, without a grid: the same face as `physics3d/mpm/rollout.py`.

    rollout(world, parameters, position, volume, ...) -> Trajectory
    Solver(world, position, volume, ...).rollout(parameters, ...)       the same, the model of the body built once

Time step. Errors of the midpoint rule in the frequency of a mode are (omega dt)^2/12. The automatic step is 1/STEPS of
the period of the fastest mode that the loads and the start put a hundredth of the energy into, and at most a frame;
shorter, down to a fourth, where the motion would be more than a fiftieth of a period late at its end; and halved for
every octave that the present material is above the one that the basis was made for. A step that is too long for this,
the user's own or not, is warned about. All steps of a frame are equal. A frame that Newton cannot solve is done again
with twice as many, up to TRIES times, then refused.

Gradients. The exact adjoint of the discrete motion in the basis, with respect to parameters, velocity and the forces of
boundaries; the basis and the places of the particles are given. What is kept of a step is its r x 3 amplitudes and the
history at the points of integration, however many particles there are.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import require_finite
from physics3d.boundaries.base import AbstractBoundary
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.materials.mixture import PART
from physics3d.matter import Matter
from physics3d.modes.dynamics import NotSolved, Step, System
from physics3d.modes.model import MODES, QUADRATURE, Model, model
from physics3d.modes.vibration import Mode
from physics3d.trajectory import NotMoved, Trajectory
from physics3d.world import World

STEPS = 24  # in a period of the fastest mode that matters
SHARE = 0.01  # of the energy, from which on a mode matters
LATE = 0.02  # of a period at the end, from which on steps are shorter than that
MOST_FINER = 4  # times, in a frame
# of the largest energy so far, that a motion may gain beyond the work of the loads: what is less comes and goes with
# the phase of a large swing, or with the length of a step. More is tried with steps of half the length, so many times
GAIN = 0.1
ENERGY_TRIES = 4
ROUNDING = 1e-13  # of the energy of a strain of one: what is less is rounding, of strains below 3e-7
REMEDY = "take a weaker force, a slower start, a smaller world.dt or world.solver='grid'"
FAR = 1.4  # stretched by more, a body is beyond what the basis was compared in
TRIES = 6


def rollout(
    world: World,
    parameters: Values,
    position: Float[Tensor, "p 3"],
    volume: Float[Tensor, " p"],
    *,
    velocity: Float[Tensor, "p 3"] | Float[Tensor, "3"] | None = None,
    excitation: tuple[AbstractBoundary, ...] = (),
    frames: int,
    frame_dt: float,
    device: str = "cpu",
    threads: int | None = None,
    matter: Matter | None = None,
    log: Log,
) -> Trajectory:
    """As the function of the same name with a grid; `matter` are the pieces of the body, if they are better known than
    as cubes around the particles. Computed on the CPU, on one thread; `device` is where the trajectory goes. Raises
    ValueError naming the field, the value and the remedy."""
    solver = Solver.of(
        world, position, volume, excitation=excitation, part=parameters.get(PART), matter=matter, log=log
    )
    return solver.rollout(parameters, velocity=velocity, frames=frames, frame_dt=frame_dt, device=device, log=log)


@dataclass(frozen=True, kw_only=True)
class Solver:
    """The model of a body under its boundaries and excitation, ready for any parameters and start."""

    world: World
    position: Tensor
    volume: Tensor
    model: Model

    @classmethod
    def of(
        cls,
        world: World,
        position: Float[Tensor, "p 3"],
        volume: Float[Tensor, " p"],
        *,
        excitation: tuple[AbstractBoundary, ...] = (),
        part: Tensor | None = None,
        matter: Matter | None = None,
        modes: int = MODES,
        points: int = QUADRATURE,
        swings_widely: bool = True,
        log: Log,
    ) -> "Solver":
        """`part` [p] where the material is a mixture. Where a body is asked for its vibrations alone, it need not swing
        widely. Raises ValueError as `rollout` does."""
        world.check()
        _check_body(position, volume)
        start: Values = {name: torch.tensor(value, dtype=torch.float64) for name, value in world.start.items()}
        if part is not None:
            start[PART] = part
        built = model(
            world,
            position,
            volume,
            parameters=start,
            boundaries=(*world.boundaries, *excitation),
            matter=matter,
            modes=modes,
            points_=points,
            swings_widely=swings_widely,
            log=log,
        )
        return cls(world=world, position=position, volume=volume, model=built)

    def coefficients(self, parameters: Values) -> Float[Tensor, "k n"]:
        """Of the material at the points of integration; differentiable."""
        found = self.world.material.coefficients({k: torch.as_tensor(v).double().cpu() for k, v in parameters.items()})
        return found.expand(-1, len(self.position))[:, torch.from_numpy(self.model.owner)]

    def modes(self, parameters: Values, count: int | None = None) -> list[Mode]:
        """The lowest modes of vibration about the undeformed state, `count` of them or all that the basis has; rigid
        motions of a free body are left out."""
        return self.model.modes(self.coefficients(parameters).detach().numpy(), count)

    def pushed(self, times: float) -> "Solver":
        """The same body under known forces so many times as large; accelerations stay. The basis holds its answer to a
        force whatever its size, so nothing is built anew."""
        found = self.model.conditions
        loads = tuple(
            load if load.boundary.force is None else replace(load, acceleration=times * load.acceleration)
            for load in found.loads
        )
        return replace(self, model=replace(self.model, conditions=replace(found, loads=loads)))

    def statics(
        self, parameters: Values, load: AbstractBoundary | None = None, *, gravity: bool = False
    ) -> Float[Tensor, "p 3"]:
        """Displacement of the particles [m] in equilibrium, a long time after the force of `load`, one of the
        excitation, and gravity have begun to act. Raises ValueError if there is none."""
        body, loads = self.model, self._loads().detach().numpy()
        total = np.zeros((body.count, 3))
        if gravity:
            total += loads[0]
        if load is not None:
            which = next(i for i, known in enumerate(body.conditions.loads) if known.boundary is load)
            total += loads[1 + which]
        system = body.system(self.coefficients(parameters).detach().numpy())
        try:
            return torch.from_numpy(body.values @ system.statics(np.zeros_like(total), total))
        except NotSolved as reason:
            raise NotSolved(f"no equilibrium was found: {reason}; take a weaker force or a stiffer material") from None

    def rollout(
        self,
        parameters: Values,
        *,
        velocity: Float[Tensor, "p 3"] | Float[Tensor, "3"] | None = None,
        frames: int,
        frame_dt: float,
        device: str = "cpu",
        log: Log,
    ) -> Trajectory:
        """As `rollout`."""
        if frames < 1:
            raise ValueError(f"frames is {frames}; take at least 1 (frame 0 is the initial state)")
        if not 0 < frame_dt < math.inf:
            raise ValueError(f"frame_dt is {frame_dt} s; take a time above 0")
        body = self.model
        coefficients = self.coefficients(parameters)
        start = self._start(velocity)
        loads = self._loads()
        run = _Run(
            solver=self,
            coefficients=coefficients.detach().numpy(),
            system=body.system(coefficients.detach().numpy()),
            frames=frames,
            frame_dt=frame_dt,
            log=log,
        )
        q = _Motion.apply(coefficients, start, loads, run)
        values, slopes = (torch.from_numpy(a) for a in (body.values, body.slopes))
        u = torch.stack([values @ a for a in q])
        v = torch.stack([values @ torch.from_numpy(a) for _, a, *_ in run.seen])
        Ft = torch.stack([(slopes @ a).reshape(-1, 3, 3) for a in q])  # transposed
        rest = self.position.to(device=device, dtype=torch.float64)
        place = lambda a: a.to(device=device, dtype=self.world.dtype)
        one = torch.eye(3, dtype=torch.float64)
        return Trajectory(
            rest_position=place(rest),
            position=place(rest + u.to(device)),
            velocity=place(v),
            deformation=place(Ft.mT + one),
            fps=1.0 / frame_dt,
            health=run.health,
            substeps=max(run.counts, default=0),
            substep_dt=min((frame_dt / count for count in run.counts), default=frame_dt),
        )

    def _start(self, velocity: Tensor | None) -> Float[Tensor, "r 3"]:
        """Amplitudes of the initial velocity."""
        body, p = self.model, len(self.position)
        if velocity is None:
            return torch.zeros(body.count, 3, dtype=torch.float64)
        require_finite("velocity", velocity)
        if velocity.shape not in ((3,), (p, 3)):
            raise ValueError(f"velocity has shape {tuple(velocity.shape)}; take [3] or [{p}, 3]")
        v = velocity.cpu().double().expand(p, 3)
        free = v[torch.from_numpy(~body.conditions.held)]
        return (torch.from_numpy(body.projection) @ free.reshape(-1)).reshape(body.count, 3)

    def _loads(self) -> Float[Tensor, "b r 3"]:
        """Force on every function: gravity, then each load at its full strength [N]."""
        body = self.model
        gravity = torch.tensor(self.world.gravity, dtype=torch.float64)
        found = [torch.from_numpy(body.first_moment)[:, None] * gravity]
        for field_, load in zip(body.load_fields, body.conditions.loads, strict=True):
            found.append(torch.from_numpy(field_)[:, None] * load.acceleration.double())
        return torch.stack(found)


@dataclass
class _Run:
    """The loop over frames; `_Motion` is its face to torch."""

    solver: Solver
    coefficients: np.ndarray  # at the points of integration [k, n]
    system: System
    frames: int
    frame_dt: float
    log: Log
    counts: list[int] = field(default_factory=list)
    health: dict[str, list[float]] = field(default_factory=dict)
    taken: list[list] = field(default_factory=list)
    # of each frame: amplitudes [r, 3] in m and m/s, history, iterations and matrices of Newton's method, last midpoint
    seen: list[tuple[np.ndarray, np.ndarray, np.ndarray, int, int, tuple]] = field(default_factory=list)

    def forward(self, v: np.ndarray, loads: np.ndarray, keep: bool) -> np.ndarray:
        """Amplitudes [t, r, 3] of every frame."""
        world, count = self.solver.world, self._count(v, loads)
        for tried in range(1, ENERGY_TRIES + 1):
            found = self._frames(v, loads, count, keep)
            gained, frame = self._gained(v)
            if gained <= GAIN:
                break
            if tried == ENERGY_TRIES or 2 * count > world.max_substeps or world.dt is not None:
                raise NotSolved(
                    f"frame {frame}: the motion gains {100 * gained:.2g} % of its energy from nowhere with steps of "
                    f"{self.frame_dt / self.counts[frame - 1]:g} s; {REMEDY}"
                )
            count *= 2
        self.health = {name: [float(value) for value in curve] for name, curve in self._record().items()}
        stretch = self.health["stretch_max"]
        if max(stretch) > FAR:
            self.log.warn(
                f"the body is stretched by {max(stretch):.2g} in frame {int(np.argmax(stretch))}; the basis is made "
                "for what bends and turns, and may be wrong there: compare with world.solver='grid'"
            )
        return found

    def _frames(self, v: np.ndarray, loads: np.ndarray, count: int, keep: bool) -> np.ndarray:
        """`forward` from the start on by so many steps a frame, or more."""
        self.system = self.solver.model.system(self.coefficients)
        self.counts, self.taken, self.seen = [], [], []
        q = np.zeros_like(v)
        self._look(q, v, (q, v, 0.0))
        for frame in range(1, self.frames):
            q, v, count = self._frame(frame, q, v, loads, count, keep)
            self._look(q, v, self.system.midpoint)
        return np.stack([seen[0] for seen in self.seen])

    def _gained(self, v: np.ndarray) -> tuple[float, int]:
        """The most that the energy has grown beyond the work of the loads, of its largest so far, and in which frame.
        What is lost does not make good for it."""
        x, w, work = (np.array(one) for one in zip(*(seen[-1] for seen in self.seen), strict=True))
        memory = np.array([seen[2] for seen in self.seen])
        energy = 0.5 * np.einsum("tri,rs,tsi->t", w, self.system.mass, w) + self.system.stored(x, memory)
        surplus, peak = energy - work, np.maximum.accumulate(energy)
        modulus = self.solver.world.material.wave_modulus(torch.from_numpy(self.coefficients)).numpy()
        rounding = ROUNDING * float(self.system.points.data["weight"] @ modulus)
        share = (surplus - np.minimum.accumulate(surplus)) / np.maximum(peak, rounding)
        return float(share.max()), int(share.argmax())

    def backward(self, q_bar: np.ndarray, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Adjoints of the coefficients [k, n], the start [r, 3] and the loads, from those of the frames."""
        points = self.system.points
        adjoint = {
            "q": np.zeros_like(q_bar[0]),
            "v": np.zeros_like(q_bar[0]),
            "H_0": np.zeros_like(points.data["H_0"]),
            "memory": np.zeros_like(points.data["memory"]),
            "coefficients": np.zeros_like(points.data["coefficients"]),
            "loads": np.zeros_like(loads),
        }
        for frame in range(self.frames - 1, 0, -1):
            adjoint["q"] = adjoint["q"] + q_bar[frame]
            self.system.pull(self.taken[frame - 1], adjoint, loads)
        return adjoint["coefficients"], adjoint["v"], adjoint["loads"]

    def _frame(self, frame, q, v, loads, count, keep):
        world = self.solver.world
        for tried in range(1, TRIES + 1):
            taken: list | None = [] if keep else None
            try:
                q_new, v_new = self.system.run(q, v, loads, self._plan(frame, count), taken)
                break
            except NotSolved as reason:
                if tried == TRIES or 2 * count > world.max_substeps or world.dt is not None:
                    raise NotSolved(
                        f"frame {frame}: {reason} with steps of {self.frame_dt / count:g} s; {REMEDY}"
                    ) from None
                count *= 2
        self.counts.append(count)
        self.taken.append(taken or [])
        return q_new, v_new, count

    def _plan(self, frame: int, count: int) -> list[Step]:
        dt = self.frame_dt / count
        loads = self.solver.model.conditions.loads
        plan = []
        for k in range(count):
            t = (frame - 1) * self.frame_dt + k * dt
            plan.append(Step(time=t, dt=dt, signals=(1.0, *(load.boundary.signals(t, dt)[0] for load in loads))))
        return plan

    def _count(self, v: np.ndarray, loads: np.ndarray) -> int:
        """Steps in a frame. Raises ValueError where they are more than the world allows."""
        world, length = self.solver.world, self.frame_dt
        share, then, now = self._swings(v, loads)
        if world.dt is not None:
            count = math.ceil(length / world.dt * (1 - 1e-9))
        else:
            # by whole octaves, so that a loss has no steps where a material changes a little
            raised = then * 2 ** max(0, round(math.log2(now.max() / then.max()))) if len(then) else then
            count = max(1, math.ceil(length * raised.max(initial=0.0) / (2 * math.pi) * STEPS))
            late = self._late(share, raised, length / count)
            count = math.ceil(count * min(max(math.sqrt(late / LATE), 1.0), MOST_FINER))
        if count > world.max_substeps:
            raise NotMoved(
                f"a frame would need {count} steps of {length / count:.3g} s, more than world.max_substeps = "
                f"{world.max_substeps}; take a larger world.dt, shorter frames, or a larger max_substeps"
            )
        late = self._late(share, now, length / count)
        if late > (3 * LATE if world.dt is None else LATE):  # of automatic steps octaves leave a factor of 2.8
            better = min(length / count * math.sqrt(LATE / late), 2 * math.pi / float(now.max()) / STEPS)
            self.log.warn(
                f"by steps of {length / count:.2g} s the motion is {late:.2g} periods late at the end; take "
                f"world.dt <= {better:.2g}{'' if world.dt is None else ', or None'}"
            )
        return count

    def _swings(self, v: np.ndarray, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the modes that matter: share of the energy, omega [1/s] of the material that the basis was made for, and
        of the present one."""
        body = self.solver.model
        omega = np.maximum(body.omega, 1e-9)
        # energies that the modes would have: of a static response, and of the start
        energy = np.zeros(len(omega))
        for load in loads:
            energy = np.maximum(energy, _share(np.einsum("mrk,rk->m", body.shapes, load) ** 2 / omega**2, omega))
        energy = np.maximum(energy, _share(np.einsum("mrk,rk->m", body.shapes, body.mass @ v) ** 2, omega))
        matters = np.flatnonzero(energy > SHARE)
        now = [math.sqrt(max(self.system.quotient(body.shapes[m]), 1e-18)) for m in matters]
        return energy[matters] / max(energy[matters].sum(), 1e-300), omega[matters], np.array(now)

    def _late(self, share: np.ndarray, omega: np.ndarray, dt: float) -> float:
        """Periods that the motion lags behind at the end, in the mean over the energy: of the midpoint rule, which
        swings at (2/dt) atan(omega dt/2)."""
        half = omega * dt / 2
        return float(share @ (omega / (2 * math.pi) * (1 - np.arctan(half) / half))) * self.frame_dt * (self.frames - 1)

    def _look(self, q: np.ndarray, v: np.ndarray, midpoint: tuple[np.ndarray, np.ndarray, float]) -> None:
        """Keep what the record of a frame is made of."""
        system = self.system
        self.seen.append((q, v, system.points.data["memory"].copy(), system.iterations, system.matrices, midpoint))
        system.iterations = system.matrices = 0

    def _record(self) -> dict[str, np.ndarray]:
        """Health of all frames, by the names of the solver with a grid."""
        world, body = self.solver.world, self.solver.model
        q, v, memory, iterations, matrices = (np.array(one) for one in list(zip(*self.seen, strict=True))[:-1])
        F = (body.gradient @ q).reshape(len(q), -1, 3, 3) + np.eye(3)
        J = np.linalg.det(F)
        stretch = np.sqrt(np.linalg.eigvalsh(F @ F.swapaxes(2, 3)).max((1, 2)))
        kinetic = 0.5 * np.einsum("tri,rs,tsi->t", v, body.mass, v)
        elastic = self.system.stored(q, memory)
        potential = -np.einsum("r,tri,i->t", body.first_moment, q, np.array(world.gravity))
        momentum = np.einsum("r,tri->it", body.first_moment, v)
        return {
            "speed_max": np.linalg.norm(body.values @ v, axis=2).max(1),
            "J_min": J.min(1),
            "J_max": J.max(1),
            "stretch_max": stretch,
            "inverted": (J <= 0).sum(1),
            "isolated": np.zeros(len(q)),
            "kinetic_energy": kinetic,
            "elastic_energy": elastic,
            "potential_energy": potential,
            "energy": kinetic + elastic + potential,
            **{f"momentum_{axis}": one for axis, one in zip("xyz", momentum, strict=True)},
            "substeps": np.array([0, *self.counts]),
            "newton_iterations": iterations,
            "matrices": matrices,
        }


class _Motion(torch.autograd.Function):
    """(coefficients [k, n], velocity [r, 3], loads [b, r, 3]) -> amplitudes [t, r, 3]."""

    @staticmethod
    def forward(ctx, coefficients, velocity, loads, run: _Run):
        ctx.run, ctx.loads = run, loads.detach().numpy()
        keep = any(ctx.needs_input_grad)
        return torch.from_numpy(run.forward(velocity.detach().numpy(), ctx.loads, keep))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, q_bar):
        found = ctx.run.backward(q_bar.contiguous().numpy(), ctx.loads)
        return (*(torch.from_numpy(a) for a in found), None)


def _share(energy: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Of all, rigid motions left out."""
    energy = np.where(omega > 1e-3 * omega.max(), energy, 0.0)
    return energy / max(float(energy.sum()), 1e-300)


def _check_body(position: Tensor, volume: Tensor) -> None:
    n = len(position)
    if n == 0 or position.shape != (n, 3):
        raise ValueError(f"position has shape {tuple(position.shape)}; take [p, 3] with at least one particle")
    if volume.shape != (n,):
        raise ValueError(f"volume has shape {tuple(volume.shape)}; take one per particle, [{n}]")
    require_finite("position", position)
    require_finite("volume", volume)
    if not bool((volume > 0).all()):
        raise ValueError(
            f"volume of {int((volume <= 0).sum())} of {n} particles is not above 0 m^3; drop those particles"
        )
    if position.requires_grad:
        raise ValueError("position requires a gradient, which the solver without a grid has not; take solver='grid'")
