"""The three stages of the stress at points of a basis, as Warp kernels: L of an increment, tau by the material, P.

    L = (F - F_0) F_0^-1 / dt,    (H, tau, memory) = material(dt, L, H_0, memory),    P = w tau F^-T

H = F - I and P are held transposed, as the gradients of the basis are laid out (`stress.py`).
"""

import functools

import warp as wp


@functools.cache
def stages(function: wp.Function) -> tuple[tuple[wp.Kernel, tuple[str, ...], tuple[str, ...]], ...]:
    """(kernel, its inputs after dt, its outputs) of the three stages: one each, so that the adjoint of the constitutive
    function does not evaluate it again."""

    @wp.kernel(module="unique", enable_backward=True)
    def material_points(
        # in
        dt: wp.float64,  # [s]
        L: wp.array(dtype=wp.mat33d),  # velocity gradient [1/s]
        H_0: wp.array(dtype=wp.mat33d),  # [n] F - I transposed, at the start [1]
        coefficients: wp.array2d(dtype=wp.float64),  # [k, n] of the material
        memory: wp.array2d(dtype=wp.float64),  # [m, n] internal variables
        # out
        H_next: wp.array(dtype=wp.mat33d),  # [n] [1]
        tau: wp.array(dtype=wp.mat33d),  # [Pa]
        memory_next: wp.array2d(dtype=wp.float64),  # [m, n]
    ):
        p = wp.tid()
        H_p, tau_p = function(p, dt, L[p], wp.transpose(H_0[p]), coefficients, memory, memory_next)
        H_next[p] = H_p
        tau[p] = tau_p

    return (
        (_rate, ("H", "H_0"), ("L",)),
        (material_points, ("L", "H_0", "coefficients", "memory"), ("H_next", "tau", "memory_next")),
        (_force, ("tau", "H", "weight"), ("P",)),
    )


@wp.kernel
def _rate(
    # in
    dt: wp.float64,  # [s]
    H: wp.array(dtype=wp.mat33d),  # [n] F - I transposed [1]
    H_0: wp.array(dtype=wp.mat33d),  # [n] F - I transposed, at the start [1]
    # out
    L: wp.array(dtype=wp.mat33d),  # [1/s]
):
    p = wp.tid()
    one = wp.identity(n=3, dtype=wp.float64)
    L[p] = wp.transpose(wp.inverse(one + H_0[p]) * (H[p] - H_0[p])) / dt


@wp.kernel
def _force(
    # in
    dt: wp.float64,  # [s]
    tau: wp.array(dtype=wp.mat33d),  # [Pa]
    H: wp.array(dtype=wp.mat33d),  # [n] F - I transposed [1]
    weight: wp.array(dtype=wp.float64),  # [m^3]
    # out
    P: wp.array(dtype=wp.mat33d),  # transposed [J]
):
    p = wp.tid()
    one = wp.identity(n=3, dtype=wp.float64)
    P[p] = weight[p] * (wp.transpose(wp.inverse(one + H[p])) * tau[p])
