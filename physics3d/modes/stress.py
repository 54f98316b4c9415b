"""The constitutive function at points that do not move through space, with its history and its exact adjoint.

A material answers (dt, L, H, memory) -> tau; here it is asked with the increment that leads from the last deformation
to the present one,

    L = (F - F_0) F_0^-1 / dt,    P = w tau F^-T        [N m, times gradients of the basis: forces]

so that F is that of the basis itself and never drifts. All arrays are float64 and hold H = F - I, and P, transposed:
row a is the derivative along axis a, as the gradients of the basis are laid out.
"""

import numpy as np
import torch
import warp as wp
from jaxtyping import Float

from physics3d.materials.base import AbstractMaterial
from physics3d.modes.kernels import stages
from physics3d.warp_start import start_warp


class Points:
    """n points of integration: `coefficients` [k, n] of the material, `weight` [n] m^3 of matter at rest."""

    def __init__(
        self, material: AbstractMaterial, coefficients: Float[np.ndarray, "k n"], weight: Float[np.ndarray, " n"]
    ):
        start_warp()
        n = len(weight)
        self.material, self.n = material, n
        self.rows = material.memory_rows
        shapes = {
            "H": (n, 3, 3), "H_0": (n, 3, 3), "L": (n, 3, 3), "H_next": (n, 3, 3), "tau": (n, 3, 3), "P": (n, 3, 3),
            "coefficients": coefficients.shape, "memory": (self.rows, n), "memory_next": (self.rows, n), "weight": (n,),
        }  # fmt: skip
        self.data = {name: np.zeros(shape) for name, shape in shapes.items()}
        self.adjoint = {name: np.zeros(shape) for name, shape in shapes.items()}
        self.data["coefficients"][:] = coefficients
        self.data["weight"][:] = weight
        self._arrays = {name: _array(value) for name, value in self.data.items()}
        self._adjoints = {name: _array(value) for name, value in self.adjoint.items()}
        self.data["memory"][:] = material.initial_memory(n, torch.float64).numpy()
        self._kernels = stages(material.advance(wp.float64))
        # recorded once per dt: a launch of few points is half overhead
        self._forward: dict[float, list] = {}
        self._backward: dict[float, list] = {}

    def stress(self, Ht: Float[np.ndarray, "n 3 3"], dt: float) -> Float[np.ndarray, "n 3 3"]:
        """w P transposed, of the deformation Ht [n, 3, 3] a time dt [s] after the last one that was kept."""
        np.copyto(self.data["H"], Ht)
        if dt not in self._forward:
            self._forward = {dt: [self._recorded(i, dt) for i in range(3)]}
        for command in self._forward[dt]:
            command.launch()
        return self.data["P"]

    def keep(self) -> None:
        """The last deformation asked for has happened."""
        np.copyto(self.data["H_0"], self.data["H"])
        np.copyto(self.data["memory"], self.data["memory_next"])

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of (H_0, memory)."""
        return self.data["H_0"].copy(), self.data["memory"].copy()

    def set_state(self, state: tuple[np.ndarray, np.ndarray]) -> None:
        np.copyto(self.data["H_0"], state[0])
        np.copyto(self.data["memory"], state[1])

    def pull(
        self, P_bar: Float[np.ndarray, "n 3 3"] | None, memory_bar: Float[np.ndarray, "m n"] | None, dt: float
    ) -> dict[str, np.ndarray]:
        """Adjoints of "H", "H_0", "memory" and "coefficients" where those of P and memory_next are given, at the
        deformation of the last call of `stress`. The arrays are overwritten by the next call."""
        for value in self.adjoint.values():
            value.fill(0.0)
        if P_bar is not None:
            np.copyto(self.adjoint["P"], P_bar)
        if memory_bar is not None:
            np.copyto(self.adjoint["memory_next"], memory_bar)
        if dt not in self._backward:
            self._backward = {dt: [self._recorded(i, dt, adjoint=True) for i in (2, 1, 0)]}
        for command in self._backward[dt]:
            command.launch()
        return self.adjoint

    def tangent(self, Ht: Float[np.ndarray, "n 3 3"], dt: float) -> Float[np.ndarray, "9 n 3 3"]:
        """d(w P)/dH of the deformation Ht, all transposed: [3 a + i] is the row of P_ia."""
        self.stress(Ht, dt)
        rows, unit = np.empty((9, self.n, 3, 3)), np.zeros((self.n, 3, 3))
        for k in range(9):
            unit.reshape(self.n, 9)[:] = 0.0
            unit.reshape(self.n, 9)[:, k] = 1.0
            rows[k] = self.pull(unit, None, dt)["H"]
        return rows

    def energy(self, Ht: Float[np.ndarray, "t n 3 3"], memory: Float[np.ndarray, "t m n"]) -> Float[np.ndarray, " t"]:
        """Stored elastic energy [J] of deformations, each with its history."""
        times = len(Ht)
        H = torch.from_numpy(np.ascontiguousarray(Ht)).reshape(-1, 3, 3).mT
        of_each = torch.from_numpy(self.data["coefficients"]).repeat(1, times)
        history = torch.from_numpy(np.ascontiguousarray(np.moveaxis(memory, 1, 0))).reshape(-1, times * self.n)
        return self.material.energy(of_each, H, history).numpy().reshape(times, self.n) @ self.data["weight"]

    def _recorded(self, stage: int, dt: float, *, adjoint: bool = False) -> wp.Launch:
        kernel, inputs, outputs = self._kernels[stage]
        pick = lambda names, table: [table[name] for name in names]
        return wp.launch(
            kernel,
            dim=self.n,
            inputs=[dt, *pick(inputs, self._arrays)],
            outputs=pick(outputs, self._arrays),
            adj_inputs=[None, *pick(inputs, self._adjoints)] if adjoint else [],
            adj_outputs=pick(outputs, self._adjoints) if adjoint else [],
            adjoint=adjoint,
            record_cmd=True,
            device="cpu",
        )


def _array(value: np.ndarray) -> wp.array:
    """The same memory, for Warp."""
    kind = wp.mat33d if value.shape[1:] == (3, 3) else wp.float64
    return wp.array(value, dtype=kind, copy=False, device="cpu")
