"""What boundaries grip: matter whose motion is imposed, and how far the nodes around are from it.

A particle is gripped by a share 0..1 of its volume (`grip` of the boundaries). That share gives the nodes no momentum
and no stress, for it is no part of the problem; what it gives them is told apart, as mass. The rest of the particle is
free and is scattered as ever. From the share c of a node's mass that is gripped follows its distance from the face
between both, in cells: with quadratic splines N, a plane face s cells away, and matter enough behind it,

    c(s) = int_s^(3/2) N = (3/2 - s)^3/6 (1/2 < s < 3/2),   1/2 - 3 s/4 + s^3/3 (|s| < 1/2),   c(-s) = 1 - c(s)

What stays where it is says itself where its face is (`ahead` of the boundaries), however thin it is.

Nodes behind the face or next to it follow the node before them: with V the imposed velocity the trial functions v - V
are straight there and vanish on the face wherever it lies between nodes,

    v_i = V_i + (s_i/s_k) (v_k - V_k),   s_k >= `least_distance` for the node k that i follows,

and k moves with the momentum and the inertia of all that follow it (`update`): a projection, which no energy comes
from. A node that has nobody to follow takes V. Splines constrained by extension: Hoellig, Reif and Wipper (2001)
Weighted extended B-spline approximation of Dirichlet problems.
"""

from functools import cache

import warp as wp

from physics3d.mpm.hooks import Hook, columns_of
from physics3d.mpm.stencil import node_number, stencil
from physics3d.warp_types import vector, vector4

FREE, HELD = wp.constant(-1), wp.constant(-2)  # instead of the node that one follows


def least_distance(spacing: float) -> float:
    """Distance from the face of nodes that move by themselves [cells], for particles that are `spacing` cells apart.

    The nearer, the less of a bend is lost. But there must be no more such nodes between two grips than particles in a
    row, for what no particle feels slips: with a cell per particle, grips slipped at 0.5 and held at 0.6."""
    return min(max(0.6 * spacing, 0.25), 0.6)


@cache
def hold(real, grips: tuple[Hook, ...]) -> wp.Kernel:
    """Kernel: of each particle the mass and volume that are free, and the rest as gripped mass of the nodes."""
    vec3 = vector(real)
    first_node, local, weights, _ = stencil(real)
    count = len(grips)
    functions, a, b, rows = columns_of(grips)

    @wp.kernel(module="unique")
    def hold_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] as in `arrays`
        row: wp.array(dtype=int),  # [1] the substep
        selection: wp.array2d(dtype=real),  # [boundary, p]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        whole_mass: wp.array(dtype=real),  # [p] [kg]
        whole_volume: wp.array(dtype=real),  # [p] at rest [m^3]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        # out
        mass: wp.array(dtype=real),  # [p] [kg]
        volume: wp.array(dtype=real),  # [p] [m^3]
        gripped: wp.array(dtype=real),  # [grip x node] [kg], added to
    ):
        p = wp.tid() + first
        ny, nz = window[4], window[5]
        left = real(1.0)
        for h in range(wp.static(count)):
            weight = selection[wp.static(rows[h]), p]
            if weight != real(0.0):
                grip = wp.static(functions[h])(weight, q, wp.static(a[h]), clock, row[0], wp.static(b[h]))
                share = wp.min(left, grip)
                left = left - share
                if share > real(0.0):
                    d = offset[p] + u[p] / dx
                    node = first_node(cell[p], d, window)
                    if node >= 0:
                        f = local(d)
                        w = weights(f)
                        m = share * whole_mass[p]
                        start = h * window[3] * ny * nz + node
                        for n in range(27):
                            i, j, k = n / 9, (n / 3) % 3, n % 3
                            wp.atomic_add(gripped, start + (i * ny + j) * nz + k, w[0, i] * w[1, j] * w[2, k] * m)
        mass[p] = left * whole_mass[p]
        volume[p] = left * whole_volume[p]

    return hold_kernel


@cache
def face(real, grips: tuple[Hook, ...], steers: tuple[Hook, ...], aheads: tuple[Hook, ...]) -> wp.Kernel:
    """Kernel: distance of nodes from what is gripped, and the velocity imposed there."""
    vec3, vec4 = vector(real), vector4(real)
    count = len(grips)
    functions, a, b, _ = columns_of(steers)
    said, said_a, _, said_rows = columns_of(aheads)
    said_count = len(aheads)
    rows = [grip.boundary for grip in grips]
    said_place = tuple(rows.index(row) for row in said_rows)  # among the grips
    by_share = tuple(real(0.0 if row in said_rows else 1.0) for row in rows)
    distance = _distance(real)

    @wp.kernel(module="unique")
    def face_kernel(
        # in
        first: int,  # node of thread 0
        dx: real,  # [m]
        origin: vec3,  # place of node (0, 0, 0) [m]
        mass_floor: real,  # [kg]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] as in `arrays`
        row: wp.array(dtype=int),  # [1] the substep
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        gripped: wp.array(dtype=real),  # [grip x node] [kg]
        grid: wp.array(dtype=vec4),  # [node] momentum [kg m/s], mass [kg]
        # out
        depth: wp.array(dtype=real),  # [node] distance [cells], at most 3/2
        imposed: wp.array(dtype=vec3),  # [node] [m/s]
    ):
        n = wp.tid() + first
        ny, nz = window[4], window[5]
        nodes = window[3] * ny * nz
        at = wp.vec3i(window[0] + n / (ny * nz), window[1] + (n / nz) % ny, window[2] + n % nz)
        held, shared, most = real(0.0), real(0.0), real(0.0)
        owner = -1
        for h in range(wp.static(count)):
            mine = gripped[h * nodes + n]
            held = held + mine
            shared = shared + wp.static(by_share[h]) * mine
            if mine > most:
                most = mine
                owner = h
        s = real(1.5)
        total = grid[n][3] + held
        if shared > real(0.0) and total > mass_floor:
            s = distance(shared / total)
        if owner < 0:
            # whoever follows this node has the motion of a grip nearby
            for k in range(12):
                step = wp.vec3i(0, 0, 0)
                step[k % 3] = wp.where(k < 6, 1, 2) * wp.where((k / 3) % 2 == 0, 1, -1)
                other = node_number(at + step, window)
                if other >= 0 and owner < 0:
                    for h in range(wp.static(count)):
                        if gripped[h * nodes + other] > real(0.0):
                            owner = h
        v = vec3()
        x = origin + dx * vec3(real(at[0]), real(at[1]), real(at[2]))
        for k in range(wp.static(said_count)):
            if gripped[wp.static(said_place[k]) * nodes + n] > real(0.0):
                s = wp.min(s, wp.max(wp.static(said[k])(x, q, wp.static(said_a[k])) / dx, real(-1.5)))
        for h in range(wp.static(count)):
            if owner == h:
                v, _ = wp.static(functions[h])(x, q, wp.static(a[h]), clock, row[0], wp.static(b[h]))
        depth[n] = s
        imposed[n] = v

    return face_kernel


@cache
def lead(real) -> wp.Kernel:
    """Kernel: the node that a node follows; FREE if it follows none, HELD if it should and there is none."""
    vec4 = vector4(real)

    @wp.kernel(module="unique", enable_backward=False)
    def lead_kernel(
        # in
        first: int,  # node of thread 0
        least: real,  # distance from the face of nodes that move by themselves [cells]
        mass_floor: real,  # [kg]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        grid: wp.array(dtype=vec4),  # [node] momentum [kg m/s], mass [kg]
        depth: wp.array(dtype=real),  # [node] [cells]
        # out
        leader: wp.array(dtype=int),  # [node]
    ):
        n = wp.tid() + first
        ny, nz = window[4], window[5]
        at = wp.vec3i(window[0] + n / (ny * nz), window[1] + (n / nz) % ny, window[2] + n % nz)
        found = int(FREE)
        if depth[n] < least:
            found = int(HELD)
            steepest = real(0.0)
            for k in range(6):
                step = wp.vec3i(0, 0, 0)
                step[k % 3] = wp.where(k < 3, 1, -1)
                one, two = node_number(at + step, window), node_number(at + step + step, window)
                if one >= 0 and depth[wp.max(one, 0)] < least:
                    one = -1
                    if two >= 0 and depth[wp.max(two, 0)] >= least:
                        one = two
                if one >= 0 and grid[wp.max(one, 0)][3] > mass_floor:
                    slope = (depth[one] - depth[n]) / wp.where(one == two, real(2.0), real(1.0))
                    if slope > steepest:
                        steepest = slope
                        found = one
        leader[n] = found

    return lead_kernel


@cache
def _distance(real) -> wp.Function:
    """distance(c): s [cells] of c(s)."""

    @wp.func
    def distance(c: real):
        sixth, third, most = real(1.0 / 6.0), real(1.0 / 3.0), real(1.5)
        s = most
        if c > real(1.0) - sixth:
            s = -most
            if c < real(1.0 - 1e-9):
                s = wp.pow(real(6.0) * (real(1.0) - c), third) - most
        elif c > sixth:
            # the root between -1/2 and 1/2 of s^3 - 9/4 s + 3 (1/2 - c) = 0
            angle = wp.acos(real(1.1547005383792515) * (real(2.0) * c - real(1.0)))
            s = real(1.7320508075688772) * wp.cos(third * angle - real(2.0943951023931953))
        elif c > real(1e-9):
            s = most - wp.pow(real(6.0) * c, third)
        return s

    return distance
