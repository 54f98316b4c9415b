"""Substeps of MLS-MPM, symplectic Euler, one after another between numbered states.

    hold     what is gripped of a particle has no part in the rest   (only if a boundary grips some)
    push     v_p += dt a_p                                        forces from outside (only if a boundary has some)
    scatter  particles -> momentum and mass of nodes, after the kick of the internal forces
    mark     the nodes of particles that touch a boundary         (only if a boundary acts on those alone)
    face     how far nodes are from what is gripped, then lead: which node they follow       (likewise)
    update   v_i = e^(-c kick) (p_i/m_i + kick g), then the boundaries
    gather   nodes -> v_p, L_p
    steer    imposed motion of particles                          (only if a boundary grips some)
    advance  u_p += dt v_p; the material turns (L_p, H_p) into the next H_p and the stress for the next scatter

Velocities live half a substep before places (leapfrog): forces act over `kick`, which is half a substep in the first
one and (dt_before + dt)/2 later. Places are of second order that way, and velocities at a frame are, after half a kick
more (`look`). An implicit step has kick = dt.

Each is a kernel in a file of its name (scatter and gather are in `transfer`). Every array of a state is written once
per substep and nothing is updated in place, so the adjoints of the kernels can be launched in reverse order
(`adjoint`).

On a CPU the particles' part is one pass (`fused`) together with the scatter of the next substep; the separate kernels
are its twins, what CUDA runs, and what the adjoint is of. The particles are divided over threads there; each scatters
into a grid of its own, and the grids are summed in a fixed order: reruns are equal bit by bit. On CUDA there is one
worker, the scatter is atomic, and a run of substeps is one graph (`graphs`).
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import warp as wp

from physics3d.mpm import grids, transfer
from physics3d.mpm.advance import advance
from physics3d.mpm.arrays import Arrays
from physics3d.mpm.fused import particle_pass
from physics3d.mpm.graphs import Graphs
from physics3d.mpm.hold import face, hold, lead
from physics3d.mpm.hooks import Hooks
from physics3d.mpm.launches import Arguments, launch_over, record
from physics3d.mpm.mark import mark
from physics3d.mpm.push import push
from physics3d.mpm.steer import steer
from physics3d.mpm.threads import Wait, shares
from physics3d.mpm.update import update
from physics3d.warp_types import vector4

Launches = dict[str, wp.Launch]  # by the name of the kernel in the table above


class Substeps:
    """The kernels of a scene and their recorded launches."""

    def __init__(self, arrays: Arrays, hooks: Hooks, material: wp.Function):
        self.arrays = arrays
        real, fast = arrays.real, arrays.fast
        self.kernels: dict[str, wp.Kernel] = {
            "scatter": transfer.scatter(real, arrays.sums_real, fast),
            "update": update(real, hooks.node, hooks.touch, hooks.grip, arrays.mirrored),
            "gather": transfer.gather(real, fast),
            "advance": advance(real, material),
        }
        if fast:
            self.kernels["pass"] = particle_pass(real, material, hooks.push, hooks.grip, hooks.steer)
        if hooks.touch:
            self.kernels["mark"] = mark(real, hooks.touch)
        if hooks.push:
            self.kernels["push"] = push(real, hooks.push)
        if hooks.grip:
            self.kernels["hold"] = hold(real, hooks.grip)
            self.kernels["face"] = face(real, hooks.grip, hooks.steer, hooks.ahead)
            self.kernels["lead"] = lead(real)
            self.kernels["steer"] = steer(real, hooks.grip, hooks.steer)
        self._launches: dict[tuple[int, int, int], Launches] = {}  # of worker w, from state i to state j
        self.graphs = Graphs(arrays.device)  # of runs
        self._capacity: int = arrays.capacity  # of the grid that they are for

    def run(self, clock: np.ndarray, path: Sequence[int], momenta: np.ndarray | None = None) -> int:
        """Substep s takes state path[s] to state path[s + 1] by row s of the clock; the count of lost particles.

        A path may stay at one state: in place. Velocities and stress on the way are then not kept. A path that never
        comes back to a state leaves what its adjoint needs. `momenta` [substep, node, 4] gets what the nodes hold
        before each update, if the particles go in one pass."""
        arrays = self.arrays
        arrays.set_clock(clock)
        for lost in arrays.lost:
            lost.zero_()
        steps = list(pairwise(path))
        launches = [[self.launches(w, i, j) for i, j in steps] for w in range(arrays.workers)]
        nodes = shares(arrays.node_count, arrays.workers)

        def plain(w: int, wait: Wait) -> None:
            for s, launch in enumerate(launches[w]):
                arrays.set_row(w, s)
                self.hold(launch)
                self.scatter(launch)
                self.mark(w, launch)
                wait()
                self.update(launch, *nodes[w], wait)
                wait()
                for name in ("gather", "steer", "advance"):
                    if name in launch:
                        launch[name].launch()

        def fast(w: int, wait: Wait) -> None:
            last = len(steps) - 1
            arrays.set_row(w, 0)
            self.hold(launches[w][0])
            self.scatter(launches[w][0])
            for s, launch in enumerate(launches[w]):
                arrays.set_row(w, s)
                if s:
                    self.hold(launch)
                self.mark(w, launch)
                wait()
                self.update(launch, *nodes[w], wait, None if momenta is None else momenta[s])
                wait()
                launch["pass"].set_param_by_name("keep", int(s == last or steps[s][0] != steps[s][1]))
                launch["pass"].set_param_by_name("onward", int(s < last))
                launch["pass"].launch()

        work = fast if arrays.fast else plain
        if arrays.recorded and momenta is None:
            self.graphs.run((tuple(path), arrays.node_count), lambda: work(0, lambda: None))
        else:
            arrays.team.run(work)
        return sum(int(lost.numpy()[0]) for lost in arrays.lost)

    def look(self, clock: np.ndarray, i: int, j: int) -> None:
        """Velocity of state j = that of state i after a kick, and nothing else: no place changes. State j is spoilt."""
        arrays = self.arrays
        arrays.set_clock(clock)
        launches = [self.launches(w, i, j) for w in range(arrays.workers)]
        nodes = shares(arrays.node_count, arrays.workers)

        def worker(w: int, wait: Wait) -> None:
            launch = launches[w]
            arrays.set_row(w, 0)
            self.hold(launch)
            self.scatter(launch)
            self.mark(w, launch)
            wait()
            self.update(launch, *nodes[w], wait)
            wait()
            for name in ("gather", "steer"):
                if name in launch:
                    launch[name].launch()

        arrays.team.run(worker)

    def start(self, clock: np.ndarray, i: int, j: int) -> None:
        """State j = state i with its stress, and with imposed motion: a substep of no length, without the grid."""
        arrays = self.arrays
        arrays.set_clock(clock)
        for w, (first, count) in enumerate(arrays.ranges):
            arrays.set_row(w, 0)
            launch = self.launches(w, i, j)
            a, b = arrays.state(i), arrays.state(j)
            part = slice(first, first + count)
            b.v_gathered[part], b.L_gathered[part] = a.v_gathered[part], a.L_gathered[part]
            for name in ("steer", "advance"):
                if name in launch:
                    launch[name].launch()

    # ------------------------------------------------------------------------------------------------ phases

    def scatter(self, launch: Launches) -> None:
        """Particles of a worker onto its grid."""
        if "push" in launch:
            launch["push"].launch()
        launch_over(launch["clear"], 0, self.arrays.node_count)
        launch["scatter"].launch()

    def hold(self, launch: Launches) -> None:
        """What is gripped of the particles of a worker, before they are scattered."""
        if "hold" in launch:
            launch_over(launch["clear_gripped"], 0, self.arrays.grips * self.arrays.node_count)
            launch["hold"].launch()

    def mark(self, w: int, launch: Launches) -> None:
        """Stamp what the particles touch at the start of the substep; after all have read the last stamps."""
        if "mark" in launch:
            self.arrays.new_stamp(w)
            launch["mark"].launch()

    def update(
        self,
        launch: Launches,
        first: int,
        count: int,
        wait: Wait,
        momenta: np.ndarray | None = None,  # [node, 4] gets what the nodes hold before the update
    ) -> None:
        """Velocities of the `count` nodes from `first` on, from the grids of all workers."""
        if count:
            launch_over(launch["total"], first, count)
        if momenta is not None:
            momenta[first : first + count] = self.arrays.grid.numpy()[first : first + count]
        self._update(launch, first, count, wait)

    def update_again(self, launch: Launches, first: int, count: int, wait: Wait, momenta: np.ndarray) -> None:
        """As `update` left the nodes, from the momenta that it kept."""
        self.arrays.grid.numpy()[first : first + count] = momenta[first : first + count]
        self._update(launch, first, count, wait)

    def _update(self, launch: Launches, first: int, count: int, wait: Wait) -> None:
        grips = self.arrays.grips
        if grips and self.arrays.workers > 1:
            if count:
                launch_over(launch["total_gripped"], grips * first, grips * count)
            wait()
        for name in ("face", "lead"):
            if name in launch:
                if count:
                    launch_over(launch[name], first, count)
                wait()
        if self.arrays.coupled:
            wait()  # nodes read those of other workers
        if count:
            launch_over(launch["update"], first, count)

    # ------------------------------------------------------------------------------------------------ launches

    def launches(self, w: int, i: int, j: int) -> Launches:
        """Of worker w, for the substep from state i to state j."""
        if self._capacity != self.arrays.capacity:
            self._capacity, self._launches = self.arrays.capacity, {}
            self.graphs.forget()
        key = (w, i, j)
        if key not in self._launches:
            self._launches[key] = self._record(w, i, j)
        return self._launches[key]

    def _record(self, w: int, i: int, j: int) -> Launches:
        arrays = self.arrays
        shared, count, sums = arrays.shared(w), arrays.ranges[w][1], arrays.sums_real

        def one(kernel: wp.Kernel, count: int, own: Arguments) -> wp.Launch:
            return record(kernel, count, own, shared=shared, device=arrays.device)

        arguments = self.arguments(w, i, j)
        launches = {name: one(kernel, count, arguments[name]) for name, kernel in self.kernels.items()}
        launches["clear"] = one(grids.clear(vector4(sums)), 1, dict(first=0, values=arrays.sums[w]))
        own = dict(first=0, grids=arrays.sums, values=arrays.grid)
        launches["total"] = one(grids.total_of_sums(arrays.real, sums), 1, own)
        if arrays.grips:
            launches["clear_gripped"] = one(grids.clear(arrays.real), 1, dict(first=0, values=arrays.gripped[w]))
            launches["total_gripped"] = one(grids.total(arrays.real), 1, dict(first=0, grids=arrays.gripped))
        return launches

    def arguments(self, w: int, i: int, j: int) -> dict[str, dict[str, object]]:
        """Of every kernel of the substep from state i to state j, what it does not share with all: state i lends its
        names, and what follows from it is of state j."""
        arrays = self.arrays
        a, b = arrays.state(i).warp, arrays.state(j).warp
        first = arrays.ranges[w][0]
        v = a["v"] if arrays.v_pushed is None else arrays.v_pushed
        onto = dict(grid=arrays.sums[w], lost=arrays.lost[w])
        gathered = dict(v_gathered=b["v_gathered"], L_gathered=b["L_gathered"])
        after = dict(u_next=b["u"], H_next=b["H"], memory_next=b["memory"])
        return {
            "push": dict(first=first, u=a["u"], v=a["v"], v_pushed=arrays.v_pushed),
            "mark": dict(first=first, u=a["u"]),
            "scatter": dict(first=first, u=a["u"], v=v, L=a["L"], tau=a["tau"], **onto),
            "hold": dict(first=first, u=a["u"], gripped=arrays.gripped[w]),
            "face": dict(first=0, gripped=arrays.gripped[0], grid=arrays.grid),
            "lead": dict(first=0, grid=arrays.grid),
            "update": dict(first=0, gripped=arrays.gripped[0], grid=arrays.grid),
            "gather": dict(first=first, u=a["u"], v=b["v_gathered"], L=b["L_gathered"]),
            "steer": dict(first=first, u=a["u"], **gathered, v=b["v"], L=b["L"]),
            "advance": dict(
                first=first, u=a["u"], v=b["v"], L=b["L"], H=a["H"], memory=a["memory"], **after, tau=b["tau"]
            ),
            "pass": dict(
                first=first, keep=1, onward=1, u=a["u"], H=a["H"], memory=a["memory"], **after, **gathered,
                v_next=b["v"], L_next=b["L"], tau_next=b["tau"], **onto,
            ),
        }  # fmt: skip
