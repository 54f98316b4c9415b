"""Foam, paste, dough: elastic below a yield stress, above it a fluid of Herschel and Bulkley.

    tau = 2 mu dev eps + K tr(eps) I,   eps = 1/2 ln b_e                        [Pa]
    q   = |dev tau| / sqrt(2)                                                   shear stress
    q   = tau_y + k g^n where it flows, g = sqrt(2) |D_p| shear rate of flow [1/s], D_p along dev tau

Flow relaxes the overstress z = q - tau_y alone: dz/dt = -mu (z/k)^(1/n). In closed form, with m = 1/n,

    z(t) = z_0 [1 + (m - 1) c]^(-1/(m - 1)),   c = mu t z_0^(m - 1) / k^m       m -> 1 (Bingham): z_0 e^-c

exact for every dt. The relaxed strain is stored as X = b_e - I. The stress is that of the mean shear rate of flow over
the step, q = tau_y + z_0 ((z_0 - z)/(z_0 c))^n: second order, and exact in steady flow however long the step (a half
relaxed stress, as in a Maxwell branch, is not if dt mu/k is above one). Dissipation q g >= 0. Simo and Hughes,
Computational Inelasticity (1998), sec. 1.7 and 2.7 (overstress); Yue et al. (2015) for the law in MPM.
"""

import functools
import math
from dataclasses import dataclass

import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import Values, check_elastic, check_names, check_range, lame, rows
from physics3d.materials.strain_memory import carried_strain, hencky_energy, store_strain
from physics3d.materials.tensors import log_strain, scalars
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class HerschelBulkley(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, yield_stress tau_y [Pa] in shear, consistency k [Pa s^n],
    flow_index n (below 1: the faster, the thinner)."""

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("youngs_modulus", "poissons_ratio", "yield_stress", "consistency", "flow_index")

    @property
    def example(self) -> dict[str, float]:  # shaving foam, stiffened
        return {
            "youngs_modulus": 1e4,
            "poissons_ratio": 0.3,
            "yield_stress": 100.0,
            "consistency": 30.0,
            "flow_index": 0.5,
        }

    @property
    def memory_rows(self) -> int:
        return 6

    def check_parameters(self, values: Values) -> None:
        check_names(values, self.parameters)
        check_elastic(values)
        check_range(values, "yield_stress", 0.0)
        check_range(values, "consistency", 0.0)
        check_range(values, "flow_index", 0.0, 2.0)

    def coefficients(self, values: Values) -> Float[Tensor, "5 n"]:
        self.check_parameters(values)
        mu, lam = lame(values["youngs_modulus"], values["poissons_ratio"])
        return rows(mu, lam + 2 / 3 * mu, values["yield_stress"], values["consistency"], 1 / values["flow_index"])

    def wave_modulus(self, coefficients: Float[Tensor, "5 n"]) -> Float[Tensor, " n"]:
        return coefficients[1] + 4 / 3 * coefficients[0]

    def energy(
        self, coefficients: Float[Tensor, "5 n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "6 n"]
    ) -> Float[Tensor, " n"]:
        return hencky_energy(coefficients[0], coefficients[1], memory)

    def advance(self, real: type) -> wp.Function:
        return _advance(real)


@functools.cache
def _decay(real: type) -> wp.Function:
    """decay(c, s) -> ln(1 + s c)/s, c itself for s = 0; at most `gone`, also where 1 + s c <= 0 (s < 0: the overstress
    is used up before the step ends)."""
    log1p = scalars.log1p(real)
    small = real(0.02 if real is wp.float32 else 0.003)  # y^6: 6e-11, 7e-16
    gone = real(60.0)

    @wp.func(name=f"decay_{real.__name__}")
    def decay(c: real, s: real):
        y = s * c
        if y <= real(-1.0):
            return gone
        if wp.abs(y) < small:
            series = real(1.0) / real(4.0) + y * (real(-1.0) / real(5.0) + y / real(6.0))
            return wp.min(
                c * (real(1.0) + y * (real(-1.0) / real(2.0) + y * (real(1.0) / real(3.0) - y * series))), gone
            )
        return wp.min(log1p(y) / s, gone)

    return decay


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    relax, carried, store = log_strain.relax(real), carried_strain(real), store_strain(real)
    decay, expm1, log1p = _decay(real), scalars.expm1(real), scalars.log1p(real)
    root2 = real(math.sqrt(2))
    most, least = real(80.0), real(1e-20)  # e^80 is still a float32

    @wp.func(name=f"herschel_bulkley_left_{real.__name__}")
    def left(q: real, tau_y: real, z: real, g: real):
        """-ln of what is left of q when the overstress falls from z to z e^-g; exact for small g and large q/tau_y."""
        change = z / q * expm1(-g)
        if change > real(-0.5):
            return -log1p(change)
        return -wp.log((tau_y + z * wp.exp(-g)) / q)

    @wp.func(name=f"herschel_bulkley_flow_{real.__name__}")
    def flow(dev: mat33, dt: real, mu: real, tau_y: real, k: real, m: real):
        """-ln of the factors left of dev eps, in the stress and in what is stored."""
        mean = real(0.0)
        full = real(0.0)
        size = wp.ddot(dev, dev)
        if dt > real(0.0) and real(2.0) * mu * mu * size > tau_y * tau_y:
            q = root2 * mu * wp.sqrt(size)
            z = q - tau_y
            if z > real(0.0):
                s = m - real(1.0)
                log_c = wp.log(dt * mu / k) + s * wp.log(z / k)
                c = wp.exp(wp.min(log_c, most))
                g = decay(c, s)
                full = left(q, tau_y, z, g)
                if c > least:
                    mean = left(q, tau_y, z, (log_c - wp.log(-expm1(-g))) / m)
        return mean, full

    @wp.func(name=f"herschel_bulkley_{real.__name__}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, K, tau_y [Pa], k [Pa s^n], 1/n
        memory: wp.array2d(dtype=real),  # upper triangle of b_e - I
        memory_next: wp.array2d(dtype=real),
    ):
        one = wp.identity(n=3, dtype=real)
        M = dt * L
        mu, K = coefficients[0, p], coefficients[1, p]
        X = carried(p, 0, M, memory)
        eps, _unrelaxed = relax(X, real(0.0), real(0.0))
        mean = wp.trace(eps) / real(3.0)
        dev = eps - mean * one
        relaxed, full = flow(dev, dt, mu, coefficients[2, p], coefficients[3, p], coefficients[4, p])
        _half, X_next = relax(X, full, real(0.0))
        store(p, 0, X_next, memory_next)
        return H + M + M * H, real(2.0) * mu * wp.exp(-relaxed) * dev + real(3.0) * K * mean * one

    return without_replay(advance)
