"""A whole trajectory as one differentiable function: the only place where torch meets the MPM solver.

    rollout(world, parameters, position, volume, ...) -> Trajectory

Time step. Waves cross a cell in dx/(c + |v|), with rho c^2 = M + 2 |tau|, M the wave modulus at rest: a bound for
stretched and compressed bodies, where it is M - tau (Hencky), at most M + |tau| (neo-Hookean) or s^2 M at a stretch s
(fixed corotated). A lone particle, whose stress comes back undiluted, needs dt < dx/(sqrt(3) c): its three axes act
together (Sun, Shinar and Schroeder 2020). A viscosity eta without a spring in series needs dt < b = rho dx^2/(6 eta);
beside waves that need dt < a, damping at the rate 2/b leaves dt < a [(1 + x^2)^(1/2) - x], x = a/(2 b). An automatic
substep is cfl times the first and at most 0.95 times the last. Every frame has a whole number of equal substeps; a
frame that turns out too fast for them is done again with more, up to world.max_substeps.

The implicit scheme (`implicit.py`) knows none of these limits. Its automatic step is the whole frame, unless a particle
moves farther than half a cell in it, or turns or stretches by more than a fifth; a frame whose equations Newton cannot
solve is done again with twice the steps. It damps whatever swings faster than a few steps, so it is another answer and
not only a cheaper one: scheme="auto" takes it where the explicit substep is below 1/24 s / WORTH = 4e-5 s.

Gradients. The exact adjoint of the discrete trajectory: the state is kept at every RUN-th substep, or more sparsely if
world.checkpoint_bytes says so, and the reverse pass recomputes the substeps in between, run by run, with the same dt
and the same windows.
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.boundaries.base import AbstractBoundary, Setting, Vector, mirror_nodes
from physics3d.log import Log
from physics3d.materials.tensors.eigen import principal_values
from physics3d.materials.tensors.volume import determinant
from physics3d.mpm.checkpoints import Checkpoints
from physics3d.mpm.implicit import ImplicitSubsteps, NotConverged
from physics3d.mpm.substep import Hook, Substeps, start_warp
from physics3d.mpm.survey import Survey, survey
from physics3d.mpm.transfer import velocity_gradient
from physics3d.world import World

RUN = 32  # substeps between two looks at the particles, and between two checkpoints
MOST_NODES = 2**27
TRIES = 6  # of one frame, each with twice the substeps
# Explicit substeps that one implicit step has to replace before the automatic scheme takes it. Measured on one core, in
# float32, 12800 particles of a clamped block at 30 to 3000 explicit substeps per step: it costs 160 to 380 of them. By
# less than a factor of three it is not worth the vibrations that backward Euler damps.
WORTH = 1000
LONGEST = 1 / 24  # [s], of an implicit step of the automatic scheme: frames may be further apart than a film's


@dataclass(frozen=True, kw_only=True)
class Trajectory(AbstractArtifact):
    """Where the particles were, frame by frame; frame 0 is the initial state."""

    rest_position: Float[Tensor, "p 3"]  # [m]
    position: Float[Tensor, "t p 3"]  # [m]
    deformation: Float[Tensor, "t p 3 3"]  # total F
    fps: float
    health: dict[str, list[float]]  # per frame, see `_health`
    substeps: int  # of the frame that had most
    substep_dt: float  # the shortest [s]

    def check(self) -> None:
        t, p = self.position.shape[:2]
        if self.rest_position.shape != (p, 3) or self.deformation.shape != (t, p, 3, 3):
            raise ValueError(
                f"trajectory: rest_position {tuple(self.rest_position.shape)}, position {tuple(self.position.shape)} "
                f"and deformation {tuple(self.deformation.shape)} disagree; expected [p, 3], [t, p, 3], [t, p, 3, 3]"
            )
        require_finite("trajectory.position", self.position)
        require_finite("trajectory.deformation", self.deformation)


def rollout(
    world: World,
    parameters: dict[str, Tensor],
    position: Float[Tensor, "p 3"],
    volume: Float[Tensor, " p"],
    *,
    velocity: Float[Tensor, "p 3"] | Float[Tensor, "3"] | None = None,
    excitation: tuple[AbstractBoundary, ...] = (),
    frames: int,
    frame_dt: float,
    device: str = "cpu",
    threads: int | None = None,
    log: Log,
) -> Trajectory:
    """Simulate `frames` frames, frame 0 being the initial state, frame_dt [s] apart.

    `position` [m] at rest, `volume` [m^3] at rest, `velocity` [m/s] at the start (None: at rest), `parameters` SI, each
    a scalar or one number per particle. The trajectory is differentiable with respect to parameters, velocity, position
    and the forces of boundaries where these are tensors that require it. `threads` (CPU only): None takes as many cores
    as there are particles to fill. Raises ValueError naming the field, the value and the remedy."""
    world.check()
    boundaries = (*world.boundaries, *excitation)
    _check_inputs(position, volume, velocity, boundaries, frames, frame_dt)
    n, dtype = len(position), world.dtype
    if velocity is None:
        velocity = torch.zeros(3)
    lower, upper = _region(world, position, velocity, frame_dt * (frames - 1))
    mass = world.density * volume.detach().double().cpu()
    setting = Setting(position=position.detach().double().cpu(), mass=mass, lower=lower, upper=upper, dx=world.dx)

    if velocity.ndim == 1:
        gradient = torch.zeros(n, 3, 3)
    else:
        x, v = position.double(), velocity.double().to(position.device)
        gradient = velocity_gradient(x / world.dx, v, mass.to(x.device)) / world.dx

    # neighbours in space are neighbours in memory
    order = _sorted_by_cell(setting.position, world.dx).to(device)
    back = torch.argsort(order)

    def place(value: Tensor) -> Tensor:
        return value.to(device=device, dtype=dtype)

    coefficients = world.material.coefficients({name: value.double().to(device) for name, value in parameters.items()})
    coefficients = place(coefficients.expand(len(coefficients), n)[:, order])
    q = [boundary.parameters(setting).to(torch.float64) for boundary in boundaries]
    solver = _Solver(
        world=world,
        setting=setting,
        boundaries=boundaries,
        widths=tuple(len(k) for k in q),
        order=order,
        frames=frames,
        frame_dt=frame_dt,
        device=device,
        threads=threads,
        log=log,
    )
    u, deformation = _Rollout.apply(
        coefficients,
        place(torch.cat(q)) if q else torch.zeros(0, dtype=dtype, device=device),
        place(velocity.to(device).expand(n, 3)[order]),
        place(gradient.to(device)[order]),
        position.to(device=device, dtype=torch.float64)[order],
        solver,
    )
    rest = position.to(device=device, dtype=torch.float64)
    return Trajectory(
        rest_position=place(rest),
        position=place(rest + u[:, back].double()),
        deformation=deformation[:, back],
        fps=1.0 / frame_dt,
        health=solver.health,
        substeps=max(solver.counts, default=0),
        substep_dt=min((frame_dt / count for count in solver.counts), default=frame_dt),
    )


@dataclass
class _Run:
    """Some substeps in a row under one window, as they were done; what the reverse pass replays."""

    lowest: tuple[int, ...]
    size: tuple[int, ...]
    clock: np.ndarray  # [substeps, k]
    node_velocity: Tensor | None = None  # the solution of an implicit step, likewise


class _TooFast(Exception):
    """This frame needs shorter substeps, or a wider window; `why`, and what of the scene would spare them."""

    def __init__(self, why: str, remedy: str):
        super().__init__(why)
        self.remedy = remedy


@dataclass(frozen=True)
class _Limit:
    """How long an explicit substep may be in a state."""

    crossing: float  # waves and the fastest particle cross a cell [s]
    alone: float  # a lone particle stays stable, viscosity included [s]
    why: str
    remedy: str

    @property
    def dt(self) -> float:
        """The longest stable substep [s]."""
        return min(self.crossing, self.alone)


@dataclass
class _Solver:
    """The forward loop over frames and the reverse loop over runs; `_Rollout` is its face to torch."""

    world: World
    setting: Setting
    boundaries: tuple[AbstractBoundary, ...]
    widths: tuple[int, ...]  # parameters of each boundary
    order: Tensor
    frames: int
    frame_dt: float
    device: str
    threads: int | None
    log: Log
    counts: list[int] = field(default_factory=list)  # substeps of each frame
    work: dict[str, int] = field(default_factory=dict)  # what the present frame has cost
    implicit: ImplicitSubsteps | None = None
    now_implicit: bool = False  # once the scheme is implicit, it stays so
    no_implicit: bool = False  # the automatic scheme has tried it in vain
    health: dict[str, list[float]] = field(default_factory=dict)

    def forward(
        self, coefficients: Tensor, q: Tensor, velocity: Tensor, gradient: Tensor, position: Tensor, keep: bool
    ) -> tuple[Tensor, Tensor]:
        """Displacements [t, p, 3] and total deformations [t, p, 3, 3]."""
        start_warp()
        substeps = self._build(coefficients, q, position)
        self.substeps, self.coefficients = substeps, coefficients
        self.modulus = self.world.material.wave_modulus(coefficients)
        first = substeps.state(0)
        first.memory.copy_(self.world.material.initial_memory(len(position), self.world.dtype))
        first.v_gathered.copy_(velocity)
        first.L_gathered.copy_(gradient)
        self.initial = first.flat.clone() if keep else None
        substeps.start(self._clock(0.0, 0.0, 1), 0, 0)
        self.runs: list[list[_Run]] = []
        most = self.world.checkpoint_bytes
        self.checkpoints = Checkpoints(None if most is None else max(1, most // first.flat.nbytes))
        self.current = 0
        n, kind = len(position), {"dtype": self.world.dtype, "device": self.device}
        u, deformation = torch.empty((self.frames, n, 3), **kind), torch.empty((self.frames, n, 3, 3), **kind)
        eye = torch.eye(3, **kind)
        for frame in self.log.progress(range(self.frames), "simulate"):
            self.work = dict.fromkeys(("rejected", "lost", "newton", "products"), 0)
            if frame:
                self._frame(frame, keep)
            now = substeps.state(self.current)
            u[frame], deformation[frame] = now.u, now.H + eye
            for name, value in self._health(now).items():
                self.health.setdefault(name, []).append(value)
        return u, deformation

    def backward(self, adjoint_u: Tensor, adjoint_F: Tensor) -> tuple[Tensor, ...]:
        """Gradients of coefficients, q, velocity, its gradient, and position."""
        substeps = self.substeps
        substeps.begin_adjoint()
        side = 0
        states = substeps.adjoint["states"]
        flat_runs = [run for runs in self.runs for run in runs]
        index = len(flat_runs)

        def replay(k: int) -> None:
            run = flat_runs[k]
            substeps.set_window(run.lowest, run.size)
            substeps.run(run.clock, [0] * (len(run.clock) + 1))

        for frame in range(self.frames - 1, 0, -1):
            states[side].u.add_(adjoint_u[frame])
            states[side].H.add_(adjoint_F[frame])
            for run in reversed(self.runs[frame - 1]):
                index -= 1
                self.checkpoints.recall(index, substeps.state(0).flat, replay)
                substeps.set_window(run.lowest, run.size)
                if run.node_velocity is not None:
                    try:
                        side = self.implicit.reverse(run.clock, 0, 1, side, run.node_velocity)
                    except NotConverged as reason:
                        raise ValueError(f"frame {frame}, gradient: {reason}; take scheme='explicit'") from None
                    continue
                path = range(len(run.clock) + 1)
                substeps.run(run.clock, path)
                side = substeps.reverse(run.clock, path, side)
        states[side].u.add_(adjoint_u[0])
        states[side].H.add_(adjoint_F[0])
        substeps.state(0).flat.copy_(self.initial)
        substeps.start(self._clock(0.0, 0.0, 1), 0, 1)
        side = substeps.reverse_start(self._clock(0.0, 0.0, 1), 0, 1, side)
        return substeps.gradients(states[side])

    def _frame(self, frame: int, keep: bool) -> None:
        """From one frame to the next, in equal substeps that obey the limit; more of them if it turns out too fast."""
        start = self.substeps.state(self.current).flat.clone()
        begun = sum(len(runs) for runs in self.runs)
        self._choose(frame)
        count, reach = self._count(frame), 2.0
        fixed = self.world.dt is not None
        tries = (1 if self.now_implicit else 3) if fixed else TRIES
        for tried in range(1, tries + 1):
            try:
                steps = self._steps if self.now_implicit else self._runs
                self.runs.append(steps(frame, count, reach, keep))
                self.counts.append(count)
                return
            except _TooFast as reason:
                why, remedy = str(reason), reason.remedy
                self.substeps.state(self.current).flat.copy_(start)
                self.checkpoints.forget(begun)
                self.work["rejected"] += 1
                reach = min(2 * reach, 8.0)
                if tried == tries or (not fixed and 2 * count > self.world.max_substeps):
                    break
                count *= 1 if fixed else 2
        if self.now_implicit and self.world.scheme == "auto":
            self.now_implicit, self.no_implicit = False, True
            self.log.warn(f"frame {frame}: {why}; explicit from here on")
            return self._frame(frame, keep)
        dt, t = self.frame_dt / count, (frame - 1) * self.frame_dt
        if fixed:
            remedy = f"world.dt < {dt / 2:g}, or {remedy}"
        raise ValueError(
            f"frame {frame}: {why} with substeps of {dt:g} s, {tried} tries from {t:g} s on; take {remedy}"
        )

    def _choose(self, frame: int) -> None:
        """Make the coming frame implicit if the world wants that, or lets us and it pays."""
        if self.now_implicit or self.no_implicit or self.world.scheme == "explicit":
            return
        if self.world.scheme == "auto":
            if self.world.dt is not None:
                return
            now = self.substeps.state(self.current)
            explicit, implicit = self._explicit_need(self._limit(now, self._look(now))), self._implicit_need(now)
            if explicit < WORTH * implicit:
                return
            self.log.info(f"frame {frame}: implicit, for the explicit scheme would need {explicit} substeps a frame")
        self.now_implicit = True
        self.implicit = ImplicitSubsteps(self.substeps, bounded=self.bounded)

    def _steps(self, frame: int, count: int, reach: float, keep: bool) -> list[_Run]:
        """`count` implicit steps, each a run of its own."""
        assert self.implicit is not None
        dt = self.frame_dt / count
        runs = []
        for done in range(count):
            now = self.substeps.state(self.current)
            # weights are those of the start: no room for motion
            lowest, size = self._window(now, 0, dt, 0.0, frame)
            self.substeps.set_window(lowest, size)
            clock = self._clock((frame - 1) * self.frame_dt + done * dt, dt, 1)
            if keep:
                self._checkpoint(len(runs), now, needed=True)
            try:
                step = self.implicit.step(clock, self.current, 1 - self.current)
            except NotConverged as reason:
                raise _TooFast(str(reason), "a weaker force, a slower start or scheme='explicit'") from None
            self.current = 1 - self.current
            self.work["newton"] += step.newton
            self.work["products"] += step.products
            runs.append(_Run(lowest, size, clock, step.node_velocity if keep else None))
            self._inspect(frame, dt, 0)
        return runs

    def _runs(self, frame: int, count: int, reach: float, keep: bool) -> list[_Run]:
        dt = self.frame_dt / count
        runs, done = [], 0
        while done < count:
            now = self.substeps.state(self.current)
            # the limit follows the strain: look again before a particle has changed by a tenth, or snow that is packed
            # within a run bursts unseen
            rate = float(now.L.flatten(1).norm(dim=1).max())
            steps = min(RUN, count - done, max(1, int(0.1 / max(1e-30, rate * dt))))
            lowest, size = self._window(now, steps, dt, reach, frame)
            self.substeps.set_window(lowest, size)
            clock = self._clock((frame - 1) * self.frame_dt + done * dt, dt, steps)
            if keep:
                self._checkpoint(len(runs), now)
            runs.append(_Run(lowest, size, clock))
            path = [self.current] * (steps + 1)
            lost = self.substeps.run(clock, path)
            self.work["lost"] += lost
            self._inspect(frame, dt, lost)
            done += steps
        return runs

    def _checkpoint(self, done: int, now, *, needed: bool = False) -> None:
        """Before the run after `done` others of this frame. Implicit steps are few and not replayed: `needed`, and so
        is what they lead to."""
        if not done and self.runs and self.runs[-1][-1].node_velocity is not None:
            needed = True
        self.checkpoints.offer(sum(len(runs) for runs in self.runs) + done, now.flat, needed=needed)

    def _inspect(self, frame: int, dt: float, lost: int) -> None:
        """After a run: is every number finite, every particle in the region, and every substep short enough?"""
        now = self.substeps.state(self.current)
        seen = self._look(now)
        if seen.infinite:
            bad = ~torch.isfinite(now.u.sum(1) + now.v.square().sum(1) + now.tau.square().sum((1, 2)))
            raise _TooFast(
                f"{seen.infinite} of {len(bad)} particles have become infinite or NaN, first {self._who(bad)}",
                self.remedy,
            )
        if lost:
            raise _TooFast(
                f"particles moved too far in a few substeps ({lost} times outside the grid)",
                "a weaker force or a slower start",
            )
        limit = self._limit(now, seen)
        if self.now_implicit and dt * seen.speed > self.world.dx:
            way, speed = dt * seen.speed / self.world.dx, now.v.norm(dim=1)
            who = self._who(speed == speed.max())
            raise _TooFast(f"{who} moves {way:.3g} cells in a step", "a weaker force or a slower start")
        if not self.now_implicit and dt > limit.dt:
            raise _TooFast(limit.why, limit.remedy)
        if seen.outside:
            raise ValueError(
                f"frame {frame}: {seen.outside} of {len(now.u)} particles left the simulated region "
                f"{_corners(self.setting)}; enlarge world.lower and world.upper, or add a BoundingBox or a HalfSpace"
            )

    def _window(self, now, steps: int, dt: float, reach: float, frame: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Nodes around the particles, with room for `reach` times the way they can go in `steps` substeps of dt [s]."""
        duration = steps * dt
        seen = self._look(now)
        speed = seen.speed + math.hypot(*self.world.gravity) * duration
        # a legal substep moves no particle farther than a cell, so no more room than that, however fast they are
        room = 2 + math.ceil(min(reach * (1 + speed * duration / self.world.dx), reach + steps))
        lowest = tuple(cell - room for cell in seen.lowest)
        size = tuple(high + room + 1 - low for high, low in zip(seen.highest, lowest))
        if seen.infinite or math.prod(size) > MOST_NODES:
            across = " x ".join(f"{s:g}" for s in size)
            raise ValueError(
                f"frame {frame}: the particles spread over {across} cells; take a larger dx or a BoundingBox"
            )
        return lowest, size

    def _clock(self, t: float, dt: float, steps: int) -> np.ndarray:
        """Table for the kernels: dt, exp(-damping dt), signals of all boundaries."""
        rows = []
        for s in range(steps):
            signals = [x for boundary in self.boundaries for x in boundary.signals(t + s * dt, dt)]
            rows.append([dt, math.exp(-self.world.damping * dt), *signals])
        return np.array(rows)

    def _look(self, now) -> Survey:
        modulus = self.modulus * self.world.material.stiffening(self.coefficients, now.memory)
        slack = 1.5 * self.world.dx
        low, high = self.rest.new_tensor(self.setting.lower) - slack, self.rest.new_tensor(self.setting.upper) + slack
        return survey(now, self.substeps.constant, modulus, self.world.dx, low, high)

    def _speeds(self, seen: Survey) -> tuple[float, float]:
        """(fastest wave, fastest particle) [m/s]."""
        # snow that was torn apart has no stiffness left
        return max((seen.stiffness / self.world.density) ** 0.5, 1e-30), seen.speed

    def _limit(self, now, seen: Survey) -> _Limit:
        """How long an explicit substep may be in this state."""
        c, v = self._speeds(seen)
        dx, density = self.world.dx, self.world.density
        eta = float(self.world.material.viscosity(self.coefficients, now.L).max())
        waves, viscous = dx / (math.sqrt(3) * c), density * dx**2 / (6 * eta) if eta > 0 else math.inf
        x = waves / (2 * viscous)
        alone = waves / (math.sqrt(1 + x**2) + x)
        if x > 1:
            why = f"a viscosity of {eta:.3g} Pa s lets momentum cross a cell in {viscous:g} s"
            remedy = "a lower viscosity, a larger dx or scheme='implicit'"
        elif v > c:
            why, remedy = f"waves and particles cross a cell in {dx / (c + v):g} s", "a weaker force or a slower start"
        else:
            why = f"waves cross a cell in {dx / (c + v):g} s"
            remedy = "a softer material, a larger dx or scheme='implicit'"
        return _Limit(dx / (c + v), alone, why, remedy)

    def _explicit_need(self, limit: _Limit) -> int:
        """Substeps that a frame needs."""
        return math.ceil(self.frame_dt / min(self.world.cfl * limit.crossing, 0.95 * limit.alone))

    def _implicit_need(self, now) -> int:
        """Implicit steps that a frame needs: no particle moves half a cell, turns or stretches by a fifth in one, and
        unless the user wants them, none is longer than a frame of a film."""
        gain = math.hypot(*self.world.gravity) * self.frame_dt
        speed = (float(now.v.norm(dim=1).max()) + gain) / (0.5 * self.world.dx)
        rate = float(now.L.flatten(1).norm(dim=1).max()) / 0.2
        film = 1 / LONGEST if self.world.scheme == "auto" else 0.0
        return max(1, math.ceil(self.frame_dt * max(speed, rate, film) * (1 - 1e-9)))

    def _count(self, frame: int) -> int:
        """Equal substeps of the coming frame. Raises ValueError where the user's dt is above the limit, or there are
        more of them than the world allows."""
        now = self.substeps.state(self.current)
        limit, dt, most = self._limit(now, self._look(now)), self.world.dt, self.world.max_substeps
        self.remedy = limit.remedy
        last = self.counts[-1] if self.counts else 0
        if dt is not None:
            need = math.ceil(self.frame_dt / dt * (1 - 1e-9))
            if dt > limit.dt and not self.now_implicit:
                raise ValueError(
                    f"substep_dt is {dt:g} s, {limit.why} (frame {frame}); take world.dt < {limit.dt:.3g}, None for an "
                    "automatic one, or scheme='implicit'"
                )
        elif self.now_implicit:
            # half of the last, so that a frame that had to be halved does not make the next one start from too few
            need = max(self._implicit_need(now), last // 2)
        else:
            need = self._explicit_need(limit)
            # a count that still serves is kept, so that dt does not flicker from frame to frame
            need = last if need <= last <= 1.5 * need else need
        if need > most:
            given = f"world.dt > {self.frame_dt / most:.3g}" if dt is not None else limit.remedy
            why = limit.why
            if self.now_implicit:
                why, given = "particles move, turn or stretch too fast", "a weaker force or a slower start"
            raise ValueError(
                f"frame {frame} would need {need} substeps of {self.frame_dt / need:.3g} s, more than "
                f"world.max_substeps = {most}: {why}; take {given}, or a larger max_substeps"
            )
        return need

    def _who(self, chosen: Tensor) -> str:
        """The first particle of a mask [p]: its number as the caller counts, and where it is or was at rest."""
        p = int(chosen.nonzero()[0])
        x = self.rest[p] + self.substeps.state(self.current).u[p]
        what, x = ("at", x) if bool(torch.isfinite(x).all()) else ("at rest at", self.rest[p])
        place = ", ".join(f"{value:.4g}" for value in x.tolist())
        return f"particle {int(self.order[p])} {what} ({place}) m"

    def _health(self, now) -> dict[str, float]:
        """Numbers of one frame for a person to look at; SI. energy counts kinetic, elastic and potential energy."""
        F = now.H.double() + torch.eye(3, dtype=torch.float64, device=now.H.device)
        J, stretch = determinant(F), principal_values(F.mT @ F)[2].sqrt()
        mass, v = self.mass.double(), now.v.double()
        x = self.rest.double() + now.u.double()
        momentum = (mass[:, None] * v).sum(0)
        # about the origin, with the spin inside the particles: an APIC particle is a cloud of m dx^2/4 along each axis;
        # its motion inside is kinetic energy too, without which a body that is torn or crushed seems to gain some
        L = now.L.double()
        spin = torch.stack([L[:, 2, 1] - L[:, 1, 2], L[:, 0, 2] - L[:, 2, 0], L[:, 1, 0] - L[:, 0, 1]], 1)
        angular = (mass[:, None] * (torch.linalg.cross(x, v) + self.world.dx**2 / 4 * spin)).sum(0)
        kinetic = 0.5 * float((mass * (v.square().sum(1) + self.world.dx**2 / 4 * L.square().sum((1, 2)))).sum())
        psi = self.world.material.energy(self.coefficients, now.H, now.memory).double()
        elastic = float((psi * self.volume.double()).sum())
        potential = -float((mass * (x @ x.new_tensor(self.world.gravity))).sum())
        speed = float(v.norm(dim=1).max())
        dt = self.frame_dt / self.counts[-1] if self.counts else 0.0
        return {
            "speed_max": speed,
            "cfl": dt * sum(self._speeds(self._look(now))) / self.world.dx,
            "J_min": float(J.min()),
            "J_max": float(J.max()),
            "stretch_max": float(stretch.max()),
            "inverted": float((J <= 0).sum()),
            "isolated": float(_isolated(x, self.world.dx)),
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
            "substeps": float(self.counts[-1] if self.counts else 0),
            "rejected": float(self.work["rejected"]),
            "out_of_grid": float(self.work["lost"]),
            "newton_iterations": float(self.work["newton"]),
            "stiffness_products": float(self.work["products"]),
        }

    def _build(self, coefficients: Tensor, q: Tensor, position: Tensor) -> Substeps:
        world, kind = self.world, {"device": self.device, "dtype": self.world.dtype}
        origin = self.setting.position.new_tensor(self.setting.lower)
        cells = (position - origin.to(position.device)) / world.dx
        cell = cells.floor()
        self.rest = position.to(**kind)
        self.mass = self.setting.mass.to(position.device)[self.order].to(**kind)
        self.volume = self.mass / world.density
        real = _real(world.dtype)
        pushes, touches, nodes, steers, a, b = [], [], [], [], 0, 2
        for row, (boundary, width) in enumerate(zip(self.boundaries, self.widths)):
            for hooks, function in (
                (pushes, boundary.acceleration(real)),
                (touches, boundary.touch(real)),
                (nodes, boundary.node(real)),
                (steers, boundary.steer(real)),
            ):
                if function is not None:
                    hooks.append((function, a, b, row))
            a, b = a + width, b + len(boundary.signals(0.0, 0.0))
        selection = [boundary.selection(self.setting) for boundary in self.boundaries]
        self.bounded = bool(nodes)
        threads = self.threads
        if threads is None:
            threads = min(os.cpu_count() or 1, 8, 1 + len(position) // 4000)
        return Substeps(
            dx=world.dx,
            origin=self.setting.lower,
            gravity=world.gravity,
            mass=self.mass,
            volume=self.volume,
            rest=self.rest,
            cell=cell.to(torch.int32).contiguous(),
            offset=(cells - cell).to(**kind),
            coefficients=coefficients.contiguous(),
            q=q,
            selection=torch.stack(selection)[:, self.order.cpu()].to(**kind) if selection else torch.zeros(0, 0),
            signals=b - 2,
            pushes=tuple[Hook, ...](pushes),
            nodes=tuple[Hook, ...](nodes),
            touches=tuple[Hook, ...](touches),
            steers=tuple[Hook, ...](steers),
            walls=mirror_nodes(self.boundaries, self.setting),
            material=world.material.advance(real),
            memory_rows=world.material.memory_rows,
            longest_run=RUN,
            threads=threads,
        )


class _Rollout(torch.autograd.Function):
    """(coefficients [k, p], q, velocity [p, 3], its gradient [p, 3, 3], position [p, 3]) -> displacement [t, p, 3],
    deformation [t, p, 3, 3]."""

    @staticmethod
    def forward(ctx, coefficients, q, velocity, gradient, position, solver: _Solver):
        ctx.solver = solver
        keep = any(ctx.needs_input_grad)
        inputs = (coefficients, q, velocity, gradient, position)
        return solver.forward(*(value.detach() for value in inputs), keep)

    @staticmethod
    def backward(ctx, adjoint_u, adjoint_F):
        return (*ctx.solver.backward(adjoint_u, adjoint_F), None)


def _check_inputs(position, volume, velocity, boundaries, frames: int, frame_dt: float) -> None:
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
    if velocity is not None:
        require_finite("velocity", velocity)
        if velocity.shape not in ((3,), (n, 3)):
            raise ValueError(f"velocity has shape {tuple(velocity.shape)}; take [3] or [{n}, 3]")
    if frames < 1:
        raise ValueError(f"frames is {frames}; take at least 1 (frame 0 is the initial state)")
    if not (0 < frame_dt < math.inf):
        raise ValueError(f"frame_dt is {frame_dt} s; take a time above 0")
    for boundary in boundaries:
        boundary.check()


def _region(world: World, position: Tensor, velocity: Tensor, duration: float) -> tuple[Vector, Vector]:
    """Corners of the simulated region. Automatic: the body's own extent around it, and the way it falls or flies."""
    x = position.detach().double().cpu()
    low, high = x.amin(0), x.amax(0)
    if world.lower is not None and world.upper is not None:
        lower, upper = x.new_tensor(world.lower), x.new_tensor(world.upper)
        outside = int(((x < lower) | (x > upper)).any(1).sum())
        if outside:
            raise ValueError(
                f"{outside} of {len(x)} particles are outside the simulated region {world.lower} .. {world.upper} m at "
                "the start; enlarge world.lower and world.upper or move the body"
            )
        return tuple(lower.tolist()), tuple(upper.tolist())
    v = velocity.detach().double().cpu().reshape(-1, 3)
    half_g = 0.5 * x.new_tensor(world.gravity) * duration**2
    room = float((high - low).max()) + 4 * world.dx
    low = torch.minimum(low, low + v.amin(0) * duration + half_g) - room
    high = torch.maximum(high, high + v.amax(0) * duration + half_g) + room
    # nodes at whole multiples of dx, so that a floor at z = 0 lies on nodes
    return (
        tuple(((low / world.dx).floor() * world.dx).tolist()),
        tuple(((high / world.dx).ceil() * world.dx).tolist()),
    )


def _corners(setting: Setting) -> str:
    return (
        " .. ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in (setting.lower, setting.upper))
        + " m"
    )


def _sorted_by_cell(position: Tensor, dx: float) -> Tensor:
    """Permutation that puts particles of a cell, and then of a row and of a layer of cells, next to each other."""
    cell = (position / dx).floor().long()
    cell = cell - cell.amin(0)
    size = cell.amax(0) + 1
    return torch.argsort((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], stable=True)


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


def _real(dtype: torch.dtype):
    import warp as wp

    return wp.float32 if dtype == torch.float32 else wp.float64
