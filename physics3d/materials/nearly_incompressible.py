"""Rubber, gel and muscle, which hardly change their volume: isochoric neo-Hookean, 0.49 <= nu <= 0.4999.

    psi(F) = mu/2 (tr b~ - 3) + K/2 [(J^2 - 1)/2 - ln J],   b~ = J^(-2/3) F F^T                     [J/m^3]
    tau    = mu dev b~ + K/2 (J^2 - 1) I                                                            [Pa]

Shape and volume do not mix, so that the pressure of a body under load is K (J - 1) however it is sheared; J is
integrated by itself, and float32 keeps the stress to 1e-4 at nu = 0.4999.

What this costs. Waves of volume are (2 (1 - nu)/(1 - 2 nu))^(1/2) times as fast as those of shear: explicit substeps
are 4 times shorter with nu = 0.49 than with 0.3, and 38 times with 0.4999; implicit steps do not mind. Locking: every
particle asks for its own volume, 8 of them to the 3 velocities of a node, more than the nodes can give. Bodies of few
cells bend too little, and the pressure of single particles alternates about its mean, while that of a cell stays right;
both go away with more cells across. Take nu = 0.45 where only the motion matters.

Simo, Taylor and Pister (1985) for the energy; Bonet and Wood (2008), sec. 6.5; Mast et al. (2012), Mitigating kinematic
locking in the material point method.
"""

import functools
from dataclasses import dataclass

import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.tensors import volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class NearlyIncompressible(AbstractMaterial):
    """Elastic; parameters youngs_modulus [Pa] and poissons_ratio."""

    RANGES = ELASTIC

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio")

    @property
    def example(self) -> dict[str, float]:
        return {"youngs_modulus": 1e5, "poissons_ratio": 0.49}  # rubber

    @property
    def recovers(self) -> bool:
        return True

    @property
    def memory_rows(self) -> int:
        return 1

    def coefficients(self, values: Values) -> Float[Tensor, "2 n"]:
        self.check_parameters(values)
        mu, lam = lame(values["youngs_modulus"], values["poissons_ratio"])
        return rows(mu, lam + 2 / 3 * mu)

    def wave_modulus(self, coefficients: Float[Tensor, "2 n"]) -> Float[Tensor, " n"]:
        mu, K = coefficients
        return K + 4 / 3 * mu

    def energy(
        self, coefficients: Float[Tensor, "2 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "1 n"]
    ) -> Float[Tensor, " n"]:
        mu, K = coefficients
        y = volume.isochoric_strain(H).diagonal(dim1=1, dim2=2).sum(1)
        return mu / 2 * y + K * volume.volumetric_energy(H)

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    carried_volume, isochoric = volume.carried_volume(real), volume.isochoric(real)

    @wp.func(name=f"nearly_incompressible_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, K [Pa]
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
        mu, K = coefficients[0, p], coefficients[1, p]
        tau = mu * (B - wp.trace(B) / real(3.0) * one) + K * (j + real(0.5) * j * j) * one
        return H_next, tau

    return without_replay(advance)
