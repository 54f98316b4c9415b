"""The stress that an implicit step puts on the nodes, and its adjoint.

    T_p = tau_p (I + dt L_p)^-T                                              [Pa]
    adj tau = E A^-1,   adj L = -dt A^-T E^T T,   A = I + dt L,  E = adj T

T = P F_n^T with P the first Piola-Kirchhoff stress at the end of the step and F_n the deformation at its start.
"""

from functools import cache

import warp as wp

from physics3d.warp_types import matrix

FLATTEST = 0.05  # det(I + dt L): a step that squeezes a particle to less is too long


@cache
def stress(real) -> wp.Kernel:
    """Kernel: T = tau (I + dt L)^-T, and a count of the particles that the step would fold."""
    mat33 = matrix(real)

    @wp.kernel(module="unique", enable_backward=False)
    def stress_kernel(
        # in
        first: int,  # particle of thread 0
        clock: wp.array2d(dtype=real),  # [substep, k] column 0: dt [s]
        row: wp.array(dtype=int),  # [1] the substep
        L: wp.array(dtype=mat33),  # [p] at the end of the step [1/s]
        tau: wp.array(dtype=mat33),  # [p] Kirchhoff stress [Pa]
        # out
        T: wp.array(dtype=mat33),  # [p] [Pa]
        folded: wp.array(dtype=int),  # [1] added to
    ):
        p = wp.tid() + first
        A = wp.identity(n=3, dtype=real) + clock[row[0], 0] * L[p]
        if wp.determinant(A) > real(FLATTEST):
            T[p] = tau[p] * wp.transpose(wp.inverse(A))
        else:
            T[p] = mat33()
            wp.atomic_add(folded, 0, 1)

    return stress_kernel


@cache
def stress_adjoint(real) -> wp.Kernel:
    """Kernel: adjoint of `stress`, written, not added."""
    mat33 = matrix(real)

    @wp.kernel(module="unique", enable_backward=False)
    def stress_adjoint_kernel(
        # in
        first: int,  # particle of thread 0
        clock: wp.array2d(dtype=real),  # [substep, k] column 0: dt [s]
        row: wp.array(dtype=int),  # [1] the substep
        L: wp.array(dtype=mat33),  # [p] at the end of the step [1/s]
        T: wp.array(dtype=mat33),  # [p] [Pa]
        adjoint_T: wp.array(dtype=mat33),  # [p]
        # out
        adjoint_tau: wp.array(dtype=mat33),  # [p]
        adjoint_L: wp.array(dtype=mat33),  # [p]
    ):
        p = wp.tid() + first
        dt = clock[row[0], 0]
        inverse = wp.inverse(wp.identity(n=3, dtype=real) + dt * L[p])
        E = adjoint_T[p]
        adjoint_tau[p] = E * inverse
        adjoint_L[p] = -dt * (wp.transpose(inverse) * wp.transpose(E) * T[p])

    return stress_adjoint_kernel
