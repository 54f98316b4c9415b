"""Compressible neo-Hookean solid: rubber, petals, soft tissue.

    psi(F) = mu/2 (tr(F^T F) - 3) - mu ln J + lam/2 (ln J)^2        [J/m^3]
    tau    = mu (F F^T - I) + lam ln(J) I                           [Pa]

J is integrated by itself, J_next = J det(I + dt L), and kept in the memory: nearly incompressible bodies in float32.
Below J = 1e-4 the logarithm goes on along its tangent, so an inverted element is pushed back with a finite force.
Bonet and Wood (2008), sec. 6.4.3.
"""

import functools
import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.tensors import scalars, volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix

_FLOOR = 1e-4  # J


@dataclass(frozen=True, kw_only=True)
class NeoHookean(AbstractMaterial):
    """Elastic; parameters youngs_modulus [Pa] and poissons_ratio."""

    RANGES = ELASTIC

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio")

    @property
    def example(self) -> dict[str, float]:
        return {"youngs_modulus": 1e5, "poissons_ratio": 0.4}  # soft rubber

    @property
    def memory_rows(self) -> int:
        return 1

    @property
    def recovers(self) -> bool:
        return True

    def coefficients(self, values: Values) -> Float[Tensor, "2 n"]:
        self.check_parameters(values)
        return rows(*lame(values["youngs_modulus"], values["poissons_ratio"]))

    def wave_modulus(self, coefficients: Float[Tensor, "2 n"]) -> Float[Tensor, " n"]:
        mu, lam = coefficients
        return lam + 2 * mu

    def energy(
        self, coefficients: Float[Tensor, "2 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "1 n"]
    ) -> Float[Tensor, " n"]:
        mu, lam = coefficients
        F = H + torch.eye(3, dtype=H.dtype, device=H.device)
        # finite where round-off makes J <= 0, for which there is no energy
        J = volume.determinant(F).clamp(min=1e-30)
        log_J, floor = torch.log(J), math.log(_FLOOR)
        # below the floor the integral of the tangent, so that the derivative is the stress there too
        below = floor**2 / 2 + (floor - 1) * (log_J - floor) + J / _FLOOR - 1
        volumetric = torch.where(J > _FLOOR, log_J**2 / 2, below)
        return mu / 2 * ((F * F).sum((1, 2)) - 3) - mu * log_J + lam * volumetric

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    carried_volume = volume.carried_volume(real)
    log1p_extended = scalars.log1p_extended(real, _FLOOR)

    @wp.func(name=f"neo_hookean_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, lam [Pa]
        memory: wp.array2d(dtype=real),  # J - 1
        memory_next: wp.array2d(dtype=real),
    ):
        M = dt * L
        H_next = H + M + M * H
        X = H_next + wp.transpose(H_next) + H_next * wp.transpose(H_next)  # F F^T - I
        j = carried_volume(memory[0, p], M)
        memory_next[0, p] = j
        log_J = log1p_extended(j)
        tau = coefficients[0, p] * X + coefficients[1, p] * log_J * wp.identity(n=3, dtype=real)
        return H_next, tau

    return without_replay(advance)
