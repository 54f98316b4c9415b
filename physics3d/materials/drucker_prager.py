"""Dry sand: Hencky elasticity, Drucker-Prager friction, no cohesion.

    tau = 2 mu dev eps + K tr(eps) I,   eps = 1/2 ln b_e                                    [Pa]
    |dev tau| <= -a tr tau,   a = sqrt(2/3) 2 sin(phi) / (3 - sin(phi))                     phi: friction angle
    tr(eps) >= 0: no stress; the volume gained there is kept and has to close before pressure returns

Flow is isochoric, dev eps shrinks to the cone. Klar et al. (2016), volume correction of Tampubolon et al. (2017). The
elastic strain X = b_e - I lives in the memory, so that H is the total deformation.
"""

import functools
import math
from dataclasses import dataclass
from typing import Annotated

import torch
import warp as wp
from annotated_types import Gt, Lt
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.strain_memory import carried_strain, hencky_energy, store_strain
from physics3d.materials.tensors import log_strain, scalars
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class DruckerPrager(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, friction_angle [rad]."""

    RANGES = ELASTIC | {
        "friction_angle": Annotated[float, Gt(0), Lt(math.pi / 2)],  # phi: of the slope at which a heap stays [rad]
    }

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio", "friction_angle")

    @property
    def example(self) -> dict[str, float]:
        return {"youngs_modulus": 1e6, "poissons_ratio": 0.3, "friction_angle": math.radians(35)}  # dry sand, softened

    @property
    def memory_rows(self) -> int:
        return 7

    def coefficients(self, values: Values) -> Float[Tensor, "3 n"]:
        self.check_parameters(values)
        mu, lam = lame(values["youngs_modulus"], values["poissons_ratio"])
        sine = torch.sin(values["friction_angle"])
        return rows(mu, lam + 2 / 3 * mu, math.sqrt(2 / 3) * 2 * sine / (3 - sine))

    def wave_modulus(self, coefficients: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
        return coefficients[1] + 4 / 3 * coefficients[0]

    def energy(
        self, coefficients: Float[Tensor, "3 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "7 n"]
    ) -> Float[Tensor, " n"]:
        mu, K, _ = coefficients
        return hencky_energy(mu, K, memory[:6])

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    rescale, carried, store = log_strain.rescale(real), carried_strain(real), store_strain(real)
    expm1 = scalars.expm1(real)
    gone = real(60.0)  # e^-60: what is left of a strain that is given up

    @wp.func(name=f"drucker_prager_return_{real.__name__}")
    def shrinkage(dev: mat33, trace: real, mu: real, K: real, a: real):
        """-ln of the factors left of (dev eps, tr eps)."""
        d = real(0.0)
        v = real(0.0)
        if trace >= real(0.0):
            d = gone
            v = gone
        else:
            size = wp.ddot(dev, dev)
            allowed = -real(1.5) * a * K * trace / mu  # |dev eps| at |dev tau| = -a tr(tau)
            if size > allowed * allowed:
                d = wp.min(real(0.5) * wp.log(size) - wp.log(allowed), gone)
        return d, v

    @wp.func(name=f"drucker_prager_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, K [Pa], a
        memory: wp.array2d(dtype=real),  # upper triangle of b_e - I, volume gained in tension (of ln J)
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        mu, K = coefficients[0, p], coefficients[1, p]
        X = carried(p, 0, M, memory)
        X = X + expm1(real(2.0) * memory[6, p] / real(3.0)) * (one + X)
        eps, _same = rescale(X, real(1.0), real(1.0), real(0.0), real(0.0))
        trace = wp.trace(eps)
        dev = eps - trace / real(3.0) * one
        d, v = shrinkage(dev, trace, mu, K, coefficients[2, p])
        _eps, X_next = rescale(X, real(1.0), real(1.0), expm1(-d), expm1(-v))
        store(p, 0, X_next, memory_next)
        memory_next[6, p] = wp.max(trace, real(0.0))
        return H + M + M * H, real(2.0) * mu * wp.exp(-d) * dev + K * wp.exp(-v) * trace * one

    return without_replay(advance)
