"""Motion imposed on the body itself: selected particles get a velocity and its gradient from a boundary."""

from functools import cache

import warp as wp

from physics3d.mpm.hooks import Hook, columns_of
from physics3d.warp_types import matrix, vector


@cache
def steer(real, hooks: tuple[Hook, ...]) -> wp.Kernel:
    """Kernel: velocities and their gradients as the material sees them, from the gathered ones."""
    vec3, mat33 = vector(real), matrix(real)
    count = len(hooks)
    functions, a, b, rows = columns_of(hooks)

    @wp.kernel(module="unique")
    def steer_kernel(
        # in
        first: int,  # particle of thread 0
        clock: wp.array2d(dtype=real),  # [substep, k] dt [s], exp(-damping dt), signals of the boundaries
        row: wp.array(dtype=int),  # [1] the substep
        selection: wp.array2d(dtype=real),  # [boundary, p]
        rest: wp.array(dtype=vec3),  # [p] [m]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        v_gathered: wp.array(dtype=vec3),  # [p] [m/s]
        L_gathered: wp.array(dtype=mat33),  # [p] [1/s]
        # out
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
    ):
        p = wp.tid() + first
        r = row[0]
        x = rest[p] + u[p]
        speed = v_gathered[p]
        gradient = L_gathered[p]
        for i in range(wp.static(count)):
            weight = selection[wp.static(rows[i]), p]
            if weight != real(0.0):
                speed, gradient = wp.static(functions[i])(
                    weight, x, speed, gradient, q, wp.static(a[i]), clock, r, wp.static(b[i])
                )
        v[p] = speed
        L[p] = gradient

    return steer_kernel
