"""The product K w of node velocities w, without K: gather L_p(w), take C_p : L_p, scatter.

    (K w)_i = (16 dt/dx^2) sum_p V_p w_ip (C_p : sum_j w_jp w_j r_jp^T) r_ip,   r_ip = (x_i - x_p)/dx

C_p = dT/dL is the tangent of a particle, 9 x 9.
"""

from functools import cache

import warp as wp

from physics3d.mpm import columns
from physics3d.mpm.hooks import KICK
from physics3d.mpm.stencil import stencil
from physics3d.warp_types import matrix, vector, vector4


@cache
def stiffness(real, sums, fast: bool) -> wp.Kernel:
    """Kernel: K w, in one pass over the particles, added up in the precision of `sums` as by `scatter`."""
    vec3, vec4, mat33 = vector(real), vector4(sums), matrix(real)
    first_node, local, weights, _ = stencil(real)
    gathered, spread = columns.gathered(real, fast), columns.spread(real, fast, sums)

    @wp.kernel(module="unique", enable_backward=False)
    def stiffness_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] column KICK: how long forces act [s]
        row: wp.array(dtype=int),  # [1] the substep
        volume: wp.array(dtype=real),  # [p] at rest [m^3]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        C: wp.array2d(dtype=real),  # [p, 81] dT_ab/dL_ce [Pa s], at 27 a + 9 b + 3 c + e
        w: wp.array(dtype=vec3),  # [node] in any unit
        # out
        Kw: wp.array(dtype=vec4),  # [node], added to [kg times the unit of w]; the fourth number is of no use
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            weight = weights(f)
            S = gathered(w, node, ny, nz, f, weight)
            L = mat33(S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2])
            A = mat33()
            for a in range(3):
                for b in range(3):
                    total = real(0.0)
                    for c in range(3):
                        for e in range(3):
                            total = total + C[p, 27 * a + 9 * b + 3 * c + e] * L[c, e]
                    A[a, b] = total
            A = (real(16.0) * clock[row[0], wp.static(KICK)] * volume[p] / (dx * dx)) * A
            spread(Kw, node, ny, nz, f, weight, vec3(), real(0.0), A)

    return stiffness_kernel
