"""Forces from outside: v_p <- v_p + dt sum_b a_b(x_p), over the boundaries b that push the particle."""

from functools import cache

import warp as wp

from physics3d.mpm.hooks import Hook, columns_of
from physics3d.warp_types import vector


@cache
def push(real, hooks: tuple[Hook, ...]) -> wp.Kernel:
    """Kernel: the velocities with which particles are scattered."""
    vec3 = vector(real)
    count = len(hooks)
    functions, a, b, rows = columns_of(hooks)

    @wp.kernel(module="unique")
    def push_kernel(
        # in
        first: int,  # particle of thread 0
        clock: wp.array2d(dtype=real),  # [substep, k] dt [s], exp(-damping dt), signals of the boundaries
        row: wp.array(dtype=int),  # [1] the substep
        selection: wp.array2d(dtype=real),  # [boundary, p]
        rest: wp.array(dtype=vec3),  # [p] [m]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        v: wp.array(dtype=vec3),  # [p] [m/s]
        # out
        v_pushed: wp.array(dtype=vec3),  # [p] [m/s]
    ):
        p = wp.tid() + first
        r = row[0]
        dt = clock[r, 0]
        x = rest[p] + u[p]
        total = v[p]
        for i in range(wp.static(count)):
            weight = selection[wp.static(rows[i]), p]
            if weight != real(0.0):
                total = total + dt * wp.static(functions[i])(weight, x, q, wp.static(a[i]), clock, r, wp.static(b[i]))
        v_pushed[p] = total

    return push_kernel
