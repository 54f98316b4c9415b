"""Neo-Hookean solid that has a stress for every F, flat and inverted ones too: flesh and cloth that are crushed.

    psi(F) = mu/2 (I_C - 3) - mu/2 ln((I_C + 1)/4) + lam/2 [(J - a)^2 - (1 - a)^2]                  [J/m^3]
    tau    = mu (1 - 1/(I_C + 1)) F F^T + lam (J - a) J I                                           [Pa]
    I_C = tr F^T F,   a = 1 + 3 mu/(4 lam),   mu = 4/3 mu_0,   lam = lam_0 + 5/6 mu_0

mu_0, lam_0 are Lame's constants of small strains. No logarithm of J: a body that is turned inside out finds its way
back, where `neo_hookean` pushes harder and harder. J is integrated by itself. Smith, de Goes and Kim (2018), Stable
neo-Hookean flesh simulation, eq. 14 and sec. 3.4.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.tensors import volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class StableNeoHookean(AbstractMaterial):
    """Elastic; parameters youngs_modulus [Pa] and poissons_ratio."""

    RANGES = ELASTIC

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio")

    @property
    def example(self) -> dict[str, float]:
        return {"youngs_modulus": 5e4, "poissons_ratio": 0.45}  # flesh

    @property
    def recovers(self) -> bool:
        return True

    @property
    def memory_rows(self) -> int:
        return 1

    def coefficients(self, values: Values) -> Float[Tensor, "2 n"]:
        self.check_parameters(values)
        mu, lam = lame(values["youngs_modulus"], values["poissons_ratio"])
        return rows(4 / 3 * mu, lam + 5 / 6 * mu)

    def wave_modulus(self, coefficients: Float[Tensor, "2 n"]) -> Float[Tensor, " n"]:
        mu, lam = coefficients
        return lam + 7 / 8 * mu

    def energy(
        self, coefficients: Float[Tensor, "2 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "1 n"]
    ) -> Float[Tensor, " n"]:
        mu, lam = coefficients
        i, j = (2 * H + H @ H.mT).diagonal(dim1=1, dim2=2).sum(1), volume.change(H)
        return mu / 2 * (i - torch.log1p(i / 4)) + lam / 2 * j**2 - 3 / 4 * mu * j

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    carried_volume = volume.carried_volume(real)

    @wp.func(name=f"stable_neo_hookean_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, lam [Pa]
        memory: wp.array2d(dtype=real),  # J - 1
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        H_next = H + M + M * H
        X = H_next + wp.transpose(H_next) + H_next * wp.transpose(H_next)  # F F^T - I
        j = carried_volume(memory[0, p], M)
        memory_next[0, p] = j
        # 1 - 1/(I_C + 1) = 3/4 + c; the parts that cancel at rest are left out
        i = wp.trace(X)
        c = i / (real(4.0) * (real(4.0) + i))
        mu, lam = coefficients[0, p], coefficients[1, p]
        pressure = lam * (real(1.0) + j) * j - real(0.75) * mu * j
        tau = mu * (real(0.75) * X + c * (one + X)) + pressure * one
        return H_next, tau

    return without_replay(advance)
