"""Viscoelastic solid of the paper: an elastic branch and 0 to 3 Maxwell branches in parallel, same total deformation.

    tau   = tau_E + sum_N tau_N                                                     [Pa], Kirchhoff
    psi_E = mu sum_i (s_i - 1)^2 + lam/2 (J - 1)^2                                  fixed corotated, F = V R
    tau_E = 2 mu (V^2 - V) + lam J (J - 1) I
    tau_N = 2 mu_N eps + lam_N tr(eps) I,   eps = 1/2 ln b_N                        Hencky spring
    d(dev eps)/dt = -k_d dev eps,   d(tr eps)/dt = -k_v tr eps                      dash-pot, [1/s]

One substep of a branch (Strang): b_N is carried by the flow, the stress is taken from the half-relaxed strain, the
fully relaxed strain is stored as X = b_N - I. Second order in dt, stable for every dt k; the stored strain is half a
step ahead.

`spring="neo_hookean"` replaces the Hencky spring, whose shear stress falls beyond a shear of 3
(`neo_hookean_branch.py`).

Liu et al. (arXiv 2406.04338); where and why we depart from it: docs/method.md.
"""

import functools
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
import warp as wp
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import MayBeInfinite, Positive, at_least_one, require_fields
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.neo_hookean_branch import maxwell_neo_hookean
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.strain_memory import carried_strain, hencky_energy, principal_log_strain, store_strain
from physics3d.materials.tensors import log_strain, polar, volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix

RelaxationTime = Annotated[float, Ge(1e-30), MayBeInfinite()]  # [s]
BRANCH = {
    "branch_shear_modulus": Positive,
    "branch_bulk_modulus": Positive,
    "shear_relaxation_time": RelaxationTime,
    "bulk_relaxation_time": RelaxationTime,
}


@dataclass(frozen=True, kw_only=True)
class Viscoelastic(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, and for every branch branch_shear_modulus (mu_N),
    branch_bulk_modulus (K_N) [Pa], shear_relaxation_time (1/k_d), bulk_relaxation_time (1/k_v) [s, inf: never relaxes];
    those of further branches end in _2, _3.

    Raises ValueError for a number of branches outside 0..3, an unknown spring, or nothing at all.
    """

    branches: Annotated[int, Ge(0), Le(3)] = 1
    elastic: bool = True  # the branch that never relaxes
    spring: Literal["hencky", "neo_hookean"] = "hencky"

    RULES = (at_least_one("elastic", "branches"),)  # else no stress is defined
    RANGES = ELASTIC | BRANCH

    def __post_init__(self) -> None:
        require_fields(self, type(self).__name__)

    @property
    def parameters(self) -> tuple[str, ...]:
        names = ("youngs_modulus", "poissons_ratio") if self.elastic else ()
        return names + tuple(name + suffix for suffix in self._suffixes for name in BRANCH)

    @property
    def example(self) -> dict[str, float]:
        found = {"youngs_modulus": 1e5, "poissons_ratio": 0.3} if self.elastic else {}  # soft tissue
        for i, suffix in enumerate(self._suffixes):
            found |= dict(zip((name + suffix for name in BRANCH), (4e4, 8e4, 0.2 / 4**i, 0.5 / 4**i), strict=True))
        return found

    @property
    def _suffixes(self) -> tuple[str, ...]:
        return ("", "_2", "_3")[: self.branches]

    @property
    def recovers(self) -> bool:
        return self.elastic

    @property
    def memory_rows(self) -> int:
        return 6 * self.branches

    def coefficients(self, values: Values) -> Float[Tensor, "k n"]:
        self.check_parameters(values)
        found = list(lame(values["youngs_modulus"], values["poissons_ratio"])) if self.elastic else []
        for suffix in self._suffixes:
            mu, K, shear_time, bulk_time = (values[name + suffix] for name in BRANCH)
            found += [mu, K, 1 / shear_time, 1 / bulk_time]
        return rows(*found)

    def wave_modulus(self, coefficients: Float[Tensor, "k n"]) -> Float[Tensor, " n"]:
        total = torch.zeros_like(coefficients[0])
        if self.elastic:
            total = total + coefficients[1] + 2 * coefficients[0]
        for i in range(self.branches):
            mu, K = coefficients[self._first(i) : self._first(i) + 2]
            total = total + K + 4 / 3 * mu
        return total

    def _first(self, branch: int) -> int:
        """Row of the first coefficient of a branch."""
        return (2 if self.elastic else 0) + 4 * branch

    def energy(
        self, coefficients: Float[Tensor, "k n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "m n"]
    ) -> Float[Tensor, " n"]:
        one = torch.eye(3, dtype=H.dtype, device=H.device)
        psi = torch.zeros_like(H[:, 0, 0])
        if self.elastic:
            mu, lam = coefficients[:2]
            J = volume.determinant(one + H)
            psi = psi + mu * polar.stretch_distance(H) + lam / 2 * (J - 1) ** 2
        for i in range(self.branches):
            mu, K = coefficients[self._first(i) : self._first(i) + 2]
            strain = memory[6 * i : 6 * i + 6]
            if self.spring == "hencky":
                psi = psi + hencky_energy(mu, K, strain)
            else:
                dev, log_J = principal_log_strain(strain)
                psi = psi + mu / 2 * torch.expm1(2 * dev).sum(1) + K / 2 * log_J**2
        return psi

    def advance(self, real: type) -> wp.Function:
        return _advance(self.branches, self.elastic, self.spring, real)


@functools.cache
def maxwell_hencky(real: type) -> wp.Function:
    """One step of a Hencky spring in series with a dash-pot, from the carried strain X = b - I, eps = 1/2 ln(I + X).

        maxwell(X, mu, K, d, v) -> (tau, X_next)      d, v = dt k_d, dt k_v
        tau    = 2 mu e^{-d/2} dev eps + K e^{-v/2} tr(eps) I                                    [Pa], as mu and K
        X_next = exp(2 [e^{-d} dev eps + e^{-v} tr(eps)/3 I]) - I

    Relaxation enters as expm1, so a slow one is an exact small increment of X and none leaves X as it is.
    `without_replay`.
    """
    mat33 = matrix(real)
    relaxed, adjoint = log_strain.relaxed(real), log_strain.adjoint_of_relaxed(real)

    @wp.func(name=f"maxwell_hencky_{real.__name__}")
    def maxwell(X: mat33, mu: real, K: real, d: real, v: real):
        tau, X_next = relaxed(X, mu, K, d, v)
        return tau, X_next

    @wp.func_grad(maxwell)
    def adj_maxwell(X: mat33, mu: real, K: real, d: real, v: real, adj_tau: mat33, adj_X_next: mat33):
        dh, vh = wp.exp(-real(0.5) * d), wp.exp(-real(0.5) * v)
        shear, df, vf = real(2.0) * mu * dh, dh * dh, vh * vh
        adj_X, dev_a, dev_b, mean, a, b = adjoint(X, shear, K * vh, df, vf, adj_tau, adj_X_next)
        wp.adjoint[X] += adj_X
        wp.adjoint[mu] += real(2.0) * dh * dev_a
        wp.adjoint[K] += real(3.0) * vh * mean * a
        wp.adjoint[d] += -real(0.5) * shear * dev_a - df * dev_b
        wp.adjoint[v] += -real(1.5) * K * vh * mean * a - vf * mean * b

    return without_replay(maxwell)


_MAXWELL = {"hencky": maxwell_hencky, "neo_hookean": maxwell_neo_hookean}


@functools.cache
def _corotated(real: type) -> wp.Function:
    """corotated(H, mu, lam) -> stress of the elastic branch."""
    mat33 = matrix(real)
    volume_change, cofactor = volume.volume_change(real), volume.cofactor(real)
    stretch, adjoint_of_stretch = polar.stretch(real), polar.adjoint_of_stretch(real)

    @wp.func(name=f"corotated_{real.__name__}")
    def corotated(H: mat33, mu: real, lam: real):
        Y = stretch(H)
        j = volume_change(H)
        return real(2.0) * mu * (Y + Y * Y) + lam * (real(1.0) + j) * j * wp.identity(n=3, dtype=real)

    @wp.func_grad(corotated)
    def adj_corotated(H: mat33, mu: real, lam: real, adj_ret: mat33):
        one = wp.identity(n=3, dtype=real)
        Y = stretch(H)
        j = volume_change(H)
        A = real(0.5) * (adj_ret + wp.transpose(adj_ret))
        AY = A * Y
        trace = wp.trace(A)
        F = one + H
        adj_Y = real(2.0) * mu * (A + AY + wp.transpose(AY))
        wp.adjoint[H] += adjoint_of_stretch(F, one + Y, adj_Y) + lam * (real(1.0) + real(2.0) * j) * trace * cofactor(F)
        wp.adjoint[mu] += real(2.0) * (wp.trace(AY) + wp.ddot(AY, Y))
        wp.adjoint[lam] += (real(1.0) + j) * j * trace

    return without_replay(corotated)


@functools.cache
def maxwell_branches(branches: int, spring: str, real: type) -> wp.Function:
    """all(p, dt, M, first, row, coefficients, memory, memory_next) -> stress of the branches, carried by I + M and
    relaxed over dt; their coefficients begin at row `first`, their memory at `row`."""
    mat33 = matrix(real)
    maxwell = _MAXWELL[spring](real)
    carried, store = carried_strain(real), store_strain(real)

    @wp.func(name=f"maxwell_branches_{branches}_{spring}_{real.__name__}")
    def all_branches(
        p: int,
        dt: real,  # [s]
        M: mat33,
        first: int,
        row: int,
        coefficients: wp.array2d(dtype=real),  # from `first`: mu_N, K_N [Pa], k_d, k_v [1/s] of each branch
        memory: wp.array2d(dtype=real),  # from `row`: upper triangle of b_N - I of each branch
        memory_next: wp.array2d(dtype=real),
    ):
        tau = mat33()
        for i in range(wp.static(branches)):
            k = first + 4 * i
            d, v = dt * coefficients[k + 2, p], dt * coefficients[k + 3, p]
            X_trial = carried(p, row + 6 * i, M, memory)
            tau_N, X = maxwell(X_trial, coefficients[k, p], coefficients[k + 1, p], d, v)
            store(p, row + 6 * i, X, memory_next)
            tau = tau + tau_N
        return tau

    return without_replay(all_branches)


@functools.cache
def _advance(branches: int, elastic: bool, spring: str, real: type) -> wp.Function:
    mat33 = matrix(real)
    corotated = _corotated(real)
    all_branches = maxwell_branches(branches, spring, real)
    key = f"{branches}_{'elastic' if elastic else 'viscous'}_{spring}_{real.__name__}"
    first = 2 if elastic else 0

    @wp.func(name=f"viscoelastic_{key}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, lam [Pa], then mu_N, K_N [Pa], k_d, k_v [1/s] of each branch
        memory: wp.array2d(dtype=real),  # upper triangle of b_N - I of each branch
        memory_next: wp.array2d(dtype=real),
    ):
        M = dt * L
        H_next = H + M + M * H
        tau = mat33()
        if wp.static(elastic):
            tau = tau + corotated(H_next, coefficients[0, p], coefficients[1, p])
        if wp.static(branches):
            tau = tau + all_branches(p, dt, M, first, 0, coefficients, memory, memory_next)
        return H_next, tau

    return without_replay(advance)
