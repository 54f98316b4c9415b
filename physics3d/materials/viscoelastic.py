"""Viscoelastic solid of the paper: an elastic branch and 0 to 3 Maxwell branches in parallel, same total deformation.

    tau   = tau_E + sum_N tau_N                                                     [Pa], Kirchhoff
    psi_E = mu sum_i (s_i - 1)^2 + lam/2 (J - 1)^2                                  fixed corotated, F = V R
    tau_E = 2 mu (V^2 - V) + lam J (J - 1) I                                        J integrated by itself
    tau_N = 2 mu_N eps + lam_N tr(eps) I,   eps = 1/2 ln b_N                        Hencky spring
    d(dev eps)/dt = -k_d dev eps,   d(tr eps)/dt = -k_v tr eps                      dash-pot, [1/s]

One step of a branch, x = k dt: what is left of the strain of the last step, g(x) eps_n, is carried by the flow, and all
of it decays by w(x), with g = x/(e^x - 1), w = (1 - e^-x)/x (`tensors/decay.py`):

    b_tr = (I + dt L) exp(2 g eps_n) (I + dt L)^T,   eps_n+1 = w 1/2 ln b_tr,   tau_N from eps_n+1

Exact, whatever the steps, where stretching keeps its axes and within each step its rate, at rest, and in slow flow;
else of second order; stable for every x. As w and the g of the next step follow each other, one decomposition does
both: after a short step the strain is stored ahead, times the g of another step like it, together with that step's
length. A step of another length begins by the quotient of the two, and one of no length finds the stress at the end of
the last.

`spring="neo_hookean"` replaces the Hencky spring, whose shear stress falls beyond a shear of 3, `flow` chooses its
dash-pot (`neo_hookean_branch.py`); with a Hencky spring both are the same.

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
from physics3d.materials.neo_hookean_branch import neo_hookean_branch
from physics3d.materials.parameters import ELASTIC, Values, lame, rows
from physics3d.materials.strain_memory import carry_strain, load_strain, principal_log_strain, store_strain
from physics3d.materials.tensors import decay, log_strain, polar, scalars, volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix

RelaxationTime = Annotated[float, Ge(1e-30), MayBeInfinite()]  # [s]
BRANCH = {
    "branch_shear_modulus": Positive,  # mu_N: what the branch adds to the stiffness in shear of fast motion [Pa]
    "branch_bulk_modulus": Positive,  # K_N: and to that against a change of volume [Pa]
    "shear_relaxation_time": RelaxationTime,  # 1/k_d: after which its stress in shear has fallen to 37 % [s]
    "bulk_relaxation_time": RelaxationTime,  # 1/k_v: and that of its pressure; inf: never [s]
}


@dataclass(frozen=True, kw_only=True)
class Viscoelastic(AbstractMaterial):
    """Parameters: youngs_modulus [Pa], poissons_ratio, and for every branch branch_shear_modulus (mu_N),
    branch_bulk_modulus (K_N) [Pa], shear_relaxation_time (1/k_d), bulk_relaxation_time (1/k_v) [s, inf: never relaxes];
    those of further branches end in _2, _3.

    spring: what is stretched in a branch; flow: what its dash-pot follows, the logarithmic strain or the stress.

    Raises ValueError for a number of branches outside 0..3, an unknown spring or flow, or nothing at all.
    """

    branches: Annotated[int, Ge(0), Le(3)] = 1
    elastic: bool = True  # the branch that never relaxes
    spring: Literal["hencky", "neo_hookean"] = "hencky"
    flow: Literal["log_strain", "stress"] = "log_strain"

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
        return self._first_memory + 7 * self.branches

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

    @property
    def _first_memory(self) -> int:
        """Row of the first branch: before it stands J - 1 of the elastic one."""
        return 1 if self.elastic else 0

    def energy(
        self, coefficients: Float[Tensor, "k n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "m n"]
    ) -> Float[Tensor, " n"]:
        psi = torch.zeros_like(H[:, 0, 0])
        if self.elastic:
            mu, lam = coefficients[:2]
            psi = psi + mu * polar.stretch_distance(H) + lam / 2 * volume.change(H) ** 2
        for i in range(self.branches):
            mu, K = coefficients[self._first(i) : self._first(i) + 2]
            k_d, k_v = coefficients[self._first(i) + 2 : self._first(i) + 4]
            row = self._first_memory + 7 * i
            strain, ahead = memory[row : row + 6], memory[row + 6]
            dev, log_J = principal_log_strain(strain)
            # at the end of the step: what is ahead has relaxed by g already
            dev, log_J = dev * _grown(k_d * ahead)[:, None], log_J * _grown(k_v * ahead)
            shear = (dev**2).sum(1) if self.spring == "hencky" else torch.expm1(2 * dev).sum(1) / 2
            psi = psi + mu * shear + K / 2 * log_J**2
        return psi

    def advance(self, real: type) -> wp.Function:
        return _advance(self.branches, self.elastic, self.spring, self.flow, real)


_NEAR = 1.0  # relaxation times: after a longer step the strain is stored as it is, after a shorter one ahead


def _grown(x: Tensor) -> Tensor:
    """1/g = (e^x - 1)/x (`tensors/decay.py`)."""
    return torch.where(x > 0, torch.expm1(x) / x.clamp(min=1e-30), 1.0)


@functools.cache
def hencky_branch(real: type) -> tuple[wp.Function, wp.Function, wp.Function]:
    """A Hencky spring in series with a dash-pot, one step of dt: (prepare, relax, ahead), eps = 1/2 ln(I + X).

        prepare(X, ahead, dt, k_d, k_v) -> X        dev eps g(k_d dt)/g(k_d ahead), tr eps likewise
        relax(X, mu, K, d, v) -> (tau, X_next)      d, v = k_d dt, k_v dt, of the carried X
            tau      = 2 mu w(d) dev eps + K w(v) tr(eps) I                                      [Pa], as mu and K
            eps_next = w(d) dev eps + w(v) tr(eps)/3 I, or e^-d, e^-v: ahead of the next step
        ahead(dt, d, v) -> dt if the strain is stored ahead of a next step of dt, else 0             [s]

    Relaxation enters as factors less one, so a slow one is an exact small increment of X and none leaves X as it is.
    """
    mat33 = matrix(real)
    rescale, rescaled = log_strain.rescale(real), log_strain.rescaled(real)
    adjoint, expm1 = log_strain.adjoint_of_rescaled(real), scalars.expm1(real)
    mean_decay, slope, share_left = decay.mean_decay(real), decay.mean_decay_slope(real), decay.share_left(real)
    near = real(_NEAR)

    @wp.func(name=f"hencky_prepare_{real.__name__}")
    def prepare(X: mat33, ahead: real, dt: real, k_d: real, k_v: real):
        left = X
        if ahead != dt:
            had_d, had_v = share_left(k_d * ahead), share_left(k_v * ahead)
            d = (share_left(k_d * dt) - had_d) / (real(1.0) + had_d)
            v = (share_left(k_v * dt) - had_v) / (real(1.0) + had_v)
            _A, rescaled_X = rescale(X, real(0.0), real(0.0), d, v)
            left = rescaled_X
        return left

    @wp.func(name=f"hencky_relax_{real.__name__}")
    def relax(X: mat33, mu: real, K: real, d: real, v: real):
        w_d, less_d = mean_decay(d)
        w_v, less_v = mean_decay(v)
        if wp.max(d, v) < near:
            less_d, less_v = expm1(-d), expm1(-v)
        tau, X_next = rescaled(X, real(2.0) * mu * w_d, real(3.0) * K * w_v, less_d, less_v)
        return tau, X_next

    @wp.func_grad(relax)
    def adj_relax(X: mat33, mu: real, K: real, d: real, v: real, adj_tau: mat33, adj_X_next: mat33):
        w_d, less_d = mean_decay(d)
        w_v, less_v = mean_decay(v)
        slope_d, slope_v = slope(d, less_d), slope(v, less_v)
        stored_d, stored_v = slope_d, slope_v
        if wp.max(d, v) < near:
            less_d, less_v = expm1(-d), expm1(-v)
            stored_d, stored_v = -wp.exp(-d), -wp.exp(-v)
        shear, pressure = real(2.0) * mu * w_d, real(3.0) * K * w_v
        adj_X, adj_shear, adj_pressure, adj_d, adj_v = adjoint(X, shear, pressure, less_d, less_v, adj_tau, adj_X_next)
        wp.adjoint[X] += adj_X
        wp.adjoint[mu] += real(2.0) * w_d * adj_shear
        wp.adjoint[K] += real(3.0) * w_v * adj_pressure
        wp.adjoint[d] += real(2.0) * mu * slope_d * adj_shear + stored_d * adj_d
        wp.adjoint[v] += real(3.0) * K * slope_v * adj_pressure + stored_v * adj_v

    @wp.func(name=f"hencky_ahead_{real.__name__}")
    def ahead(dt: real, d: real, v: real):
        result = real(0.0)
        if wp.max(d, v) < near:
            result = dt
        return result

    return prepare, without_replay(relax), ahead


@functools.cache
def _corotated(real: type) -> wp.Function:
    """corotated(H, j, mu, lam) -> stress of the elastic branch, j = J - 1."""
    mat33 = matrix(real)
    stretch, adjoint_of_stretch = polar.stretch(real), polar.adjoint_of_stretch(real)

    @wp.func(name=f"corotated_{real.__name__}")
    def corotated(H: mat33, j: real, mu: real, lam: real):
        Y = stretch(H)
        return real(2.0) * mu * (Y + Y * Y) + lam * (real(1.0) + j) * j * wp.identity(n=3, dtype=real)

    @wp.func_grad(corotated)
    def adj_corotated(H: mat33, j: real, mu: real, lam: real, adj_ret: mat33):
        one = wp.identity(n=3, dtype=real)
        Y = stretch(H)
        A = real(0.5) * (adj_ret + wp.transpose(adj_ret))
        AY = A * Y
        trace = wp.trace(A)
        adj_Y = real(2.0) * mu * (A + AY + wp.transpose(AY))
        wp.adjoint[H] += adjoint_of_stretch(one + H, one + Y, adj_Y)
        wp.adjoint[j] += lam * (real(1.0) + real(2.0) * j) * trace
        wp.adjoint[mu] += real(2.0) * (wp.trace(AY) + wp.ddot(AY, Y))
        wp.adjoint[lam] += (real(1.0) + j) * j * trace

    return without_replay(corotated)


@functools.cache
def maxwell_branches(branches: int, spring: str, flow: str, real: type) -> wp.Function:
    """all(p, dt, M, first, row, coefficients, memory, memory_next) -> stress of the branches, carried by I + M and
    relaxed over dt; their coefficients begin at row `first`, their memory at `row`."""
    mat33 = matrix(real)
    prepare, relax, ahead = hencky_branch(real) if spring == "hencky" else neo_hookean_branch(flow, real)
    load, carry, store = load_strain(real), carry_strain(real), store_strain(real)

    @wp.func(name=f"maxwell_branches_{branches}_{spring}_{flow}_{real.__name__}")
    def all_branches(
        p: int,
        dt: real,  # [s]
        M: mat33,
        first: int,
        row: int,
        coefficients: wp.array2d(dtype=real),  # from `first`: mu_N, K_N [Pa], k_d, k_v [1/s] of each branch
        memory: wp.array2d(dtype=real),  # from `row`: upper triangle of b_N - I, by how much it is ahead [s]
        memory_next: wp.array2d(dtype=real),
    ):
        tau = mat33()
        for i in range(wp.static(branches)):
            k, m = first + 4 * i, row + 7 * i
            d, v = dt * coefficients[k + 2, p], dt * coefficients[k + 3, p]
            X_left = prepare(load(p, m, memory), memory[m + 6, p], dt, coefficients[k + 2, p], coefficients[k + 3, p])
            tau_N, X = relax(carry(X_left, M), coefficients[k, p], coefficients[k + 1, p], d, v)
            store(p, m, X, memory_next)
            memory_next[m + 6, p] = ahead(dt, d, v)
            tau = tau + tau_N
        return tau

    return without_replay(all_branches)


@functools.cache
def _advance(branches: int, elastic: bool, spring: str, flow: str, real: type) -> wp.Function:
    mat33 = matrix(real)
    corotated, carried_volume = _corotated(real), volume.carried_volume(real)
    all_branches = maxwell_branches(branches, spring, flow, real)
    key = f"{branches}_{'elastic' if elastic else 'viscous'}_{spring}_{flow}_{real.__name__}"
    first, row = (2, 1) if elastic else (0, 0)

    @wp.func(name=f"viscoelastic_{key}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # mu, lam [Pa], then mu_N, K_N [Pa], k_d, k_v [1/s] of each branch
        memory: wp.array2d(dtype=real),  # J - 1, then of each branch b_N - I and its lead [s]
        memory_next: wp.array2d(dtype=real),
    ):
        M = dt * L
        H_next = H + M + M * H
        tau = mat33()
        if wp.static(elastic):
            j = carried_volume(memory[0, p], M)
            memory_next[0, p] = j
            tau = tau + corotated(H_next, j, coefficients[0, p], coefficients[1, p])
        if wp.static(branches):
            tau = tau + all_branches(p, dt, M, first, row, coefficients, memory, memory_next)
        return H_next, tau

    return without_replay(advance)
