"""A particle moves on, u_p <- u_p + dt v_p, and its material turns (L_p, H_p) into the next H_p and its stress."""

from functools import cache

import warp as wp

from physics3d.warp_types import matrix, vector


@cache
def advance(real, material: wp.Function) -> wp.Kernel:
    """Kernel: the next displacement, deformation, internal variables and stress of particles."""
    vec3, mat33 = vector(real), matrix(real)

    @wp.kernel(module="unique")
    def advance_kernel(
        # in
        first: int,  # particle of thread 0
        clock: wp.array2d(dtype=real),  # [substep, k] column 0: dt [s]
        row: wp.array(dtype=int),  # [1] the substep
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
        H: wp.array(dtype=mat33),  # [p] F - I [1]
        coefficients: wp.array2d(dtype=real),  # [k, p] of the material
        memory: wp.array2d(dtype=real),  # [m, p] internal variables of the material
        # out
        u_next: wp.array(dtype=vec3),  # [p] [m]
        H_next: wp.array(dtype=mat33),  # [p] [1]
        memory_next: wp.array2d(dtype=real),  # [m, p]
        tau: wp.array(dtype=mat33),  # [p] Kirchhoff stress [Pa]
    ):
        p = wp.tid() + first
        dt = clock[row[0], 0]
        u_next[p] = u[p] + dt * v[p]
        deformation, stress = material(p, dt, L[p], H[p], coefficients, memory, memory_next)
        H_next[p] = deformation
        tau[p] = stress

    return advance_kernel
