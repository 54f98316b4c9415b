"""Weakly compressible fluid, Newtonian or power-law: water, honey, ketchup above its yield.

    tau = K J (J - 1) I + 2 eta J dev D                                             [Pa]
    eta = k g^(n - 1),   g^2 = 2 dev D : dev D + g_0^2,   g_0 = 1e-3 1/s            n = 1: Newtonian, eta = k
    D   = (B - B^-1)/(4 dt),   B = (I + dt L)(I + dt L)^T                           [1/s]

D is the rate of deformation of a finite step: sym L for a short one, nothing for a rotation however large, turning
with whoever turns, exact in shear. It stands as the body does at the end of the step, so that a sheared fluid has
normal stresses of +-eta dt/2 times the square of the shear rate.

J is integrated by itself, (J - 1)_next from det(I + dt L): the determinant of a long-sheared F would lose it. A viscous
explicit step needs dt < rho dx^2 / (6 eta) besides the sound-speed limit. Bird, Armstrong, Hassager (1987), sec. 4.1.
"""

import functools
from dataclasses import dataclass
from typing import Annotated

import torch
import warp as wp
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import NotNegative, Positive
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import Values, rows
from physics3d.materials.tensors import volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix

_LEAST_RATE = 1e-3  # g_0 [1/s]


@dataclass(frozen=True, kw_only=True)
class Newtonian(AbstractMaterial):
    """Parameters: bulk_modulus [Pa], viscosity k [Pa s^n], power_index n."""

    RANGES = {
        "bulk_modulus": Positive,  # K: against a change of volume [Pa]
        "viscosity": NotNegative,  # eta: stress in shear at a shear rate of 1/s [Pa s^n]
        "power_index": Annotated[float, Ge(0), Le(2)],  # n; 1: honey, below 1: the faster, the thinner
    }

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("bulk_modulus", "viscosity", "power_index")

    @property
    def example(self) -> dict[str, float]:
        return {"bulk_modulus": 1e5, "viscosity": 5.0, "power_index": 1.0}  # honey, softened

    @property
    def memory_rows(self) -> int:
        return 1

    def coefficients(self, values: Values) -> Float[Tensor, "3 n"]:
        self.check_parameters(values)
        return rows(*(values[name] for name in self.parameters))

    def wave_modulus(self, coefficients: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
        return coefficients[0]

    def viscosity(self, coefficients: Float[Tensor, "3 n"], L: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
        D = (L + L.mT) / 2
        dev = D - D.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3, dtype=L.dtype, device=L.device)
        _, k, n = coefficients
        return k * (2 * (dev * dev).sum((1, 2)) + _LEAST_RATE**2) ** ((n - 1) / 2)

    def energy(
        self, coefficients: Float[Tensor, "3 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "1 n"]
    ) -> Float[Tensor, " n"]:
        return coefficients[0] / 2 * memory[0] ** 2

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    carried_volume = volume.carried_volume(real)
    least2 = real(_LEAST_RATE**2)

    cofactor, least_det = volume.cofactor(real), real(1e-5 if real is wp.float32 else 1e-12)

    @wp.func(name=f"rate_of_deformation_{real.__name__}")
    def rate(dt: real, L: mat33, M: mat33):
        D = real(0.5) * (L + wp.transpose(L))
        if dt > real(0.0):
            X = M + wp.transpose(M) + M * wp.transpose(M)
            B = wp.identity(n=3, dtype=real) + X
            inverse = cofactor(B) / wp.max(wp.determinant(B), least_det)  # finite where the step flattens the body
            D = (X + X * inverse) / (real(4.0) * dt)
        return D

    @wp.func(name=f"newtonian_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # K [Pa], k [Pa s^n], n
        memory: wp.array2d(dtype=real),  # J - 1
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        j = carried_volume(memory[0, p], M)
        memory_next[0, p] = j
        J = real(1.0) + j
        D = rate(dt, L, M)
        D = D - wp.trace(D) / real(3.0) * one
        g2 = real(2.0) * wp.ddot(D, D) + least2
        eta = coefficients[1, p] * wp.pow(g2, real(0.5) * (coefficients[2, p] - real(1.0)))
        return H + M + M * H, coefficients[0, p] * J * j * one + real(2.0) * eta * wp.max(J, real(0.0)) * D

    return without_replay(advance)
