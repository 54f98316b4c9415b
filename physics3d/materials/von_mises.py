"""Metal and clay: Hencky elasticity, von Mises yield, linear isotropic hardening.

    tau = 2 mu dev eps + K tr(eps) I,   eps = 1/2 ln b_e                [Pa]
    |dev tau| <= sqrt(2/3) (sigma_y + h alpha)                          alpha: equivalent plastic strain
    return: alpha += da,  dev eps *= 1 - sqrt(3/2) da / |dev eps|       da = trial excess / (sqrt(2/3) (3 mu + h))

The elastic strain X = b_e - I lives in the memory, so that H is the total deformation, plastic flow included.
Simo and Hughes, Computational Inelasticity (1998), box 9.1.
"""

import functools
from dataclasses import dataclass

import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import NotNegative, Positive
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.strain_memory import carried_strain, hencky_energy, store_strain
from physics3d.materials.tensors import log_strain, scalars
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class VonMises(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, yield_stress [Pa] in tension, hardening_modulus [Pa]."""

    RANGES = ELASTIC | {
        "yield_stress": Positive,  # sigma_y: stress in tension below which it comes back to its shape [Pa]
        "hardening_modulus": NotNegative,  # h: how that grows with plastic strain; 0: not [Pa]
    }

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio", "yield_stress", "hardening_modulus")

    @property
    def example(self) -> dict[str, float]:
        return {"youngs_modulus": 1e6, "poissons_ratio": 0.3, "yield_stress": 2e4, "hardening_modulus": 1e5}  # clay

    @property
    def memory_rows(self) -> int:
        return 7

    def coefficients(self, values: Values) -> Float[Tensor, "4 n"]:
        self.check_parameters(values)
        mu, lam = lame(values["youngs_modulus"], values["poissons_ratio"])
        return rows(mu, lam + 2 / 3 * mu, values["yield_stress"], values["hardening_modulus"])

    def wave_modulus(self, coefficients: Float[Tensor, "4 n"]) -> Float[Tensor, " n"]:
        return coefficients[1] + 4 / 3 * coefficients[0]

    def energy(
        self, coefficients: Float[Tensor, "4 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "7 n"]
    ) -> Float[Tensor, " n"]:
        """With the energy stored in hardening."""
        mu, K, _, h = coefficients
        return hencky_energy(mu, K, memory[:6]) + h / 2 * memory[6] ** 2

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    rescale, carried, store = log_strain.rescale(real), carried_strain(real), store_strain(real)
    expm1, root = scalars.expm1(real), real((2 / 3) ** 0.5)

    @wp.func(name=f"von_mises_return_{real.__name__}")
    def plastic_increment(dev: mat33, alpha: real, mu: real, sigma_y: real, h: real):
        """(equivalent plastic strain gained, -ln of the factor left of dev eps)."""
        size = wp.ddot(dev, dev)
        limit = root * (sigma_y + h * alpha)
        gained = real(0.0)
        shrink = real(0.0)
        if real(4.0) * mu * mu * size > limit * limit:
            norm = wp.sqrt(size)
            gained = (real(2.0) * mu * norm - limit) / (root * (real(3.0) * mu + h))
            shrink = -wp.log((limit + root * h * gained) / (real(2.0) * mu * norm))
        return gained, shrink

    @wp.func(name=f"von_mises_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, K, sigma_y, h [Pa]
        memory: wp.array2d(dtype=real),  # upper triangle of b_e - I, equivalent plastic strain
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        mu = coefficients[0, p]
        X = carried(p, 0, M, memory)
        eps, _same = rescale(X, real(1.0), real(1.0), real(0.0), real(0.0))
        mean = wp.trace(eps) / real(3.0)
        gained, shrink = plastic_increment(eps - mean * one, memory[6, p], mu, coefficients[2, p], coefficients[3, p])
        _eps, X_next = rescale(X, real(1.0), real(1.0), expm1(-shrink), real(0.0))
        store(p, 0, X_next, memory_next)
        memory_next[6, p] = memory[6, p] + gained
        tau = real(2.0) * mu * wp.exp(-shrink) * (eps - mean * one) + real(3.0) * coefficients[1, p] * mean * one
        return H + M + M * H, tau

    return without_replay(advance)
