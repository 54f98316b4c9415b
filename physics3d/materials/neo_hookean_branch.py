"""A neo-Hookean spring in series with a dash-pot: its shear stress never falls, however large the shear.

    tau_N    = mu_N dev(b~) + K_N ln J_N I,   b~ = J_N^(-2/3) b_N                   [Pa]
    d eps/dt = -(k_d/2) dev(b~),   d(tr eps)/dt = -k_v tr eps                       eps = 1/2 ln b_N, k in 1/s

Along that flow b~^-1 stays on the ray b~_0^-1 + s I scaled to determinant one, ds/dt = k_d det(b~_0^-1 + s I)^(1/3); s
is taken from its expansion s = (exp(m k_d t) - 1)/m, m = tr(b~_0)/3: no eigendecomposition, second order like the
Hencky branch (`viscoelastic.py`). Reese and Govindjee (1998).
"""

import functools

import warp as wp

from physics3d.materials.tensors import scalars, volume
from physics3d.warp_types import matrix


@functools.cache
def maxwell_neo_hookean(real: type) -> wp.Function:
    """maxwell(X, mu, K, d, v) -> (tau, X_next), as `viscoelastic.maxwell_hencky`. b~ = I + B, b~^-1 = I + W; W/(1 + s)
    is W relaxed before it is scaled to determinant one."""
    mat33 = matrix(real)
    log_det, expm1 = volume.log_det(real), scalars.expm1(real)
    unimodular_inverse = volume.unimodular_inverse(real)

    @wp.func(name=f"maxwell_neo_hookean_{real.__name__}")
    def maxwell(X: mat33, mu: real, K: real, d: real, v: real):
        one = wp.identity(n=3, dtype=real)
        log_J = real(0.5) * log_det(X)
        W = unimodular_inverse(X)
        m = wp.max(real(1.0) + wp.trace(unimodular_inverse(W)) / real(3.0), real(1.0))
        half = unimodular_inverse(W / (real(1.0) + expm1(wp.min(real(0.5) * m * d, real(60.0))) / m))
        full = unimodular_inverse(W / (real(1.0) + expm1(wp.min(m * d, real(60.0))) / m))
        tau = mu * (half - wp.trace(half) / real(3.0) * one) + K * wp.exp(-real(0.5) * v) * log_J * one
        g = expm1(real(2.0) / real(3.0) * wp.exp(-v) * log_J)
        return tau, (real(1.0) + g) * full + g * one

    return maxwell
