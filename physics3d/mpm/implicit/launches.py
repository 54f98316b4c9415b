"""What an implicit step launches, and the arrays that it has beside those of explicit substeps.

The kernels of the substep and their adjoints serve here too, with other arrays in some places: inertia and stress are
scattered apart, and the adjoint of the material, asked nine times, gives its tangent.
"""

import torch
import warp as wp

from physics3d.mpm import transfer
from physics3d.mpm.adjoint import Adjoint
from physics3d.mpm.arrays import Arrays
from physics3d.mpm.implicit.diagonal import diagonal
from physics3d.mpm.implicit.slow import SlowModes
from physics3d.mpm.implicit.stiffness import stiffness
from physics3d.mpm.implicit.stress import stress, stress_adjoint
from physics3d.mpm.launches import Arguments, launch_over, record
from physics3d.mpm.substep import Substeps
from physics3d.mpm.threads import Wait
from physics3d.warp_types import matrix, vector, vector4

Call = tuple[wp.Kernel, Arguments, Arguments | None]  # kernel, its arguments, their adjoints if it is launched back


class StepLaunches:
    """Launches by name, for the step between the states that `between` was told of."""

    def __init__(self, substeps: Substeps):
        self.substeps = substeps
        self.arrays: Arrays = substeps.arrays
        zeros, n, real = self.arrays.zeros, self.arrays.n, self.arrays.real
        vec3, mat33 = vector(real), matrix(real)
        self.nothing: wp.array = zeros(n, real)  # mass or volume of a scatter without inertia or without stress
        self.no_vector: wp.array = zeros(n, vec3)
        self.no_matrix: wp.array = zeros(n, mat33)
        self.no_adjoint: wp.array = zeros(n, mat33)  # of arguments that are multiplied by zero
        self.no_number: wp.array = zeros(n, real)  # likewise
        self.T: wp.array = zeros(n, mat33)  # [Pa]
        self.E: wp.array = zeros(n, mat33)  # adjoint of T
        self.own: dict[str, wp.array] = {name: zeros(n, mat33) for name in ("T", "tau", "L", "L_gathered")}  # adjoints
        self.own |= {name: zeros(n, vec3) for name in ("v", "v_gathered", "unused")}
        self.C: wp.array = zeros((n, 81), real)  # dT_ab/dL_ce [Pa s], at 27 c + 9 e + 3 a + b
        self.moduli: wp.array = zeros((n, 2), real)  # of the isotropic tensor with the same means [Pa s]
        self.kick: float | None = None  # of the step whose symmetric C that is [s]; None: it is no step's
        # what the first solve of the last step left of the residual, with a tangent of the step before and with its own
        self.reached: dict[bool, float] = {False: 0.01, True: 0.01}
        self.own_tangents: int = 0  # steps that are to come before the tangent of the last one is tried again
        self.slow: SlowModes = SlowModes()
        self.folded: list[wp.array] = [zeros(1, wp.int32) for _ in self.arrays.ranges]  # particles
        # on the nodes
        self.capacity: int = 0
        self.w: wp.array = zeros(0, vec3)
        self.Kw: wp.array = zeros((self.arrays.workers, 0), vector4(self.arrays.sums_real))
        self.blocks: wp.array = zeros((self.arrays.workers, 0), mat33)
        self.probe_velocity: wp.array = zeros(0, vec3)  # adjoint of velocities after the boundaries, and below it that
        self.probe_grid: wp.array = zeros(0, vector4(real))  # of momenta before them
        self.pair: tuple[int, int] = (0, 0)
        self.adjoint: Adjoint | None = None  # of explicit substeps, to whose arrays a reverse step adds
        self.side: int = 0  # the set of it that holds the adjoint of the later state
        self._launches: dict[tuple, wp.Launch | None] = {}

    def between(self, i: int, j: int, *, adjoint: Adjoint | None = None, side: int = 0) -> None:
        """From now on launches are for the step from state i to state j, on the present grid."""
        arrays, real = self.arrays, self.arrays.real
        self.pair, self.side = (i, j), side
        if self.capacity == arrays.capacity and self.adjoint is adjoint:
            return
        self.adjoint, self._launches = adjoint, {}
        if self.capacity == arrays.capacity:
            return
        self.capacity = arrays.capacity
        self.w = arrays.zeros(self.capacity, vector(real))
        self.Kw = arrays.zeros((arrays.workers, self.capacity), vector4(arrays.sums_real))
        self.blocks = arrays.zeros((arrays.workers, self.capacity), matrix(real))
        self.probe_velocity = arrays.zeros(self.capacity, vector(real))
        self.probe_grid = arrays.zeros(self.capacity, vector4(real))

    def on_particles(self, *names: str) -> None:
        """Launch over all particles, each thread its own; kernels that the scene does not have are left out."""
        work = [[x for name in names if (x := self._launch(name, w)) is not None] for w in range(self.arrays.workers)]

        def worker(w: int, wait: Wait) -> None:
            for launch in work[w]:
                launch.launch()

        self.arrays.team.run(worker)

    def on_nodes(self, name: str) -> None:
        launch = self._launch(name, 0)
        assert launch is not None
        launch_over(launch, 0, self.arrays.node_count)

    def grip(self) -> None:
        """What is gripped of the particles, as mass of the nodes."""
        arrays = self.arrays
        if arrays.grips:
            gripped = wp.to_torch(arrays.gripped)
            gripped.zero_()
            self.on_particles("hold")
            total(gripped)

    def _launch(self, name: str, w: int) -> wp.Launch | None:
        key = (name, w, *self.pair, self.side)
        if key not in self._launches:
            calls = self._forward(w) | self._tangent(w) | (self._backward(w, self.adjoint) if self.adjoint else {})
            call, arrays = calls[name], self.arrays
            if call is not None:
                kernel, own, adjoints = call
                shared, count = arrays.shared(w), arrays.ranges[w][1]
                launch = record(kernel, count, own, shared=shared, adjoints=adjoints, device=arrays.device)
            self._launches[key] = None if call is None else launch
        return self._launches[key]

    # ------------------------------------------------------------------------------------------------ which kernel

    def _forward(self, w: int) -> dict[str, Call | None]:
        """From node velocities to the momentum that they end with."""
        arrays, kernels, real = self.arrays, self.substeps.kernels, self.arrays.real
        arguments = self.substeps.arguments(w, *self.pair)
        b = arrays.state(self.pair[1]).warp
        update = kernels["update"], arguments["update"]
        calls: dict[str, Call | None] = {
            name: (kernels[name], arguments[name], None) if name in kernels else None
            for name in ("push", "hold", "face", "lead", "mark", "gather", "steer", "advance")
        }
        return calls | {
            "scatter": (transfer.scatter(real, arrays.sums_real), self._inertia(w), None),
            "update": (*update, None),
            "update_still": (update[0], update[1] | dict(gravity=vector(real)()), None),
            "stress": (
                stress(real),
                dict(first=arrays.ranges[w][0], L=b["L"], tau=b["tau"], T=self.T, folded=self.folded[w]),
                None,
            ),
            "force": (transfer.scatter(real, arrays.sums_real), self._force(w), None),
        }

    def _tangent(self, w: int) -> dict[str, Call | None]:
        """What linearises the forces and the boundaries."""
        arrays, real, own = self.arrays, self.arrays.real, self.own
        a, b = (arrays.state(k).warp for k in self.pair)
        first = arrays.ranges[w][0]
        gathered = dict(v_gathered=own["v_gathered"], L_gathered=own["L_gathered"])
        probe = dict(grid=self.probe_grid, node_velocity=self.probe_velocity)
        outputs = dict(adjoint_tau=own["tau"], adjoint_L=own["L"])
        return {
            "stress_adjoint": (
                stress_adjoint(real), dict(first=first, L=b["L"], T=self.T, adjoint_T=self.E, **outputs), None,
            ),
            "advance_adjoint": self._back("advance", w, dict(L=own["L"], tau=own["tau"])),
            "steer_adjoint": self._back("steer", w, dict(**gathered, v=own["v"], L=own["L"])),
            "diagonal": (diagonal(real), dict(first=first, u=a["u"], moduli=self.moduli, blocks=self.blocks[w]), None),
            "stiffness": (
                stiffness(real, arrays.sums_real, arrays.fast),
                dict(first=first, u=a["u"], C=self.C, w=self.w, Kw=self.Kw[w]), None,
            ),
            "probe": self._back("update", w, probe),
            "probe_still": self._back("update", w, probe, gravity=vector(real)()),
        }  # fmt: skip

    def _backward(self, w: int, adjoint: Adjoint) -> dict[str, Call | None]:
        """The adjoint of a step: first of what follows from the node velocities, then of what they follow from."""
        arrays, real, own = self.arrays, self.arrays.real, self.own
        b = arrays.state(self.pair[1]).warp
        first = arrays.ranges[w][0]
        later, now = adjoint.states[self.side].warp, adjoint.states[1 - self.side].warp
        explicit = adjoint.arguments(w, self.side)
        u = arrays.state(self.pair[0]).warp["u"]
        from_place = dict(adjoint_offset=adjoint.offset, adjoint_u=now["u"])
        onto = from_place | dict(adjoint_node_velocity=adjoint.node_velocity[w])
        material = dict(u=now["u"], H=now["H"], coefficients=adjoint.coefficients, memory=now["memory"])
        at = dict(rest=adjoint.rest, q=adjoint.q[w], u=now["u"])
        gathered = dict(v_gathered=own["v_gathered"], L_gathered=own["L_gathered"])
        adjoint_v = now["v"] if adjoint.v_pushed is None else adjoint.v_pushed
        spread = transfer.scatter_adjoint(real)
        gather = transfer.gather_adjoint(real)
        return {
            "advance_back": self._back("advance", w, explicit["advance"]),
            "steer_back": self._back("steer", w, explicit["steer"]),
            "gather_back": (
                gather,
                dict(first=first, u=u, adjoint_v=later["v_gathered"], adjoint_L=later["L_gathered"], **onto),
                None,
            ),
            "update_back": self._back("update", w, explicit["update"]),
            "face_back": self._back("face", w, explicit["face"]),
            "hold_back": self._back("hold", w, explicit["hold"]),
            "force_back": (
                spread,
                _inputs(self._force(w))
                | from_place
                | dict(
                    adjoint_grid=adjoint.grid, adjoint_v=own["unused"], adjoint_L=self.no_adjoint, adjoint_tau=own["T"],
                    adjoint_mass=self.no_number, adjoint_volume=adjoint.volume,
                ),
                None,
            ),
            "stress_back": (
                stress_adjoint(real),
                dict(first=first, L=b["L"], T=self.T, adjoint_T=own["T"], adjoint_tau=own["tau"], adjoint_L=own["L"]),
                None,
            ),
            "advance_again": self._back("advance", w, dict(**material, L=own["L"], tau=own["tau"])),
            "steer_again": self._back("steer", w, dict(**at, **gathered, v=own["v"], L=own["L"])),
            "gather_again": (
                gather, dict(first=first, u=u, adjoint_v=own["v_gathered"], adjoint_L=own["L_gathered"], **onto), None,
            ),
            "scatter_back": (
                spread,
                _inputs(self._inertia(w))
                | from_place
                | dict(
                    adjoint_grid=adjoint.grid, adjoint_v=adjoint_v, adjoint_L=now["L"], adjoint_tau=self.no_adjoint,
                    adjoint_mass=adjoint.mass, adjoint_volume=self.no_number,
                ),
                None,
            ),
            "push_back": self._back("push", w, explicit["push"]),
        }  # fmt: skip

    def _back(self, kernel: str, w: int, adjoints: Arguments, **changed: object) -> Call | None:
        """The generated adjoint of a kernel of the substep, with adjoint arrays for some of its arguments; `changed`
        are arguments that are other ones than in the substep."""
        if kernel not in self.substeps.kernels:
            return None
        arguments = self.substeps.arguments(w, *self.pair)[kernel]
        return self.substeps.kernels[kernel], arguments | changed, adjoints

    def _inertia(self, w: int) -> dict[str, object]:
        """Of a scatter without stress."""
        scattered = self.substeps.arguments(w, *self.pair)["scatter"]
        return scattered | dict(volume=self.nothing, tau=self.no_matrix)

    def _force(self, w: int) -> dict[str, object]:
        """Of a scatter of stress alone."""
        scattered = self.substeps.arguments(w, *self.pair)["scatter"]
        return scattered | dict(mass=self.nothing, v=self.no_vector, L=self.no_matrix, tau=self.T)


def _inputs(scattered: Arguments) -> dict[str, object]:
    """Of a scatter, what its adjoint takes too."""
    return {name: value for name, value in scattered.items() if name not in ("grid", "lost")}


def total(grids: torch.Tensor) -> torch.Tensor:
    """The grids of all threads [worker, node, ...] summed into the first, in a fixed order."""
    for other in grids[1:]:
        grids[0] += other
    return grids[0]
