"""One substep of MLS-MPM, symplectic Euler, and its exact adjoint.

    push     v_p += dt a_p                                        forces from outside (only if a boundary has some)
    scatter  particles -> momentum and mass of nodes
    mark     the nodes of particles that touch a boundary         (only if a boundary acts on those alone)
    update   v_i = e^(-c dt) (p_i/m_i + dt g), then the boundaries
    gather   nodes -> v_p, L_p
    steer    imposed motion of particles                          (only if a boundary has some)
    advance  u_p += dt v_p; the material turns (L_p, H_p) into the next H_p and the stress for the next scatter

Every array of a state is written once per substep and nothing is updated in place, so the adjoints of the kernels are
launched in reverse order on adjoint arrays that add up. Those of the transfers are written out, the others generated.

On a CPU the particles' part is one pass (`fused`) together with the scatter of the next substep; the kernels here are
its twins, what CUDA runs, and what the adjoint is of. A Warp kernel runs on one thread there, so the particles are
divided over Python threads (a launch releases the GIL); each scatters into a grid of its own, and the grids are summed
in a fixed order: reruns are equal bit by bit. On CUDA there is one worker and the scatter is atomic.
"""

import threading
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
import warp as wp

from physics3d.mpm import grids, transfer
from physics3d.mpm.advance import advance
from physics3d.mpm.fused import particle_pass
from physics3d.mpm.hooks import Hook
from physics3d.mpm.mark import mark
from physics3d.mpm.push import push
from physics3d.mpm.state import State, make_state
from physics3d.mpm.steer import steer
from physics3d.mpm.update import update
from physics3d.warp_types import vector, vector4

_KEEP_MOMENTA = 4  # nodes per particle up to which the momenta of nodes are kept for the way back
_KEEP = 5  # place of `keep`, then `onward`, among the arguments of the particle pass
_MULTIPLY_ADD = "-ffp-contract=fast"  # one rounding for a b + c where the processor can, on the CPU as on CUDA


def start_warp() -> None:
    """Start Warp without its banner; before anything else of Warp is touched."""
    wp.config.log_level = wp.LOG_WARNING
    flags = wp.config.cpu_compiler_flags or ""
    if _MULTIPLY_ADD not in flags:
        wp.config.cpu_compiler_flags = f"{flags} {_MULTIPLY_ADD}".strip()
    wp.init()


class Substeps:
    """All arrays and recorded launches of one rollout; runs substeps forwards and backwards between numbered states.

    Everything is sized once; only the grid grows when the particles spread out. `clock` is a table with one row per
    substep of a run: dt, exp(-damping dt), then the signals of the boundaries.
    """

    def __init__(
        self,
        *,
        dx: float,
        origin: Sequence[float],
        gravity: Sequence[float],
        mass: torch.Tensor,  # [p] kg
        volume: torch.Tensor,  # [p] m^3
        rest: torch.Tensor,  # [p, 3] m
        cell: torch.Tensor,  # [p, 3] int32
        offset: torch.Tensor,  # [p, 3] cells
        coefficients: torch.Tensor,  # [k, p]
        q: torch.Tensor,  # [parameters of boundaries]
        selection: torch.Tensor,  # [boundary, p]
        signals: int,  # columns of the clock
        pushes: tuple[Hook, ...],
        nodes: tuple[Hook, ...],
        touches: tuple[Hook, ...],  # of the boundaries whose nodes' hook acts on touched nodes alone
        steers: tuple[Hook, ...],
        walls: Sequence[int] | None,  # [12] of `_mirror`; None: no wall mirrors
        material: wp.Function,
        memory_rows: int,
        longest_run: int,  # substeps
        threads: int,
        fast: bool | None = None,  # one pass over the particles per substep; None: on a CPU
    ):
        self.dtype, self.device = mass.dtype, mass.device
        self.real = wp.float32 if self.dtype == torch.float32 else wp.float64
        self.n, self.dx = len(mass), dx
        self.origin = vector(self.real)(*origin)
        self.gravity = vector(self.real)(*gravity)
        self.mass_floor = 1e-12 * float(mass.mean())
        self.fast = self.device.type == "cpu" if fast is None else fast
        self.kernels = {
            "scatter": transfer.scatter(self.real, self.fast),
            "update": update(self.real, nodes, touches, walls is not None),
            "gather": transfer.gather(self.real, self.fast),
            "advance": advance(self.real, material),
        }
        if self.fast:
            self.kernels["pass"] = particle_pass(self.real, material, pushes, steers)
        if touches:
            self.kernels["mark"] = mark(self.real, touches)
        if pushes:
            self.kernels["push"] = push(self.real, pushes)
        if steers:
            self.kernels["steer"] = steer(self.real, steers)
        self.shape = dict(memory_rows=memory_rows, steered=bool(steers))
        vec3, real = vector(self.real), self.real
        self.constant = {
            "mass": wp.from_torch(mass),
            "volume": wp.from_torch(volume),
            "cell": wp.from_torch(cell, dtype=wp.vec3i),
            "rest": wp.from_torch(rest, dtype=vec3),
            "offset": wp.from_torch(offset, dtype=vec3),
            "q": wp.from_torch(q) if len(q) else self._zeros(1, real),
            "selection": wp.from_torch(selection) if len(selection) else self._zeros((1, self.n), real),
            "coefficients": wp.from_torch(coefficients),
            "radius": wp.from_torch(0.5 * volume ** (1 / 3)),
        }
        self.touch_count = len(touches)
        self.mirrored = walls is not None
        self.walls = self._zeros(12, wp.int32)
        if walls is not None:
            self.walls.assign(np.array(walls, np.int32))
        self.parameter_count, self.row_count = len(q), len(coefficients)
        self.v_pushed = self._zeros(self.n, vec3) if pushes else None
        self.clock = self._zeros((longest_run, 2 + signals), real)
        self.window = self._zeros(6, wp.int32)
        self.workers = max(1, threads) if self.device.type == "cpu" else 1
        edges = np.linspace(0, self.n, self.workers + 1).astype(int)
        self.ranges = [(int(a), int(b - a)) for a, b in pairwise(edges)]
        self.row = [self._zeros(1, wp.int32) for _ in self.ranges]
        self.row_numpy = [row.numpy() for row in self.row] if self.device.type == "cpu" else []
        self.stamp = [self._zeros(1, wp.int32) for _ in self.ranges]
        self.stamp_numpy = [stamp.numpy() for stamp in self.stamp] if self.device.type == "cpu" else []
        self.last_stamp = [0 for _ in self.ranges]
        self.lost = [self._zeros(1, wp.int32) for _ in self.ranges]
        self.states: list[State] = []
        self.adjoint: dict | None = None
        self.kept_momenta: wp.array | None = None
        self.kept_path: tuple[int, ...] = ()  # of the run whose momenta they are
        self.capacity = 0
        self.set_window((0, 0, 0), (1, 1, 1))

    def state(self, i: int) -> State:
        """State number i, made when first asked for."""
        while len(self.states) <= i:
            self.states.append(make_state(self.n, dtype=self.dtype, device=self.device, **self.shape))
        return self.states[i]

    def set_window(self, lowest: Sequence[int], size: Sequence[int]) -> None:
        """Lay the grid over nodes lowest .. lowest + size - 1."""
        self.window.assign(np.array([*lowest, *size], np.int32))
        self.node_count = int(np.prod(size))
        self.kept_path = ()
        if self.node_count > self.capacity:
            self.capacity = int(1.5 * self.node_count) + 1  # one more: see `columns`
            self.grid = self._zeros((self.workers, self.capacity), vector4(self.real))
            self.node_velocity = self._zeros(self.capacity, vector(self.real))
            self.touched = self._zeros((self.touch_count, self.capacity) if self.touch_count else (1, 1), wp.int32)
            if self.adjoint is not None:
                self._make_adjoint_grid()
            self._drop_launches()

    def run(self, clock: np.ndarray, path: Sequence[int]) -> int:
        """Substep s takes state path[s] to state path[s + 1] by row s of the clock; the count of lost particles.

        A path may stay at one state: in place. Velocities and stress on the way are then not kept. A path that never
        comes back to a state leaves what `reverse` needs."""
        self._set_clock(clock)
        for lost in self.lost:
            lost.zero_()
        work = list(pairwise(path))
        launches = [[self._forward(w, i, j) for i, j in work] for w in range(self.workers)]
        dims = self._dims()

        def plain(w: int, wait: Callable[[], object]) -> None:
            for s, launch in enumerate(launches[w]):
                self._set_row(w, s)
                self._scatter_phase(launch)
                self._mark_phase(w, launch)
                wait()
                self._update_phase(launch, *dims[w], wait)
                wait()
                for name in ("gather", "steer", "advance"):
                    if name in launch:
                        launch[name].launch()

        momenta = self._momenta()
        keep = momenta is not None and len(set(path)) == len(path)
        self.kept_path = tuple(path) if keep else ()

        def fast(w: int, wait: Callable[[], object]) -> None:
            last = len(work) - 1
            self._set_row(w, 0)
            self._scatter_phase(launches[w][0])
            for s, launch in enumerate(launches[w]):
                self._set_row(w, s)
                self._mark_phase(w, launch)
                wait()
                self._update_phase(launch, *dims[w], wait, momenta[s] if keep else None)
                wait()
                if s < last:
                    self._span(launch["clear"], 0, self.node_count)
                launch["pass"].set_param_at_index(_KEEP, int(s == last or work[s][0] != work[s][1]))
                launch["pass"].set_param_at_index(_KEEP + 1, int(s < last))
                launch["pass"].launch()

        self._on_all(fast if self.fast else plain)
        return sum(int(lost.numpy()[0]) for lost in self.lost)

    def start(self, clock: np.ndarray, i: int, j: int) -> None:
        """State j = state i with its stress, and with imposed motion: a substep of no length, without the grid."""
        self._set_clock(clock)
        for w in range(self.workers):
            self._set_row(w, 0)
            launch = self._forward(w, i, j)
            a, b = self.state(i), self.state(j)
            part = slice(self.ranges[w][0], sum(self.ranges[w]))
            b.v_gathered[part], b.L_gathered[part] = a.v_gathered[part], a.L_gathered[part]
            for name in ("steer", "advance"):
                if name in launch:
                    launch[name].launch()

    # ------------------------------------------------------------------------------------------------ adjoint

    def begin_adjoint(self) -> None:
        """Make the adjoint arrays, all zero."""
        if self.adjoint is None:
            vec3 = vector(self.real)
            self.adjoint = {
                "states": [make_state(self.n, dtype=self.dtype, device=self.device, **self.shape) for _ in range(2)],
                "v_pushed": self._zeros(self.n, vec3) if self.v_pushed is not None else None,
                "coefficients": self._zeros((self.row_count, self.n), self.real),
                "offset": self._zeros(self.n, vec3),
                "rest": self._zeros(self.n, vec3),
                "q": [self._zeros(max(1, self.parameter_count), self.real) for _ in self.ranges],
            }
            self._make_adjoint_grid()
        for name in ("coefficients", "offset", "rest"):
            self.adjoint[name].zero_()
        for array in self.adjoint["q"]:
            array.zero_()
        for state in self.adjoint["states"]:
            state.flat.zero_()

    def reverse(self, clock: np.ndarray, path: Sequence[int], side: int) -> int:
        """Carry the adjoint of state path[-1], in adjoint set `side`, back to state path[0]; which set holds it then.

        The states along the path must hold what `run` put there, under the same window and clock."""
        self._set_clock(clock)
        assert self.adjoint is not None
        adjoint_states = self.adjoint["states"]
        steps = list(enumerate(pairwise(path)))[::-1]
        sides = [(side + s) % 2 for s in range(len(steps))]
        forward = [[self._forward(w, i, j) for _, (i, j) in steps] for w in range(self.workers)]
        backward = [
            [self._backward(w, i, j, side) for (_, (i, j)), side in zip(steps, sides)] for w in range(self.workers)
        ]
        dims, momenta = self._dims(), self._momenta() if self.kept_path == tuple(path) else None

        def worker(w: int, wait: Callable[[], object]) -> None:
            for (s, _), launch, adjoint, now in zip(steps, forward[w], backward[w], sides):
                self._set_row(w, s)
                if w == 0:
                    adjoint_states[1 - now].flat.zero_()
                if "clear_pushed" in adjoint:
                    adjoint["clear_pushed"].launch()
                if momenta is None:
                    self._scatter_phase(launch)
                elif "push" in launch:
                    launch["push"].launch()
                self._mark_phase(w, launch)
                self._span(adjoint["clear_private"], 0, self.node_count)
                wait()
                if momenta is None:
                    self._update_phase(launch, *dims[w], wait)
                else:
                    self._update_again(launch, *dims[w], wait, momenta[s])
                wait()
                for name in ("advance", "steer", "gather"):
                    if name in adjoint:
                        adjoint[name].launch()
                wait()
                first, count = dims[w]
                if count and "total" in adjoint:
                    self._span(adjoint["total"], first, count)
                if self.mirrored:
                    wait()
                    # the adjoint adds to nodes of other workers: the first one does them all
                    first, count = (0, self.node_count) if w == 0 else (0, 0)
                if count:
                    self._span(adjoint["clear_grid"], first, count)
                    self._span(adjoint["update"], first, count)
                wait()
                for name in ("scatter", "push"):
                    if name in adjoint:
                        adjoint[name].launch()

        self._on_all(worker)
        return (side + len(steps)) % 2

    def reverse_start(self, clock: np.ndarray, i: int, j: int, side: int) -> int:
        """The adjoint of `start`; the set that holds the adjoint of state i."""
        self._set_clock(clock)
        assert self.adjoint is not None
        now, then = self.adjoint["states"][side], self.adjoint["states"][1 - side]
        then.flat.zero_()
        for w in range(self.workers):
            self._set_row(w, 0)
            launch = self._backward(w, i, j, side)
            for name in ("advance", "steer"):
                if name in launch:
                    launch[name].launch()
        then.v_gathered.add_(now.v_gathered)
        then.L_gathered.add_(now.L_gathered)
        return 1 - side

    def gradients(self, first: State) -> tuple[torch.Tensor, ...]:
        """Gradients of coefficients [k, p], q, initial velocity [p, 3], its gradient [p, 3, 3], and rest position
        [p, 3], from the adjoint of the first state (copies)."""
        assert self.adjoint is not None
        q = torch.stack([wp.to_torch(array) for array in self.adjoint["q"]]).sum(0)[: self.parameter_count]
        place = wp.to_torch(self.adjoint["rest"]) + wp.to_torch(self.adjoint["offset"]) / self.dx
        coefficients = wp.to_torch(self.adjoint["coefficients"]).clone()
        return coefficients, q, first.v_gathered.clone(), first.L_gathered.clone(), place.double()

    # ------------------------------------------------------------------------------------------------ launches

    def _arguments(self, w: int, i: int, j: int) -> dict[str, tuple[list, list]]:
        """Inputs and outputs of every kernel of the substep from state i to state j, worker w."""
        a, b, c = self.state(i).warp, self.state(j).warp, self.constant
        first = self.ranges[w][0]
        v = a["v"] if self.v_pushed is None else self.v_pushed
        clock = [self.clock, self.row[w]]
        hooked = [first, *clock, c["selection"], c["rest"], c["q"], a["u"]]
        place = [c["cell"], c["offset"], a["u"]]
        onto = [self.walls, self.stamp[w], self.touched, c["q"], self.grid[0]]
        return {
            "push": ([*hooked, a["v"]], [self.v_pushed]),
            "mark": (
                [first, self.dx, self.window, *clock, self.stamp[w], c["rest"], c["radius"], c["cell"], c["offset"],
                 c["q"], a["u"]],
                [self.touched],
            ),
            "scatter": (
                [first, self.dx, self.window, *clock, c["mass"], c["volume"], *place, v, a["L"], a["tau"]],
                [self.grid[w], self.lost[w]],
            ),
            "update": (
                [0, self.dx, self.origin, self.gravity, self.mass_floor, self.window, *clock, *onto],
                [self.node_velocity],
            ),
            "gather": ([first, self.dx, self.window, *place, self.node_velocity], [b["v_gathered"], b["L_gathered"]]),
            "steer": ([*hooked, b["v_gathered"], b["L_gathered"]], [b["v"], b["L"]]),
            "advance": (
                [first, *clock, a["u"], b["v"], b["L"], a["H"], c["coefficients"], a["memory"]],
                [b["u"], b["H"], b["memory"], b["tau"]],
            ),
            "pass": (
                [first, self.dx, self.window, *clock, 1, 1, c["selection"], c["rest"], c["q"], c["mass"], c["volume"],
                 c["cell"], c["offset"], c["coefficients"], self.node_velocity, a["u"], a["H"], a["memory"]],
                [*(b[name] for name in ("u", "H", "memory", "v_gathered", "L_gathered", "v", "L", "tau")),
                 self.grid[w], self.lost[w]],
            ),
        }  # fmt: skip

    def _forward(self, w: int, i: int, j: int) -> dict[str, wp.Launch]:
        key = ("forward", w, i, j)
        if key not in self.launches:
            count = self.ranges[w][1]
            record = {}
            for name, (inputs, outputs) in self._arguments(w, i, j).items():
                if name in self.kernels:
                    record[name] = self._record(self.kernels[name], count, inputs, outputs)
            record["clear"] = self._record(grids.clear(vector4(self.real)), 1, [0], [self.grid[w]])
            record["total"] = self._record(grids.total(vector4(self.real)), 1, [0], [self.grid])
            self.launches[key] = record
        return self.launches[key]

    def _backward(self, w: int, i: int, j: int, side: int) -> dict[str, wp.Launch]:
        key = ("backward", w, i, j, side)
        if key not in self.launches:
            assert self.adjoint is not None
            adjoint = self.adjoint
            b, a = adjoint["states"][side].warp, adjoint["states"][1 - side].warp
            place = [adjoint["offset"], a["u"]]
            v = a["v"] if self.v_pushed is None else adjoint["v_pushed"]
            q = adjoint["q"][w]
            hooked = [None, None, None, None, adjoint["rest"], q, a["u"]]
            adjoints = {
                "push": ([*hooked, a["v"]], [adjoint["v_pushed"]]),
                "update": ([*[None] * 11, q, self.adjoint_grid], [self.adjoint_node_velocity[0]]),
                "steer": ([*hooked, b["v_gathered"], b["L_gathered"]], [b["v"], b["L"]]),
                "advance": (
                    [None] * 3 + [a["u"], b["v"], b["L"], a["H"], adjoint["coefficients"], a["memory"]],
                    [b["u"], b["H"], b["memory"], b["tau"]],
                ),
            }
            count = self.ranges[w][1]
            record = {}
            arguments = self._arguments(w, i, j)
            vec3, vec4 = vector(self.real), vector4(self.real)
            private = self.adjoint_fours if self.fast else self.adjoint_node_velocity
            for name, adjoint_arrays in adjoints.items():
                if name in self.kernels:
                    record[name] = self._record(self.kernels[name], count, *arguments[name], adjoint_arrays)
            record["scatter"] = self._record(
                transfer.scatter_adjoint(self.real, self.fast),
                count,
                [*arguments["scatter"][0], self.adjoint_grid],
                [*place, v, a["L"], a["tau"]],
            )
            record["gather"] = self._record(
                transfer.gather_adjoint(self.real, self.fast),
                count,
                [*arguments["gather"][0], b["v_gathered"], b["L_gathered"]],
                [*place, private[w]],
            )
            if self.fast:
                outputs = [self.adjoint_node_velocity[0]]
                record["total"] = self._record(grids.total_of_fours(self.real), 1, [0, private], outputs)
            elif self.workers > 1:
                record["total"] = self._record(grids.total(vec3), 1, [0], [private])
            record["clear_private"] = self._record(grids.clear(vec4 if self.fast else vec3), 1, [0], [private[w]])
            if self.v_pushed is not None:
                first = [self.ranges[w][0]]
                record["clear_pushed"] = self._record(grids.clear(vec3), count, first, [adjoint["v_pushed"]])
            record["clear_grid"] = self._record(grids.clear(vec4), 1, [0], [self.adjoint_grid])
            self.launches[key] = record
        return self.launches[key]

    def _record(self, kernel, count: int, inputs: list, outputs: list, adjoint: tuple | None = None) -> wp.Launch:
        adj_inputs, adj_outputs = adjoint or ([], [])
        return wp.launch(
            kernel,
            count,
            inputs=inputs,
            outputs=outputs,
            adj_inputs=adj_inputs,
            adj_outputs=adj_outputs,
            adjoint=adjoint is not None,
            device=str(self.device),
            record_cmd=True,
        )

    def _scatter_phase(self, launch: dict[str, wp.Launch]) -> None:
        if "push" in launch:
            launch["push"].launch()
        self._span(launch["clear"], 0, self.node_count)
        launch["scatter"].launch()

    def _mark_phase(self, w: int, launch: dict[str, wp.Launch]) -> None:
        """Stamp what the particles touch at the start of the substep; after all have read the last stamps."""
        if "mark" in launch:
            self._new_stamp(w)
            launch["mark"].launch()

    def _update_phase(
        self,
        launch: dict[str, wp.Launch],
        first: int,
        count: int,
        wait: Callable[[], object],
        momenta: np.ndarray | None = None,  # [node, 4] gets what the nodes hold before the update
    ) -> None:
        if count and self.workers > 1:
            self._span(launch["total"], first, count)
        if momenta is not None:
            momenta[first : first + count] = self._total_momenta[first : first + count]
        if self.mirrored:
            wait()  # nodes read those of other workers
        if count:
            self._span(launch["update"], first, count)

    def _update_again(
        self, launch: dict[str, wp.Launch], first: int, count: int, wait: Callable[[], object], momenta: np.ndarray
    ) -> None:
        """As `_update_phase` left the nodes, from the momenta that it kept."""
        self._total_momenta[first : first + count] = momenta[first : first + count]
        if self.mirrored:
            wait()
        if count:
            self._span(launch["update"], first, count)

    def _span(self, launch: wp.Launch, first: int, count: int) -> None:
        """Launch over `count` nodes from `first` on (the first argument of every such kernel)."""
        if launch.bounds.size != count:
            launch.set_dim(count)
        launch.set_param_at_index(0, first)
        launch.launch()

    def _dims(self) -> list[tuple[int, int]]:
        edges = np.linspace(0, self.node_count, self.workers + 1).astype(int)
        return [(int(a), int(b - a)) for a, b in pairwise(edges)]

    def _on_all(self, worker: Callable[[int, Callable[[], object]], None]) -> None:
        """worker(w, wait) on every thread; an exception in one ends all and is raised here."""
        if self.workers == 1:
            worker(0, lambda: None)
            return
        barrier = threading.Barrier(self.workers)
        errors: list[BaseException] = []

        def guarded(w: int) -> None:
            try:
                worker(w, barrier.wait)
            except threading.BrokenBarrierError:
                pass
            except BaseException as error:
                errors.append(error)
                barrier.abort()

        others = [threading.Thread(target=guarded, args=(w,)) for w in range(1, self.workers)]
        for thread in others:
            thread.start()
        guarded(0)
        for thread in others:
            thread.join()
        if errors:
            raise errors[0]

    # ------------------------------------------------------------------------------------------------ arrays

    def _zeros(self, shape, dtype) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=str(self.device))

    def _make_adjoint_grid(self) -> None:
        self.kept_momenta = None
        self.adjoint_grid = self._zeros(self.capacity, vector4(self.real))
        self.adjoint_node_velocity = self._zeros((self.workers, self.capacity), vector(self.real))
        if self.fast:
            if self.capacity < _KEEP_MOMENTA * self.n:
                shape = (len(self.clock), self.capacity)
                self.kept_momenta = self._zeros(shape, vector4(self.real))
            self.adjoint_fours = self._zeros((self.workers, self.capacity), vector4(self.real))

    def _momenta(self) -> np.ndarray | None:
        """[substep of a run, node, 4] kept for `reverse`, once there is an adjoint and unless nodes are far more than
        particles; then `reverse` scatters again."""
        if self.adjoint is None or self.kept_momenta is None:
            return None
        self._total_momenta = self.grid.numpy()[0]
        return self.kept_momenta.numpy()

    def _drop_launches(self) -> None:
        self.launches: dict[tuple, dict[str, wp.Launch]] = {}

    def _set_clock(self, clock: np.ndarray) -> None:
        table = np.zeros(self.clock.shape)
        table[: len(clock)] = clock
        self.clock.assign(table)

    def _new_stamp(self, w: int) -> None:
        """The same on every thread, for all take the same steps."""
        self.last_stamp[w] += 1
        if self.device.type == "cpu":
            self.stamp_numpy[w][0] = self.last_stamp[w]
        else:
            self.stamp[w].fill_(self.last_stamp[w])

    def _set_row(self, w: int, s: int) -> None:
        if self.device.type == "cpu":
            self.row_numpy[w][0] = s
        else:
            self.row[w].fill_(s)
