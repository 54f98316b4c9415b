"""Touch: which nodes belong to particles that reach a boundary, for those boundaries that act on such nodes alone."""

from functools import cache

import warp as wp

from physics3d.mpm.hooks import Hook, columns_of
from physics3d.mpm.stencil import stencil
from physics3d.warp_types import vector


@cache
def mark(real, hooks: tuple[Hook, ...]) -> wp.Kernel:
    """Kernel: for each boundary that acts on touched nodes alone, stamp the nodes of the particles that touch it."""
    vec3 = vector(real)
    first_node, _, _, _ = stencil(real)
    count = len(hooks)
    functions, a, b, _ = columns_of(hooks)

    @wp.kernel(module="unique", enable_backward=False)
    def mark_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] dt [s], exp(-damping dt), signals of the boundaries
        row: wp.array(dtype=int),  # [1] the substep
        stamp: wp.array(dtype=int),  # [1] another one in every substep, so that nothing need be cleared
        rest: wp.array(dtype=vec3),  # [p] [m]
        radius: wp.array(dtype=real),  # [p] [m]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        # out
        touched: wp.array2d(dtype=int),  # [hook, node] the stamp: whoever writes, writes the same
    ):
        p = wp.tid() + first
        x = rest[p] + u[p]
        node = first_node(cell[p], offset[p] + u[p] / dx, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            for h in range(wp.static(count)):
                if wp.static(functions[h])(x, radius[p], q, wp.static(a[h]), clock, row[0], wp.static(b[h])):
                    for n in range(27):
                        touched[h, node + ((n / 9) * ny + (n / 3) % 3) * nz + n % 3] = stamp[0]

    return mark_kernel
