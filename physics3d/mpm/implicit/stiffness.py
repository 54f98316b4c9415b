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
    contracted = _contracted(real, fast)
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
        C: wp.array2d(dtype=real),  # [p, 81] dT_ab/dL_ce [Pa s], at 27 c + 9 e + 3 a + b
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
            A = contracted(C, p, L)
            A = (real(16.0) * clock[row[0], wp.static(KICK)] * volume[p] / (dx * dx)) * A
            spread(Kw, node, ny, nz, f, weight, vec3(), real(0.0), A)

    return stiffness_kernel


@cache
def _contracted(real, fast: bool) -> wp.Function:
    """contracted(C, p, L): C_p : L. The fast form is the same in Clang's vectors, column by column."""
    mat33 = matrix(real)

    if fast:
        name = {wp.float32: "float", wp.float64: "double"}[real]

        @wp.func_native(
            f"""
            typedef {name} T;
            typedef T V __attribute__((vector_size(4 * sizeof(T)), aligned(sizeof(T)), may_alias));
            const T* column = (const T*)C.data + 81 * (size_t)p;
            V first = {{}}, second = {{}};
            T last = 0;
            #pragma unroll
            for (int k = 0; k < 9; ++k, column += 9) {{
                const T l = L.data[k / 3][k % 3];
                first += l * *(const V*)column;
                second += l * *(const V*)(column + 4);
                last += l * column[8];
            }}
            return wp::mat_t<3, 3, T>(
                first[0], first[1], first[2], first[3], second[0], second[1], second[2], second[3], last
            );
            """
        )
        def native(C: wp.array2d(dtype=real), p: int, L: mat33) -> mat33: ...

        return native

    @wp.func
    def plain(C: wp.array2d(dtype=real), p: int, L: mat33):
        A = mat33()
        for a in range(3):
            for b in range(3):
                total = real(0.0)
                for c in range(3):
                    for e in range(3):
                        total = total + C[p, 27 * c + 9 * e + 3 * a + b] * L[c, e]
                A[a, b] = total
        return A

    return plain
