"""Foam, paste, dough: elastic below a yield stress, above it a fluid of Herschel and Bulkley.

    tau = 2 mu dev eps + K tr(eps) I,   eps = 1/2 ln b_e                        [Pa]
    q   = |dev tau| / sqrt(2)                                                   shear stress
    q   = tau_y + k g^n where it flows, g = sqrt(2) |D_p| shear rate of flow [1/s], D_p along dev tau

Flow relaxes the overstress z = q - tau_y alone: dz/dt = -mu (z/k)^(1/n). In closed form, with m = 1/n,

    z(t) = z_0 [1 + (m - 1) c]^(-1/(m - 1)),   c = mu t z_0^(m - 1) / k^m       m -> 1 (Bingham): z_0 e^-c

One step: the strain at the end of the last one, of overstress z_n, is set back to u z_n, carried by the flow to an
overstress z_0, and left with the stress of the mean shear rate of flow over the step, z_n+1 = k ((z_0 - z(dt))/(mu
dt))^n. A flow that goes on steadily comes from u z_n and ends there, z_n = k ((z_0 - u z_n)/(mu dt))^n: with c at z_n

    u = c/(e^r - 1),   r = ln(1 + (m - 1) c y^(m-1))/(m - 1),   y = c/(1 - e^-r)          by Newton's method

(for n = 1 it is g(c) of `tensors/decay.py`). Second order, whatever the steps, and exact in steady flow however long
they are. Dissipation q g >= 0. X = b_e - I is stored. Simo and Hughes, Computational Inelasticity (1998), sec. 1.7 and
2.7 (overstress); Yue et al. (2015) for the law in MPM.
"""

import functools
import math
from dataclasses import dataclass
from typing import Annotated

import warp as wp
from annotated_types import Gt, Lt
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import Positive
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.strain_memory import carry_strain, hencky_energy, load_strain, store_strain
from physics3d.materials.tensors import log_strain, scalars
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@dataclass(frozen=True, kw_only=True)
class HerschelBulkley(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, yield_stress tau_y [Pa] in shear, consistency k [Pa s^n],
    flow_index n (below 1: the faster, the thinner)."""

    RANGES = ELASTIC | {
        "yield_stress": Positive,  # tau_y: stress in shear below which it is a solid [Pa]
        "consistency": Positive,  # k: stress above that at a shear rate of 1/s [Pa s^n]
        "flow_index": Annotated[float, Gt(0), Lt(2)],  # n; below 1: the faster, the thinner
    }

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
def _rate(real: type) -> wp.Function:
    """rate(c, s) -> r of the docstring, s = m - 1; the derivative is that of a last step of Newton's method."""
    decay, expm1 = _decay(real), scalars.expm1(real)
    gone = real(60.0)

    @wp.func(name=f"herschel_bulkley_newton_{real.__name__}")
    def newton(r: real, c: real, s: real):
        y = c / -expm1(-r)
        C = c * wp.pow(y, s)
        f = r - decay(C, s)
        slope = real(1.0)
        if s * C > real(-1.0):
            slope = real(1.0) + s * C / (expm1(r) * (real(1.0) + s * C))
        return r - f / slope

    @wp.func(name=f"herschel_bulkley_root_{real.__name__}")
    def root(c: real, s: real):
        r = real(2.0) * wp.log(real(0.5) * c + wp.sqrt(real(1.0) + real(0.25) * c * c))  # exact for s = 1
        for _ in range(8):
            r = wp.clamp(newton(r, c, s), real(0.1) * r, wp.min(real(10.0) * r, gone))
        return r

    @wp.func_grad(root)
    def adj_root(c: real, s: real, adj_ret: real):
        wp.adjoint[c] += real(0.0) * adj_ret

    @wp.func(name=f"herschel_bulkley_rate_{real.__name__}")
    def rate(c: real, s: real):
        r = root(c, s)
        return wp.min(newton(r, c, s), gone)

    return rate


@functools.cache
def _advance(real: type) -> wp.Function:
    mat33 = matrix(real)
    load, carry, store = load_strain(real), carry_strain(real), store_strain(real)
    rescale, rate = log_strain.rescale(real), _rate(real)
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
        """-ln of the factor left of dev eps after the step that began with it."""
        mean = real(0.0)
        size = wp.ddot(dev, dev)
        if dt > real(0.0) and real(2.0) * mu * mu * size > tau_y * tau_y:
            q = root2 * mu * wp.sqrt(size)
            z = q - tau_y
            if z > real(0.0):
                s = m - real(1.0)
                log_c = wp.log(dt * mu / k) + s * wp.log(z / k)
                c = wp.exp(wp.min(log_c, most))
                g = decay(c, s)
                if c > least:
                    mean = left(q, tau_y, z, (log_c - wp.log(-expm1(-g))) / m)
        return mean

    @wp.func(name=f"herschel_bulkley_before_{real.__name__}")
    def before(dev: mat33, dt: real, mu: real, tau_y: real, k: real, m: real):
        """-ln of the factor by which dev eps of the last step is set back."""
        back = real(0.0)
        size = wp.ddot(dev, dev)
        if dt > real(0.0) and real(2.0) * mu * mu * size > tau_y * tau_y:
            q = root2 * mu * wp.sqrt(size)
            z = q - tau_y
            if z > real(0.0):
                s = m - real(1.0)
                c = wp.exp(wp.min(wp.log(dt * mu / k) + s * wp.log(z / k), most))
                if c > least:
                    r = rate(c, s)
                    back = left(q, tau_y, z, -wp.log(c / expm1(r)))
        return back

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
        tau_y, k, m = coefficients[2, p], coefficients[3, p], coefficients[4, p]
        X_n = load(p, 0, memory)
        eps_n, _same = rescale(X_n, real(1.0), real(1.0), real(0.0), real(0.0))
        back = before(eps_n - wp.trace(eps_n) / real(3.0) * one, dt, mu, tau_y, k, m)
        _eps_n, X_back = rescale(X_n, real(1.0), real(1.0), expm1(-back), real(0.0))
        X = carry(X_back, M)
        eps, _same = rescale(X, real(1.0), real(1.0), real(0.0), real(0.0))
        mean = wp.trace(eps) / real(3.0)
        dev = eps - mean * one
        relaxed = flow(dev, dt, mu, tau_y, k, m)
        _eps, X_next = rescale(X, real(1.0), real(1.0), expm1(-relaxed), real(0.0))
        store(p, 0, X_next, memory_next)
        return H + M + M * H, real(2.0) * mu * wp.exp(-relaxed) * dev + real(3.0) * K * mean * one

    return without_replay(advance)
