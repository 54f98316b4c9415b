"""Rubber up to twice its length, by two invariants: what stretching all ways and pulling one way tell apart.

    psi(F) = C_1 (I_1 - 3) + C_2 (I_2 - 3) + K/2 [(J^2 - 1)/2 - ln J]                               [J/m^3]
    tau    = 2 C_1 dev b~ + 2 C_2 dev(I_1 b~ - b~^2) + K/2 (J^2 - 1) I                              [Pa]
    I_1 = tr b~,   I_2 = (I_1^2 - tr b~^2)/2,   b~ = J^(-2/3) F F^T

Of small strains mu = 2 (C_1 + C_2). J is integrated by itself. Rivlin (1948); Bonet and Wood (2008), sec. 6.5.
"""

import functools
from dataclasses import dataclass

import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import NotNegative, Positive
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import Values, rows
from physics3d.materials.tensors import volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class MooneyRivlin(AbstractMaterial):
    """Elastic; parameters first_modulus C_1, second_modulus C_2 and bulk_modulus K [Pa]."""

    RANGES = {
        "first_modulus": Positive,  # C_1: the larger share of the stiffness; of small strains mu = 2 (C_1 + C_2) [Pa]
        "second_modulus": NotNegative,  # C_2: what stretching all ways and pulling one way tell apart [Pa]
        "bulk_modulus": Positive,  # K: against a change of volume [Pa]
    }

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("first_modulus", "second_modulus", "bulk_modulus")

    @property
    def example(self) -> dict[str, float]:
        return {"first_modulus": 1.5e5, "second_modulus": 1.5e4, "bulk_modulus": 5e6}  # vulcanised rubber, nu = 0.467

    @property
    def recovers(self) -> bool:
        return True

    @property
    def memory_rows(self) -> int:
        return 1

    def coefficients(self, values: Values) -> Float[Tensor, "3 n"]:
        self.check_parameters(values)
        return rows(*(values[name] for name in self.parameters))

    def wave_modulus(self, coefficients: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
        first, second, K = coefficients
        return K + 8 / 3 * (first + second)

    def energy(
        self, coefficients: Float[Tensor, "3 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "1 n"]
    ) -> Float[Tensor, " n"]:
        first, second, K = coefficients
        B = volume.isochoric_strain(H)
        y = B.diagonal(dim1=1, dim2=2).sum(1)
        second_invariant = 2 * y + (y**2 - (B * B).sum((1, 2))) / 2  # less 3
        return first * y + second * second_invariant + K * volume.volumetric_energy(H)

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    carried_volume, isochoric = volume.carried_volume(real), volume.isochoric(real)

    @wp.func(name=f"mooney_rivlin_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # C_1, C_2, K [Pa]
        memory: wp.array2d(dtype=real),  # J - 1
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        H_next = H + M + M * H
        X = H_next + wp.transpose(H_next) + H_next * wp.transpose(H_next)  # F F^T - I
        j = carried_volume(memory[0, p], M)
        memory_next[0, p] = j
        B = isochoric(X, j)
        y = wp.trace(B)
        # I_1 b~ - b~^2 = (2 + y) I + (1 + y) B - B^2
        S = coefficients[0, p] * B + coefficients[1, p] * ((real(1.0) + y) * B - B * B)
        tau = real(2.0) * (S - wp.trace(S) / real(3.0) * one) + coefficients[2, p] * (j + real(0.5) * j * j) * one
        return H_next, tau

    return without_replay(advance)
