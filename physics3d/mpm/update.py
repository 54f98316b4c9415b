"""The grid's part of a substep: v_i = e^(-c dt) (p_i/m_i + dt g), then what the boundaries make of it.

A node lighter than `mass_floor` stays at rest. Where walls mirror, a node near one first folds in the momenta of its
images, and a node behind one takes the velocity of what it is the image of.
"""

from functools import cache

import warp as wp

from physics3d.mpm.hooks import Hook, columns_of
from physics3d.mpm.mirror import mirror
from physics3d.mpm.stencil import node_number
from physics3d.warp_types import vector, vector4


@cache
def update(real, hooks: tuple[Hook, ...], touches: tuple[Hook, ...], mirrored: bool) -> wp.Kernel:
    """Kernel: velocities of nodes from their momenta. `touches`: of the boundaries that act on touched nodes alone."""
    vec3, vec4 = vector(real), vector4(real)
    flip, folded = mirror(real)
    count = len(hooks)
    functions, a, b, rows = columns_of(hooks)
    # of the boundary of each hook, its place among those that act on touched nodes alone, or -1
    mark_row = {hook.boundary: place for place, hook in enumerate(touches)}
    marks = tuple(mark_row.get(row, -1) for row in rows)

    @wp.kernel(module="unique")
    def update_kernel(
        # in
        first: int,  # node of thread 0
        dx: real,  # [m]
        origin: vec3,  # place of node (0, 0, 0) [m]
        gravity: vec3,  # [m/s^2]
        mass_floor: real,  # lighter nodes stay at rest [kg]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] dt [s], exp(-damping dt), signals of the boundaries
        row: wp.array(dtype=int),  # [1] the substep
        walls: wp.array(dtype=int),  # [12] see `mirror`
        stamp: wp.array(dtype=int),  # [1] of what is touched in this substep
        touched: wp.array2d(dtype=int),  # [hook, node]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        grid: wp.array(dtype=vec4),  # [node] momentum [kg m/s], mass [kg]
        # out
        node_velocity: wp.array(dtype=vec3),  # [node] [m/s]
    ):
        n = wp.tid() + first
        r = row[0]
        k = n % window[5]
        j = (n / window[5]) % window[4]
        i = n / (window[5] * window[4])
        at = wp.vec3i(window[0] + i, window[1] + j, window[2] + k)
        node = grid[n]
        here = n
        sign = vec3(real(1.0), real(1.0), real(1.0))
        if wp.static(mirrored):
            near = 0
            for axis in range(3):
                below, above = at[axis] - walls[axis], walls[3 + axis] - at[axis]
                if below == -1:
                    at[axis] = at[axis] + 2
                    sign = wp.cw_mul(sign, flip(axis, walls[6 + axis]))
                elif above == -1:
                    at[axis] = at[axis] - 2
                    sign = wp.cw_mul(sign, flip(axis, walls[9 + axis]))
                if wp.abs(below) == 1 or wp.abs(above) == 1:
                    near = 1
            if near == 1:
                node = folded(at, window, walls, grid)
                # a mirror image obeys what its original does
                here = node_number(at, window)
        m = node[3]
        v = vec3()
        if m > mass_floor:
            v = clock[r, 1] * (vec3(node[0], node[1], node[2]) / m + clock[r, 0] * gravity)
            x = origin + dx * vec3(real(at[0]), real(at[1]), real(at[2]))
            for h in range(wp.static(count)):
                if wp.static(marks[h] < 0):
                    v = wp.static(functions[h])(x, v, q, wp.static(a[h]), clock, r, wp.static(b[h]))
                elif here >= 0 and touched[wp.static(marks[h]), wp.max(here, 0)] == stamp[0]:
                    # both sides of this `and` are computed
                    v = wp.static(functions[h])(x, v, q, wp.static(a[h]), clock, r, wp.static(b[h]))
        if wp.static(mirrored):
            v = wp.cw_mul(sign, v)
        node_velocity[n] = v

    return update_kernel
