"""A neo-Hookean spring in series with a dash-pot: sheared further, it never pulls less.

    tau_N = mu_N dev(b~) + K_N ln J_N I,   b~ = J_N^(-2/3) b_N                       [Pa], eps = 1/2 ln b_N

with one of two dash-pots, which agree at small strain; d(tr eps)/dt = -k_v tr eps in both:

    log_strain   d(dev eps)/dt = -k_d dev eps           the flow of the paper (`viscoelastic.py`): strain held in any
                                                        amount decays as e^(-k_d t)
    stress       d(dev eps)/dt = -(k_d/2) dev(b~)       flow along the stress, dev tau_N = 2 (mu_N/k_d) D_viscous: the
                                                        larger the strain, the faster it decays; in steady shear the
                                                        stress falls beyond a shear of 2 (Reese and Govindjee 1998)

Along the second flow b~^-1 stays on the ray b~_0^-1 + s I scaled to determinant one, ds/dt = k_d det(b~_0^-1 + s
I)^(1/3); s is taken from its expansion s = (exp(m k_d t) - 1)/m, m = tr(b~_0)/3: no eigendecomposition, second order.

One step of dt as in `viscoelastic.py`, but the strain is stored as it is: it relaxes before it is carried as long as it
takes to fall by g, and after it as long as it takes to fall by w (`tensors/decay.py`), so that slow flow is exact.
"""

import functools

import warp as wp

from physics3d.materials.tensors import decay, log_strain, scalars, volume
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@functools.cache
def neo_hookean_branch(flow: str, real: type) -> tuple[wp.Function, wp.Function, wp.Function]:
    """(prepare, relax, ahead), as `viscoelastic.hencky_branch`; nothing is stored ahead."""
    mat33 = matrix(real)
    mean_decay, share_left = decay.mean_decay(real), decay.share_left(real)
    decayed = _log_strain_flow(real) if flow == "log_strain" else _stress_flow(real)
    stress = _stress(real)

    @wp.func(name=f"neo_hookean_prepare_{flow}_{real.__name__}")
    def prepare(X: mat33, ahead: real, dt: real, k_d: real, k_v: real):
        left = X
        if dt > real(0.0):
            left = decayed(X, share_left(k_d * dt), share_left(k_v * dt))
        return left

    @wp.func(name=f"neo_hookean_relax_{flow}_{real.__name__}")
    def relax(X: mat33, mu: real, K: real, d: real, v: real):
        _w_d, less_d = mean_decay(d)
        _w_v, less_v = mean_decay(v)
        X_next = decayed(X, less_d, less_v)
        return stress(X_next, mu, K), X_next

    @wp.func(name=f"neo_hookean_ahead_{flow}_{real.__name__}")
    def ahead(dt: real, d: real, v: real):
        return real(0.0)

    return prepare, without_replay(relax), ahead


@functools.cache
def _stress(real: type) -> wp.Function:
    """stress(X, mu, K) -> tau_N."""
    mat33 = matrix(real)
    log_det, expm1 = volume.log_det(real), scalars.expm1(real)

    @wp.func(name=f"neo_hookean_stress_{real.__name__}")
    def stress(X: mat33, mu: real, K: real):
        one = wp.identity(n=3, dtype=real)
        log_J = real(0.5) * log_det(X)
        scale = real(1.0) + expm1(-real(2.0) / real(3.0) * log_J)  # J^(-2/3)
        return mu * scale * (X - wp.trace(X) / real(3.0) * one) + K * log_J * one

    return stress


@functools.cache
def _log_strain_flow(real: type) -> wp.Function:
    """decayed(X, d, v) -> X with the factors 1 + d on dev eps and 1 + v on tr eps."""
    mat33, rescale = matrix(real), log_strain.rescale(real)

    @wp.func(name=f"log_strain_flow_{real.__name__}")
    def decayed(X: mat33, d: real, v: real):
        _A, left = rescale(X, real(0.0), real(0.0), d, v)
        return left

    return decayed


@functools.cache
def _stress_flow(real: type) -> wp.Function:
    """decayed(X, d, v) -> X as long after as a small dev eps takes to fall by the factor 1 + d, and tr eps by 1 + v.

    b~ = I + B, b~^-1 = I + W; W/(1 + s) is W relaxed before it is scaled to determinant one."""
    mat33 = matrix(real)
    log_det, unimodular_inverse = volume.log_det(real), volume.unimodular_inverse(real)
    expm1, log1p = scalars.expm1(real), scalars.log1p(real)
    least, most = real(1e-6 if real is wp.float32 else 1e-14), real(60.0)  # what rounding leaves of 1 + d

    @wp.func(name=f"stress_flow_{real.__name__}")
    def decayed(X: mat33, d: real, v: real):
        one = wp.identity(n=3, dtype=real)
        log_J = real(0.5) * log_det(X)
        W = unimodular_inverse(X)
        m = wp.max(real(1.0) + wp.trace(unimodular_inverse(W)) / real(3.0), real(1.0))
        time = -log1p(wp.max(d, least - real(1.0)))
        B = unimodular_inverse(W / (real(1.0) + expm1(wp.min(m * time, most)) / m))
        g = expm1(real(2.0) / real(3.0) * (real(1.0) + v) * log_J)
        return (real(1.0) + g) * B + g * one

    return decayed
