"""From frame to frame: equal substeps in runs, a frame that turns out too fast done again, and all of it backwards.

Every frame has a whole number of equal substeps (`limits`). After a run of them the particles are looked at: if one has
become infinite, left the grid, or the substeps are longer than the limit by now, the frame is done again with twice as
many, up to world.max_substeps. An implicit step is a run of its own, and a frame whose equations Newton cannot solve is
done again with twice the steps too.

Gradients. The exact adjoint of the discrete trajectory: the state is kept before every run, or more sparsely if
world.checkpoint_bytes says so, and the reverse pass recomputes the substeps in between, run by run, with the same dt
and the same windows.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physics3d.mpm.adjoint import Adjoint
from physics3d.mpm.body import RUN, make_body
from physics3d.mpm.checkpoints import Checkpoints
from physics3d.mpm.health import Work, health
from physics3d.mpm.implicit.newton import NotConverged
from physics3d.mpm.implicit.step import ImplicitSubsteps
from physics3d.mpm.limits import WORTH, explicit_limit, explicit_need, implicit_need, substeps_of_frame
from physics3d.mpm.problem import Problem
from physics3d.mpm.state import State
from physics3d.mpm.survey import Survey
from physics3d.mpm.window import window
from physics3d.trajectory import NotMoved

TRIES = 6  # of one frame, each with twice the substeps


@dataclass(frozen=True)
class Run:
    """Some substeps in a row under one window, as they were done; what the reverse pass replays."""

    lowest: tuple[int, ...]
    size: tuple[int, ...]
    clock: np.ndarray  # [substeps, k]
    node_velocity: Tensor | None = None  # the solution of an implicit step, likewise


class TooFast(Exception):
    """This frame needs shorter substeps, or a wider window; `why`, and what of the scene would spare them."""

    def __init__(self, why: str, remedy: str):
        super().__init__(why)
        self.remedy = remedy


class Frames:
    """The forward loop over frames and the reverse loop over runs."""

    def __init__(
        self, problem: Problem, coefficients: Tensor, q: Tensor, position: Tensor, selection: Tensor, *, keep: bool
    ):
        """Arguments as of `make_body`; `keep` what a gradient needs."""
        self.problem = problem
        self.body = make_body(problem, coefficients, q, position, selection)
        self.substeps = self.body.substeps
        self.arrays = self.substeps.arrays
        self.pushes: list[bool] = [b.acceleration(self.arrays.real) is not None for b in problem.boundaries]
        self.implicit: ImplicitSubsteps | None = None
        self.adjoint: Adjoint | None = None
        self.keep = keep
        self.now_implicit: bool = False  # once the scheme is implicit, it stays so
        self.no_implicit: bool = False  # the automatic scheme has tried it in vain
        self.behind: float = 0.0  # velocities lag by so much behind places [s]
        self.current: int = 0  # number of the state that the particles are in
        self.initial: Tensor | None = None  # state 0 before the first substep, flat
        self.runs: list[list[Run]] = []  # of each frame
        self.counts: list[int] = []  # substeps of each frame
        self.work: Work = Work()  # of the present frame
        self.health: dict[str, list[float]] = {}  # of each frame
        self.remedy: str = ""  # what would have spared the substeps of the present frame
        most = problem.world.checkpoint_bytes
        state_bytes = self.arrays.state(0).flat.nbytes
        self.checkpoints = Checkpoints(None if most is None else max(1, most // state_bytes))

    def forward(self, velocity: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Displacements, velocities [t, p, 3] and total deformations [t, p, 3, 3], from the initial velocity [p, 3] and
        its gradient [p, 3, 3]."""
        world, frames, n = self.problem.world, self.problem.frames, self.arrays.n
        self.begin(velocity, gradient)
        kind: dict[str, Any] = {"dtype": world.dtype, "device": self.problem.device}
        u, v = torch.empty((frames, n, 3), **kind), torch.empty((frames, n, 3), **kind)
        deformation = torch.empty((frames, n, 3, 3), **kind)
        eye = torch.eye(3, **kind)
        for frame in self.problem.log.progress(range(frames), "simulate"):
            self.work = Work()
            if frame:
                self.onward(frame)
            now = self.now
            u[frame], v[frame], deformation[frame] = now.u, self._velocity(frame), now.H + eye
            substeps = self.counts[-1] if self.counts else 0
            for name, value in health(self.body, now, self.work, substeps).items():
                self.health.setdefault(name, []).append(value)
        return u, v, deformation

    def begin(self, velocity: Tensor, gradient: Tensor) -> None:
        """Undeformed, with this velocity [p, 3] and its gradient [p, 3, 3]."""
        first = self.arrays.state(0)
        first.memory.copy_(self.problem.world.material.initial_memory(self.arrays.n, self.problem.world.dtype))
        first.v_gathered.copy_(velocity)
        first.L_gathered.copy_(gradient)
        self.initial = first.flat.clone() if self.keep else None
        self.substeps.start(self._clock(0.0, 0.0, 1, kick=0.0), 0, 0)

    def backward(self, adjoint_u: Tensor, adjoint_F: Tensor) -> tuple[Tensor, ...]:
        """Gradients of coefficients, q, velocity, its gradient, position, and selection."""
        arrays, substeps = self.arrays, self.substeps
        if self.adjoint is None:
            self.adjoint = Adjoint(substeps)
        adjoint = self.adjoint
        adjoint.clear()
        side = 0
        flat_runs = [run for runs in self.runs for run in runs]
        index = len(flat_runs)

        def replay(k: int) -> None:
            run = flat_runs[k]
            arrays.set_window(run.lowest, run.size)
            substeps.run(run.clock, [0] * (len(run.clock) + 1))

        for frame in range(self.problem.frames - 1, 0, -1):
            adjoint.states[side].u.add_(adjoint_u[frame])
            adjoint.states[side].H.add_(adjoint_F[frame])
            for run in reversed(self.runs[frame - 1]):
                index -= 1
                self.checkpoints.recall(index, arrays.state(0).flat, replay)
                arrays.set_window(run.lowest, run.size)
                if run.node_velocity is None:
                    side = adjoint.reverse(run.clock, range(len(run.clock) + 1), side)
                    continue
                assert self.implicit is not None
                try:
                    side = self.implicit.reverse(adjoint, run.clock, 0, 1, side, run.node_velocity)
                except NotConverged as reason:
                    raise NotMoved(f"frame {frame}, gradient: {reason}; take scheme='explicit'") from None
        adjoint.states[side].u.add_(adjoint_u[0])
        adjoint.states[side].H.add_(adjoint_F[0])
        assert self.initial is not None
        arrays.state(0).flat.copy_(self.initial)
        side = adjoint.reverse_start(self._clock(0.0, 0.0, 1, kick=0.0), 0, 1, side)
        return adjoint.gradients(adjoint.states[side])

    def _velocity(self, frame: int) -> Tensor:
        """Of the particles at the frame [p, 3]."""
        now = self.now
        if self.behind == 0:
            return now.v
        dt = 2 * self.behind
        lowest, size = window(self.problem.world, self.body.look(now), steps=1, dt=dt, reach=2.0, frame=frame)
        self.arrays.set_window(lowest, size)
        clock = self._clock(frame * self.problem.frame_dt, dt, 1, kick=self.behind)
        self.substeps.look(clock, self.current, 1 - self.current)
        return self.arrays.state(1 - self.current).v

    @property
    def now(self) -> State:
        """The particles at present, sorted by cell."""
        return self.arrays.state(self.current)

    def onward(self, frame: int) -> None:
        """From the frame before to this one, in equal substeps that obey the limit; more of them if it turns out too
        fast. Raises ValueError as `rollout` does."""
        world, frame_dt = self.problem.world, self.problem.frame_dt
        start, behind = self.now.flat.clone(), self.behind
        begun = sum(len(runs) for runs in self.runs)
        self._choose(frame)
        count, reach = self.count(frame), 2.0
        fixed = world.dt is not None
        tries = (1 if self.now_implicit else 3) if fixed else TRIES
        for tried in range(1, tries + 1):
            try:
                steps = self._implicit_runs if self.now_implicit else self._explicit_runs
                done = steps(frame, count, reach)
                if self.keep:
                    self.runs.append(done)
                self.counts.append(count)
                return
            except TooFast as reason:
                why, remedy = str(reason), reason.remedy
                self.now.flat.copy_(start)
                self.behind = behind
                self.checkpoints.forget(begun)
                self.work.rejected += 1
                reach = min(2 * reach, 8.0)
                if tried == tries or (not fixed and 2 * count > world.max_substeps):
                    break
                count *= 1 if fixed else 2
        if self.now_implicit and world.scheme == "auto":
            self.now_implicit, self.no_implicit = False, True
            self.problem.log.warn(f"frame {frame}: {why}; explicit from here on")
            return self.onward(frame)
        dt, t = frame_dt / count, (frame - 1) * frame_dt
        if fixed:
            remedy = f"world.dt < {dt / 2:g}, or {remedy}"
        raise NotMoved(f"frame {frame}: {why} with substeps of {dt:g} s, {tried} tries from {t:g} s on; take {remedy}")

    def _choose(self, frame: int) -> None:
        """Make the coming frame implicit if the world wants that, or lets us and it pays."""
        world, frame_dt = self.problem.world, self.problem.frame_dt
        if self.now_implicit or self.no_implicit or world.scheme == "explicit":
            return
        if world.scheme == "auto":
            if world.dt is not None:
                return
            now = self.now
            limit = explicit_limit(world, self.body.coefficients, now, self.body.look(now))
            explicit = explicit_need(world, limit, frame_dt)
            if explicit < WORTH * implicit_need(world, now, frame_dt):
                return
            self.problem.log.info(
                f"frame {frame}: implicit, for the explicit scheme would need {explicit} substeps a frame"
            )
        self.now_implicit = True
        self.implicit = ImplicitSubsteps(self.substeps, bounded=bool(self.body.hooks.node or self.body.hooks.grip))

    def count(self, frame: int) -> int:
        """Substeps of the coming frame. Raises ValueError as `substeps_of_frame` does."""
        world, now = self.problem.world, self.now
        limit = explicit_limit(world, self.body.coefficients, now, self.body.look(now))
        self.remedy = limit.remedy
        last = self.counts[-1] if self.counts else 0
        return substeps_of_frame(
            world, now, limit, self.problem.frame_dt, implicit=self.now_implicit, last=last, frame=frame
        )

    def _implicit_runs(self, frame: int, count: int, reach: float) -> list[Run]:
        """`count` implicit steps, each a run of its own. Their weights are those of the start: no room for motion."""
        assert self.implicit is not None
        dt = self.problem.frame_dt / count
        runs: list[Run] = []
        for done in range(count):
            now = self.now
            lowest, size = window(self.problem.world, self.body.look(now), steps=0, dt=dt, reach=0.0, frame=frame)
            self.arrays.set_window(lowest, size)
            clock = self._clock((frame - 1) * self.problem.frame_dt + done * dt, dt, 1, kick=self.behind + dt)
            self.behind = 0.0
            if self.keep:
                self._checkpoint(len(runs), now, needed=True)
            try:
                step = self.implicit.step(clock, self.current, 1 - self.current)
            except NotConverged as reason:
                raise TooFast(str(reason), "a weaker force, a slower start or scheme='explicit'") from None
            self.current = 1 - self.current
            self.work.newton += step.newton
            self.work.products += step.products
            runs.append(Run(lowest, size, clock, step.node_velocity if self.keep else None))
            self._inspect(frame, dt, 0)
        return runs

    def _explicit_runs(self, frame: int, count: int, reach: float) -> list[Run]:
        dt = self.problem.frame_dt / count
        runs: list[Run] = []
        done, now = 0, self.now
        seen = self.body.look(now)
        while done < count:
            # the limit follows the strain: look again before a particle has changed by a tenth, or snow that is packed
            # within a run bursts unseen
            steps = min(RUN, count - done, max(1, int(0.1 / max(1e-30, seen.rate * dt))))
            lowest, size = window(self.problem.world, seen, steps=steps, dt=dt, reach=reach, frame=frame)
            self.arrays.set_window(lowest, size)
            t = (frame - 1) * self.problem.frame_dt + done * dt
            clock = self._clock(t, dt, steps, kick=self.behind + dt / 2)
            self.behind = dt / 2
            if self.keep:
                self._checkpoint(len(runs), now)
            runs.append(Run(lowest, size, clock))
            lost = self.substeps.run(clock, [self.current] * (steps + 1))
            self.work.lost += lost
            seen = self._inspect(frame, dt, lost)
            done += steps
        return runs

    def _checkpoint(self, done: int, now: State, *, needed: bool = False) -> None:
        """Before the run after `done` others of this frame. Implicit steps are few and not replayed: `needed`, and so
        is what they lead to."""
        if not done and self.runs and self.runs[-1][-1].node_velocity is not None:
            needed = True
        self.checkpoints.offer(sum(len(runs) for runs in self.runs) + done, now.flat, needed=needed)

    def _inspect(self, frame: int, dt: float, lost: int) -> Survey:
        """After a run: is every number finite, every particle in the region, and every substep short enough?"""
        world, now = self.problem.world, self.now
        seen = self.body.look(now)
        if seen.infinite:
            bad = ~torch.isfinite(now.u.sum(1) + now.v.square().sum(1) + now.tau.square().sum((1, 2)))
            raise TooFast(
                f"{seen.infinite} of {len(bad)} particles have become infinite or NaN, first {self._who(bad)}",
                self.remedy,
            )
        if lost:
            raise TooFast(
                f"particles moved too far in a few substeps ({lost} times outside the grid)",
                "a weaker force or a slower start",
            )
        limit = explicit_limit(world, self.body.coefficients, now, seen)
        if self.now_implicit and dt * seen.speed > world.dx:
            way, speed = dt * seen.speed / world.dx, now.v.norm(dim=1)
            who = self._who(speed == speed.max())
            raise TooFast(f"{who} moves {way:.3g} cells in a step", "a weaker force or a slower start")
        if not self.now_implicit and dt > limit.dt:
            raise TooFast(limit.why, limit.remedy)
        if seen.outside:
            raise NotMoved(
                f"frame {frame}: {seen.outside} of {len(now.u)} particles left the simulated region "
                f"{self.problem.corners()}; enlarge world.lower and world.upper, or add a BoundingBox or a HalfSpace"
            )
        return seen

    def _clock(self, t: float, dt: float, steps: int, *, kick: float) -> np.ndarray:
        """Table for the kernels, from time t [s] on; `kick` of the first substep, those after it have dt, from where
        velocities are at the moment.

        Forces from outside are asked for the time of the kick, all else for that of the substep."""
        rows = []
        for s in range(steps):
            begin, long = t - self.behind, kick
            if s:
                begin, long = begin + kick + (s - 1) * dt, dt
            signals = [
                x
                for boundary, pushes in zip(self.problem.boundaries, self.pushes)
                for x in (boundary.signals(begin, long) if pushes else boundary.signals(t + s * dt, dt))
            ]
            rows.append([dt, math.exp(-self.problem.world.damping * long), long, *signals])
        return np.array(rows)

    def _who(self, chosen: Tensor) -> str:
        """The first particle of a mask [p]: its number as the caller counts, and where it is or was at rest."""
        p = int(chosen.nonzero()[0])
        rest = self.body.rest[p]
        x = rest + self.now.u[p]
        what, x = ("at", x) if bool(torch.isfinite(x).all()) else ("at rest at", rest)
        place = ", ".join(f"{value:.4g}" for value in x.tolist())
        return f"particle {int(self.problem.order[p])} {what} ({place}) m"
