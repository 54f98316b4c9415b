"""Any solid with 1 to 3 Maxwell branches in parallel, same total deformation: what is elastic or plastic also creeps.

    tau = tau_solid + sum_N tau_N          [Pa], Kirchhoff; the branches are those of `viscoelastic.py`

Coefficients and memory of the solid come first, those of the branches behind them. Without branches take the solid by
itself, it costs nothing. Reese and Govindjee (1998) for the split of the stress.
"""

import functools
from dataclasses import dataclass, field
from typing import Annotated, Literal

import warp as wp
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import require_fields
from physics3d.materials.base import AbstractMaterial, coefficient_rows
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.parameters import Values, check_names, rows
from physics3d.materials.tensors.replay import without_replay
from physics3d.materials.viscoelastic import BRANCH, Viscoelastic, maxwell_branches
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class WithBranches(AbstractMaterial):
    """Parameters: those of the solid, then those of the branches as in `Viscoelastic`.

    Raises ValueError for a number of branches outside 1..3, an unknown spring, or a solid that has branches already.
    """

    solid: AbstractMaterial = field(default_factory=NeoHookean)
    branches: Annotated[int, Ge(1), Le(3)] = 1
    spring: Literal["hencky", "neo_hookean"] = "hencky"
    flow: Literal["log_strain", "stress"] = "log_strain"

    RANGES = BRANCH  # and those of the solid

    def __post_init__(self) -> None:
        require_fields(self, type(self).__name__)
        twice = set(self.solid.parameters) & set(self._maxwell.parameters)
        if twice:
            raise ValueError(f"the solid has {sorted(twice)} already; give it more branches of its own instead")

    @property
    def _maxwell(self) -> Viscoelastic:
        return Viscoelastic(elastic=False, branches=self.branches, spring=self.spring, flow=self.flow)

    @property
    def parameters(self) -> tuple[str, ...]:
        return self.solid.parameters + self._maxwell.parameters

    @property
    def example(self) -> dict[str, float]:
        return self.solid.example | self._maxwell.example

    @property
    def recovers(self) -> bool:
        return self.solid.recovers

    @property
    def memory_rows(self) -> int:
        return self.solid.memory_rows + self._maxwell.memory_rows

    def check_parameters(self, values: Values) -> None:
        check_names(values, self.parameters)
        for material in (self.solid, self._maxwell):
            material.check_parameters({name: values[name] for name in material.parameters})

    def coefficients(self, values: Values) -> Float[Tensor, "k n"]:
        check_names(values, self.parameters)
        solid, maxwell = (
            material.coefficients({name: values[name] for name in material.parameters})
            for material in (self.solid, self._maxwell)
        )
        return rows(*solid, *maxwell)

    def wave_modulus(self, coefficients: Float[Tensor, "k n"]) -> Float[Tensor, " n"]:
        solid, maxwell = self._split(coefficients)
        return self.solid.wave_modulus(solid) + self._maxwell.wave_modulus(maxwell)

    def stiffening(self, coefficients: Float[Tensor, "k n"], memory: Float[Tensor, "m n"]) -> Float[Tensor, " n"]:
        return self.solid.stiffening(self._split(coefficients)[0], memory[: self.solid.memory_rows])

    def viscosity(self, coefficients: Float[Tensor, "k n"], L: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
        return self.solid.viscosity(self._split(coefficients)[0], L)

    def energy(
        self, coefficients: Float[Tensor, "k n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "m n"]
    ) -> Float[Tensor, " n"]:
        solid, maxwell = self._split(coefficients)
        rows = self.solid.memory_rows
        return self.solid.energy(solid, H, memory[:rows]) + self._maxwell.energy(maxwell, H, memory[rows:])

    def _split(self, coefficients: Float[Tensor, "k n"]) -> tuple[Float[Tensor, "a n"], Float[Tensor, "b n"]]:
        first = len(coefficients) - 4 * self.branches
        return coefficients[:first], coefficients[first:]

    def advance(self, real: type) -> wp.Function:
        given = coefficient_rows(self.solid), self.solid.memory_rows
        return _advance(self.solid.advance(real), *given, self.branches, self.spring, self.flow, real)


@functools.cache
def _advance(
    solid: wp.Function, first: int, row: int, branches: int, spring: str, flow: str, real: type
) -> wp.Function:
    mat33 = matrix(real)
    all_branches = maxwell_branches(branches, spring, flow, real)

    @wp.func(name=f"{solid.key}_with_{branches}_{spring}_{flow}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # of the solid, then mu_N, K_N [Pa], k_d, k_v [1/s] of each branch
        memory: wp.array2d(
            dtype=real
        ),  # of the solid, then of each branch: upper triangle of b_N - I, by how much it is ahead [s]
        memory_next: wp.array2d(dtype=real),
    ):
        H_next, tau = solid(p, dt, L, H, coefficients, memory, memory_next)
        tau_N = all_branches(p, dt, dt * L, first, row, coefficients, memory, memory_next)
        return H_next, tau + tau_N

    return without_replay(advance)
