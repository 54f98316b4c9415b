"""The 3 x 3 blocks of K on its diagonal, for the preconditioner.

    K_ii ~ (16 dt/dx^2) sum_p V_p w_ip^2 (c_1 |r_ip|^2 I + c_2 r_ip r_ip^T),   r_ip = (x_i - x_p)/dx

C_p is replaced by the isotropic tensor with the same means: C_ab,cd r_b r_d -> c_1 |r|^2 I + c_2 r r^T.
"""

from functools import cache

import warp as wp

from physics3d.mpm.stencil import stencil
from physics3d.warp_types import matrix, vector


@cache
def diagonal(real) -> wp.Kernel:
    """Kernel: the blocks, in one pass over the particles."""
    vec3, mat33 = vector(real), matrix(real)
    first_node, local, weights, _ = stencil(real)

    @wp.kernel(module="unique", enable_backward=False)
    def diagonal_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] column 0: dt [s]
        row: wp.array(dtype=int),  # [1] the substep
        volume: wp.array(dtype=real),  # [p] at rest [m^3]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        moduli: wp.array2d(dtype=real),  # [p, 2] c_1, c_2 [Pa s]
        # out
        blocks: wp.array(dtype=mat33),  # [node], added to [kg]
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            weight = weights(f)
            factor = real(16.0) * clock[row[0], 0] * volume[p] / (dx * dx)
            c1, c2 = factor * moduli[p, 0], factor * moduli[p, 1]
            unit, one = wp.identity(n=3, dtype=real), real(1.0)
            rx = -f[0]
            for i in range(3):
                ry = -f[1]
                for j in range(3):
                    rz = -f[2]
                    for k in range(3):
                        s = weight[0, i] * weight[1, j] * weight[2, k]
                        r = vec3(rx, ry, rz)
                        block = (s * s * c1 * wp.dot(r, r)) * unit + (s * s * c2) * wp.outer(r, r)
                        wp.atomic_add(blocks, node + (i * ny + j) * nz + k, block)
                        rz = rz + one
                    ry = ry + one
                rx = rx + one

    return diagonal_kernel
