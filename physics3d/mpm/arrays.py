"""All that one rollout keeps on its device: the body, states, the clock, the grid.

Everything is sized once; only the grid grows when the particles spread out. The grid is a window of nodes around the
particles; each worker scatters into one of its own. `clock` is a table with one row per substep of a run: dt, how long
places go on [s]; exp(-damping kick); kick, how long forces act [s]; then the signals of the boundaries.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from physics3d.mpm.columns import SPARE
from physics3d.mpm.grids import count_up
from physics3d.mpm.hold import least_distance
from physics3d.mpm.hooks import FIRST_SIGNAL, Hooks
from physics3d.mpm.state import State, make_state
from physics3d.mpm.threads import Team, shares
from physics3d.warp_types import vector, vector4


class Arrays:
    """`shared` gives them the names that they have as arguments of kernels."""

    def __init__(
        self,
        *,
        dx: float,  # [m]
        origin: Sequence[float],  # of node (0, 0, 0) [m]
        gravity: Sequence[float],  # [m/s^2]
        mass: torch.Tensor,  # [p] kg
        volume: torch.Tensor,  # [p] m^3
        rest: torch.Tensor,  # [p, 3] m
        cell: torch.Tensor,  # [p, 3] int32
        offset: torch.Tensor,  # [p, 3] cells
        coefficients: torch.Tensor,  # [k, p]
        q: torch.Tensor,  # [parameters of boundaries]
        selection: torch.Tensor,  # [boundary, p]
        hooks: Hooks,
        walls: Sequence[int] | None,  # [12] of `mirror`; None: no wall mirrors
        memory_rows: int,
        longest_run: int,  # substeps
        threads: int,
        fast: bool | None = None,  # one pass over the particles per substep; None: on a CPU
        recorded: bool | None = None,  # runs of substeps as graphs, with one worker; None: on CUDA
    ):
        self.dtype: torch.dtype = mass.dtype
        self.device: torch.device = mass.device
        self.real: type = wp.float32 if self.dtype == torch.float32 else wp.float64
        on_cpu = self.device.type == "cpu"
        self.fast: bool = on_cpu if fast is None else fast
        self.recorded: bool = not on_cpu if recorded is None else recorded
        self.n: int = len(mass)
        self.dx: float = dx
        self.memory_rows: int = memory_rows
        self.steered: bool = bool(hooks.steer)
        self.grips: int = len(hooks.grip)
        self.mirrored: bool = walls is not None
        self.coupled: bool = self.mirrored or self.grips > 0  # nodes depend on each other
        self.parameter_count: int = len(q)
        self.row_count: int = len(coefficients)
        self.boundary_count: int = len(selection)
        self.mass_floor: float = 1e-12 * float(mass.mean())  # [kg], of nodes
        self.least: float = least_distance(float(volume.median()) ** (1 / 3) / dx)
        vec3 = vector(self.real)
        self.constant: dict[str, Any] = {
            "whole_mass": wp.from_torch(mass),
            "whole_volume": wp.from_torch(volume),
            # what is free of them: all, unless something grips
            "mass": wp.from_torch(mass.clone()),
            "volume": wp.from_torch(volume.clone()),
            "cell": wp.from_torch(cell, dtype=wp.vec3i),
            "rest": wp.from_torch(rest, dtype=vec3),
            "offset": wp.from_torch(offset, dtype=vec3),
            "q": wp.from_torch(q) if len(q) else self.zeros(1, self.real),
            "selection": wp.from_torch(selection) if len(selection) else self.zeros((1, self.n), self.real),
            "coefficients": wp.from_torch(coefficients),
            "radius": wp.from_torch(0.5 * volume ** (1 / 3)),
        }
        self.walls: wp.array = self.zeros(12, wp.int32)
        if walls is not None:
            self.walls.assign(np.array(walls, np.int32))
        self.gravity: Sequence[float] = vec3(*gravity)
        self.origin: Sequence[float] = vec3(*origin)
        self.clock: wp.array = self.zeros((longest_run, FIRST_SIGNAL + hooks.signals), self.real)
        self.v_pushed: wp.array | None = self.zeros(self.n, vec3) if hooks.push else None
        self.states: list[State] = []
        # of each worker
        self.workers: int = max(1, threads) if on_cpu else 1
        self.team: Team = Team(self.workers)
        self.ranges: list[tuple[int, int]] = shares(self.n, self.workers)  # its first particle, how many
        self.row: list[wp.array] = [self.zeros(1, wp.int32) for _ in self.ranges]  # of the clock
        self.stamp: list[wp.array] = [self.zeros(1, wp.int32) for _ in self.ranges]  # of what is touched
        self.lost: list[wp.array] = [self.zeros(1, wp.int32) for _ in self.ranges]  # particles outside the window
        # written by the host, where that needs no launch and nothing is recorded
        by_host = on_cpu and not self.recorded
        self._row_numpy: list[np.ndarray] = [row.numpy() for row in self.row] if by_host else []
        self._stamp_numpy: list[np.ndarray] = [stamp.numpy() for stamp in self.stamp] if by_host else []
        # the grid
        self._touch_count: int = len(hooks.touch)
        self.window: wp.array = self.zeros(6, wp.int32)  # lowest node and number of nodes along each axis
        self.lowest: tuple[int, ...] = (0, 0, 0)  # the same for the host
        self.size: tuple[int, ...] = (0, 0, 0)
        self.node_count: int = 0  # in the window
        self.capacity: int = 0  # nodes that the grid has room for; another one: the arrays below are others
        # what is added up there, in double precision on a CPU: the sums of many would drift in single precision
        self.sums_real: type = wp.float64 if on_cpu else self.real
        self.sums: wp.array = self.zeros((self.workers, 0), vector4(self.sums_real))  # momentum [kg m/s], mass [kg]
        self.grid: wp.array = self.zeros(0, vector4(self.real))  # of all workers
        self.node_velocity: wp.array = self.zeros(0, vec3)  # [m/s]
        self.touched: wp.array = self.zeros((1, 1), wp.int32)  # [hook, node] stamps
        # distance from what is gripped [cells], the velocity imposed there [m/s], the node to follow: see `hold`
        self.gripped: wp.array = self.zeros((self.workers, 1), self.real)  # [worker, grip x node] [kg]
        self.depth: wp.array = self.zeros(1, self.real)
        self.imposed: wp.array = self.zeros(1, vec3)
        self.leader: wp.array = self.zeros(1, wp.int32)
        self.set_window((0, 0, 0), (1, 1, 1))

    def zeros(self, shape: int | tuple[int, ...], dtype: type) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=str(self.device))

    def new_state(self) -> State:
        return make_state(self.n, self.memory_rows, steered=self.steered, dtype=self.dtype, device=self.device)

    def state(self, i: int) -> State:
        """State number i, made when first asked for."""
        while len(self.states) <= i:
            self.states.append(self.new_state())
        return self.states[i]

    def set_window(self, lowest: Sequence[int], size: Sequence[int]) -> None:
        """Lay the grid over nodes lowest .. lowest + size - 1."""
        self.window.assign(np.array([*lowest, *size], np.int32))
        self.lowest, self.size = tuple(lowest), tuple(size)
        self.node_count = int(np.prod(size))
        if self.node_count + SPARE > self.capacity:
            self.capacity = int(1.5 * self.node_count) + SPARE
            self.sums = self.zeros((self.workers, self.capacity), vector4(self.sums_real))
            self.grid = self.zeros(self.capacity, vector4(self.real))
            self.node_velocity = self.zeros(self.capacity, vector(self.real))
            if self._touch_count:
                self.touched = self.zeros((self._touch_count, self.capacity), wp.int32)
            if self.grips:
                self.gripped = self.zeros((self.workers, self.grips * self.capacity), self.real)
                self.depth = self.zeros(self.capacity, self.real)
                self.imposed = self.zeros(self.capacity, vector(self.real))
                self.leader = self.zeros(self.capacity, wp.int32)

    def set_clock(self, clock: np.ndarray) -> None:
        table = np.zeros(self.clock.shape)
        table[: len(clock)] = clock
        self.clock.assign(table)

    def set_row(self, w: int, s: int) -> None:
        """Worker w is in substep s."""
        if self._row_numpy:
            self._row_numpy[w][0] = s
        else:
            self.row[w].fill_(s)

    def new_stamp(self, w: int) -> None:
        """The same on every thread, for all take the same steps."""
        if self._stamp_numpy:
            self._stamp_numpy[w][0] += 1
        else:
            wp.launch(count_up, 1, inputs=[1, self.stamp[w]], device=str(self.device))

    def shared(self, w: int) -> dict[str, object]:
        """What kernels of worker w may ask for, whatever the states they work on."""
        return {
            **self.constant,
            "dx": self.dx,
            "origin": self.origin,
            "gravity": self.gravity,
            "mass_floor": self.mass_floor,
            "least": self.least,
            "walls": self.walls,
            "clock": self.clock,
            "row": self.row[w],
            "stamp": self.stamp[w],
            "window": self.window,
            "touched": self.touched,
            "node_velocity": self.node_velocity,
            "depth": self.depth,
            "imposed": self.imposed,
            "leader": self.leader,
        }
