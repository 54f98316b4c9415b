"""Filled rubber up to its breaking: soft at first, stiff where the chains are drawn out.

    psi(F) = C_1 y + C_2 y^2 + C_3 y^3 + K/2 [(J^2 - 1)/2 - ln J],   y = tr b~ - 3                   [J/m^3]
    tau    = 2 (C_1 + 2 C_2 y + 3 C_3 y^2) dev b~ + K/2 (J^2 - 1) I,   b~ = J^(-2/3) F F^T           [Pa]

Of small strains mu = 2 C_1. C_2 may be negative, as long as the factor of dev b~ stays positive. J is integrated by
itself; y is kept in the memory for the limit of explicit steps, which stiffening shortens. Yeoh (1993).
"""

import functools
from dataclasses import dataclass
from typing import Annotated

import torch
import warp as wp
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import LARGEST, NotNegative, Positive
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import Values, rows
from physics3d.materials.tensors import volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class Yeoh(AbstractMaterial):
    """Elastic; parameters linear_modulus C_1, quadratic_coefficient C_2, cubic_modulus C_3 and bulk_modulus K [Pa]."""

    RANGES = {
        "linear_modulus": Positive,  # C_1: half of mu of small strains [Pa]
        "quadratic_coefficient": Annotated[float, Ge(-LARGEST)],  # C_2: below 0, softer in between [Pa]
        "cubic_modulus": NotNegative,  # C_3: stiffer where it is drawn out far [Pa]
        "bulk_modulus": Positive,  # K: against a change of volume [Pa]
    }

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("linear_modulus", "quadratic_coefficient", "cubic_modulus", "bulk_modulus")

    @property
    def example(self) -> dict[str, float]:  # filled rubber, softened
        return {"linear_modulus": 2e5, "quadratic_coefficient": -2e3, "cubic_modulus": 1e2, "bulk_modulus": 6e6}

    @property
    def recovers(self) -> bool:
        return True

    @property
    def memory_rows(self) -> int:
        return 2

    def check_parameters(self, values: Values) -> None:
        super().check_parameters(values)
        first, second, third = (torch.as_tensor(values[name]).detach() for name in self.parameters[:3])
        least = -torch.sqrt(3 * first * third)  # of C_2: no real root of C_1 + 2 C_2 y + 3 C_3 y^2
        if not bool((second >= least).all()):
            raise ValueError(
                f"quadratic_coefficient is {second.min():g}: the rubber would lose its stiffness; take at least "
                f"-(3 linear_modulus cubic_modulus)^(1/2) = {least.max():g}"
            )

    def coefficients(self, values: Values) -> Float[Tensor, "4 n"]:
        self.check_parameters(values)
        return rows(*(values[name] for name in self.parameters))

    def wave_modulus(self, coefficients: Float[Tensor, "4 n"]) -> Float[Tensor, " n"]:
        return coefficients[3] + 8 / 3 * coefficients[0]

    def stiffening(self, coefficients: Float[Tensor, "4 n"], memory: Float[Tensor, "2 n"]) -> Float[Tensor, " n"]:
        """With 4 psi'' |dev b~|^2, the part of the tangent that stretching adds beyond the stress."""
        y = memory[1].clamp(min=0)
        curvature = (2 * coefficients[1] + 6 * coefficients[2] * y).clamp(min=0)
        return 1 + 8 / 3 * curvature * (3 + y) ** 2 * y / (1 + y) / self.wave_modulus(coefficients)

    def energy(
        self, coefficients: Float[Tensor, "4 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "2 n"]
    ) -> Float[Tensor, " n"]:
        first, second, third, K = coefficients
        y = volume.isochoric_strain(H).diagonal(dim1=1, dim2=2).sum(1)
        return first * y + second * y**2 + third * y**3 + K * volume.volumetric_energy(H)

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    carried_volume, isochoric = volume.carried_volume(real), volume.isochoric(real)

    @wp.func(name=f"yeoh_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # C_1, C_2, C_3, K [Pa]
        memory: wp.array2d(dtype=real),  # J - 1, y
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
        memory_next[1, p] = y
        slope = coefficients[0, p] + real(2.0) * coefficients[1, p] * y + real(3.0) * coefficients[2, p] * y * y
        shear, K = real(2.0) * slope, coefficients[3, p]
        tau = shear * (B - y / real(3.0) * one) + K * (j + real(0.5) * j * j) * one
        return H_next, tau

    return without_replay(advance)
