"""The grid's part of a substep: v_i = e^(-c dt) (p_i/m_i + dt g), then what the boundaries make of it.

A node lighter than `mass_floor` stays at rest. Where walls mirror, a node near one first folds in the momenta of its
images, and a node behind one takes the velocity of what it is the image of. Nodes near what is gripped move together
with the node k that they follow (`hold`): with V the imposed velocity and r_i = s_i/s_k

    v_k - V_k = sum_i r_i (p_i - m_i V_i)/sum_i r_i^2 m_i      over k itself (r = 1) and all that follow it
    v_i - V_i = r_i (v_k - V_k)

p_i and m_i with those of their images where walls mirror. A boundary that grips acts by its own `node` only where it
grips nothing.
"""

from functools import cache

import warp as wp

from physics3d.mpm.hold import FREE, HELD
from physics3d.mpm.hooks import DECAY, KICK, Hook, columns_of
from physics3d.mpm.mirror import mirror
from physics3d.mpm.stencil import node_number
from physics3d.warp_types import vector, vector4


@cache
def update(
    real, hooks: tuple[Hook, ...], touches: tuple[Hook, ...], grips: tuple[Hook, ...], mirrored: bool
) -> wp.Kernel:
    """Kernel: velocities of nodes from their momenta. `touches`: of the boundaries that act on touched nodes alone."""
    vec3, vec4 = vector(real), vector4(real)
    flip, folded = mirror(real)
    count = len(hooks)
    functions, a, b, rows = columns_of(hooks)
    # of the boundary of each hook, its place among those that act on touched nodes alone, or -1
    mark_row = {hook.boundary: place for place, hook in enumerate(touches)}
    marks = tuple(mark_row.get(row, -1) for row in rows)
    grip_row = {hook.boundary: place for place, hook in enumerate(grips)}
    own_grip = tuple(grip_row.get(row, -1) for row in rows)
    grip_count = len(grips)

    @wp.func
    def whole(
        at: wp.vec3i, n: int, window: wp.array(dtype=int), walls: wp.array(dtype=int), grid: wp.array(dtype=vec4)
    ):
        """Momentum and mass of node n, which is `at`, with those of its images."""
        if wp.static(mirrored):
            return folded(at, window, walls, grid)
        return grid[n]

    @wp.kernel(module="unique")
    def update_kernel(
        # in
        first: int,  # node of thread 0
        dx: real,  # [m]
        origin: vec3,  # place of node (0, 0, 0) [m]
        gravity: vec3,  # [m/s^2]
        mass_floor: real,  # lighter nodes stay at rest [kg]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] as in `arrays`
        row: wp.array(dtype=int),  # [1] the substep
        walls: wp.array(dtype=int),  # [12] see `mirror`
        stamp: wp.array(dtype=int),  # [1] of what is touched in this substep
        touched: wp.array2d(dtype=int),  # [hook, node]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        gripped: wp.array(dtype=real),  # [grip x node] [kg]
        depth: wp.array(dtype=real),  # [node] distance from what is gripped [cells]
        imposed: wp.array(dtype=vec3),  # [node] velocity of what is gripped [m/s]
        leader: wp.array(dtype=int),  # [node] see `hold`
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
        near = 0
        sign = vec3(real(1.0), real(1.0), real(1.0))
        if wp.static(mirrored):
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
        decay, fall = clock[r, wp.static(DECAY)], (clock[r, wp.static(DECAY)] * clock[r, wp.static(KICK)]) * gravity
        moves = m > mass_floor
        if moves:
            v = decay * (vec3(node[0], node[1], node[2]) / m) + fall
        if wp.static(grip_count > 0):
            ahead = int(FREE)
            if here >= 0:
                ahead = leader[wp.max(here, 0)]
            top = here
            if ahead >= 0:
                top = ahead
            middle = wp.vec3i()
            if top >= 0:
                middle = wp.vec3i(
                    window[0] + top / (window[4] * window[5]), window[1] + (top / window[5]) % window[4],
                    window[2] + top % window[5],
                )  # fmt: skip
            if wp.static(mirrored):
                for axis in range(3):
                    if middle[axis] < walls[axis] or middle[axis] > walls[3 + axis]:
                        ahead = wp.where(ahead >= 0, int(HELD), ahead)
                        top = -1
            if ahead == HELD:
                v = imposed[wp.max(here, 0)]
                moves = True
            elif top >= 0:
                V = imposed[top]
                lead = whole(middle, top, window, walls, grid)
                inertia = lead[3]
                impulse = decay * vec3(lead[0], lead[1], lead[2]) + inertia * (fall - V)
                followed = 0
                for k in range(12):
                    step = wp.vec3i(0, 0, 0)
                    step[k % 3] = wp.where(k < 6, 1, 2) * wp.where((k / 3) % 2 == 0, 1, -1)
                    other = node_number(middle + step, window)
                    if other >= 0 and leader[wp.max(other, 0)] == top:
                        followed = 1
                        ratio = depth[other] / depth[top]
                        that = whole(middle + step, other, window, walls, grid)
                        p = decay * vec3(that[0], that[1], that[2])
                        impulse = impulse + ratio * (p + that[3] * (fall - imposed[other]))
                        inertia = inertia + ratio * ratio * that[3]
                if followed == 1:
                    share = real(1.0)
                    if ahead >= 0:
                        share = depth[here] / depth[top]
                    v = imposed[here] + share * (impulse / inertia)
                    moves = True
        if moves:
            x = origin + dx * vec3(real(at[0]), real(at[1]), real(at[2]))
            for h in range(wp.static(count)):
                if wp.static(own_grip[h] >= 0):
                    nodes = window[3] * window[4] * window[5]
                    if here >= 0 and gripped[wp.static(own_grip[h]) * nodes + wp.max(here, 0)] == real(0.0):
                        v = wp.static(functions[h])(x, v, q, wp.static(a[h]), clock, r, wp.static(b[h]))
                elif wp.static(marks[h] < 0):
                    v = wp.static(functions[h])(x, v, q, wp.static(a[h]), clock, r, wp.static(b[h]))
                elif here >= 0 and touched[wp.static(marks[h]), wp.max(here, 0)] == stamp[0]:
                    # both sides of this `and` are computed
                    v = wp.static(functions[h])(x, v, q, wp.static(a[h]), clock, r, wp.static(b[h]))
        if wp.static(mirrored):
            v = wp.cw_mul(sign, v)
        node_velocity[n] = v

    return update_kernel
