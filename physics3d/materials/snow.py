"""Snow: an elastic solid that gives way beyond a small stretch or squeeze, hardens as it is packed, breaks when pulled.

    psi = h (mu |dev eps|^2 + K/2 (tr eps)^2),   eps = 1/2 ln b_e,   h = exp(xi (1 - J_P))      [J/m^3]
    tau = h (2 mu dev eps + K tr(eps) I)                                                        [Pa]
    ln(1 - theta_c) <= principal values of eps <= ln(1 + theta_s)       what lies outside is plastic, J = J_E J_P

Stomakhin et al. (2013), with two changes. The stretch enters by its logarithm: b_e, no rotation to carry; they agree to
theta^2. And the return is not to the clamped stretch but to the point of the same box nearest in the energy: the same
where all are clamped alike or lam = 0, while clamping alone gains energy where a pull one way meets a squeeze another.
Hardening takes energy from the flow that packs the snow; it is less than that flow dissipates as long as
3/2 xi J_P max(1, 2 mu/3K) max(theta)^2/theta_c < 1, which is required at J_P = 1.

X = b_e - I and ln J_P live in the memory, so that H is the total deformation.
"""

import functools
from dataclasses import dataclass
from typing import Annotated

import torch
import warp as wp
from annotated_types import Gt, Lt
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import NotNegative, Positive
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.strain_memory import carried_strain, hencky_energy, store_strain
from physics3d.materials.tensors import return_maps, scalars
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class Snow(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, critical_compression theta_c, critical_stretch theta_s,
    hardening xi."""

    RANGES = ELASTIC | {
        "critical_compression": Annotated[float, Gt(0), Lt(1)],  # theta_c: share it is squeezed by before it packs
        "critical_stretch": Positive,  # theta_s: share it is drawn out by before it breaks
        "hardening": NotNegative,  # xi: packed snow is stiffer by exp(xi (1 - J_P)), J_P its volume
    }

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio", "critical_compression", "critical_stretch", "hardening")

    @property
    def example(self) -> dict[str, float]:  # of the paper
        return {
            "youngs_modulus": 1.4e5,
            "poissons_ratio": 0.2,
            "critical_compression": 2.5e-2,
            "critical_stretch": 7.5e-3,
            "hardening": 10.0,
        }

    @property
    def memory_rows(self) -> int:
        return 7

    def check_parameters(self, values: Values) -> None:
        super().check_parameters(values)
        with torch.no_grad():
            mu, K, lower, upper, xi = self._rows(values)
            widest = torch.maximum(-lower, upper) ** 2 / -lower
            limit = 2 / 3 / (torch.clamp(2 * mu / (3 * K), min=1.0) * widest)
        if bool((xi >= limit).any()):
            worst = (xi - limit).argmax()
            raise ValueError(
                f"hardening is {xi[worst]:g}: it would take more energy than the flow dissipates; take hardening < "
                f"{limit[worst]:g}, or a smaller critical_compression and critical_stretch"
            )

    def coefficients(self, values: Values) -> Float[Tensor, "5 n"]:
        self.check_parameters(values)
        return self._rows(values)

    def _rows(self, values: Values) -> Float[Tensor, "5 n"]:
        mu, lam = lame(values["youngs_modulus"], values["poissons_ratio"])
        lower, upper = torch.log1p(-values["critical_compression"]), torch.log1p(values["critical_stretch"])
        return rows(mu, lam + 2 / 3 * mu, lower, upper, values["hardening"])

    def wave_modulus(self, coefficients: Float[Tensor, "5 n"]) -> Float[Tensor, " n"]:
        return coefficients[1] + 4 / 3 * coefficients[0]

    def stiffening(self, coefficients: Float[Tensor, "5 n"], memory: Float[Tensor, "7 n"]) -> Float[Tensor, " n"]:
        return torch.exp(-coefficients[4] * torch.expm1(memory[6]))

    def energy(
        self, coefficients: Float[Tensor, "5 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "7 n"]
    ) -> Float[Tensor, " n"]:
        mu, K = coefficients[:2]
        return self.stiffening(coefficients, memory) * hencky_energy(mu, K, memory[:6])

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    box, carried, store = return_maps.box_hencky(real), carried_strain(real), store_strain(real)
    expm1 = scalars.expm1(real)
    third, most = real(1 / 3), real(60.0)  # e^60 is still a float32

    @wp.func(name=f"snow_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, K [Pa], ln(1 - theta_c), ln(1 + theta_s), xi
        memory: wp.array2d(dtype=real),  # upper triangle of b_e - I, ln J_P
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        mu, K = coefficients[0, p], coefficients[1, p]
        r = real(0.5) * K / mu - third
        eps, X_next, y = box(carried(p, 0, M, memory), r, coefficients[2, p], coefficients[3, p])
        store(p, 0, X_next, memory_next)
        log_J_P = wp.min(memory[6, p] - y, most)
        memory_next[6, p] = log_J_P
        h = wp.exp(-coefficients[4, p] * expm1(log_J_P))
        mean = wp.trace(eps) * third
        return H + M + M * H, h * (real(2.0) * mu * (eps - mean * one) + real(3.0) * K * mean * one)

    return without_replay(advance)
