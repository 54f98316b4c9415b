"""Particles to grid and back: the affine (APIC, MLS) transfers with quadratic B-splines, weights w_ip.

    m_i     = sum_p w_ip m_p
    (m v)_i = sum_p w_ip [ m_p v_p + (m_p L_p - dt V_p (4/dx^2) tau_p) (x_i - x_p) ]       [kg m/s]
    v_p     = sum_i w_ip v_i                                                           [m/s]
    L_p     = (4/dx^2) sum_i w_ip v_i (x_i - x_p)^T                                    [1/s]

V_p is the rest volume and tau the Kirchhoff stress, so the bracket is the momentum after the internal forces of one
symplectic Euler step. L is both the affine velocity of the next scatter and the velocity gradient of the material.
A particle whose 27 nodes are not all in the window (`stencil`) writes nothing and is counted in `lost`.

Sources: Jiang et al. (2015) The affine particle-in-cell method; Hu et al. (2018) A moving least squares material point
method. The adjoints of the two transfers are written out, each a transfer in the other direction, three times as fast
as those Warp generates; a test compares them with torch.
"""

from functools import cache

import warp as wp

from physics3d.mpm import columns
from physics3d.mpm.hooks import KICK
from physics3d.mpm.stencil import stencil
from physics3d.warp_types import matrix, vector, vector4


@cache
def scatter(real, sums, fast: bool = False) -> wp.Kernel:
    """Kernel: mass and momentum (with the internal forces of one step) of particles onto the nodes, added up there in
    the precision of `sums`, which is double in the fast form."""
    vec3, vec4, mat33 = vector(real), vector4(sums), matrix(real)
    first_node, local, weights, _ = stencil(real)
    spread = columns.spread(real, fast, sums)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] column KICK: how long forces act [s]
        row: wp.array(dtype=int),  # [1] the substep
        mass: wp.array(dtype=real),  # [p] [kg]
        volume: wp.array(dtype=real),  # [p] at rest [m^3]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
        tau: wp.array(dtype=mat33),  # [p] Kirchhoff stress [Pa]
        # out
        grid: wp.array(dtype=vec4),  # [node] momentum [kg m/s], mass [kg], added to
        lost: wp.array(dtype=int),  # [1] particles outside the window, added to
    ):
        p = wp.tid() + first
        kick = clock[row[0], wp.static(KICK)]
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            m = mass[p]
            rate = real(4.0) / dx
            # not (m dx) L: what rounding makes of dx would slow or speed up the spin of every particle alike
            A = (real(4.0) * m) * (L[p] / rate) - (rate * kick * volume[p]) * tau[p]
            spread(grid, node, ny, nz, f, weights(f), v[p], m, A)
        else:
            wp.atomic_add(lost, 0, 1)

    return scatter_kernel


@cache
def gather(real, fast: bool = False) -> wp.Kernel:
    """Kernel: velocity and velocity gradient of particles from the nodes."""
    vec3, mat33 = vector(real), matrix(real)
    first_node, local, weights, _ = stencil(real)
    gathered = columns.gathered(real, fast)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement at the scatter [m]
        node_velocity: wp.array(dtype=vec3),  # [node] [m/s]
        # out
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            w = weights(f)
            S = gathered(node_velocity, node, ny, nz, f, w)
            v[p] = vec3(S[0, 0], S[0, 1], S[0, 2])
            L[p] = (real(4.0) / dx) * mat33(
                S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2]
            )

    return gather_kernel


@cache
def scatter_adjoint(real, fast: bool = False) -> wp.Kernel:
    """Kernel: adjoint of `scatter`. With the adjoint (P, M) of a node's momentum and mass and r = x_i - x_p in cells,

    adj v = m sum w P,   adj A = sum w P r^T,   adj x = sum grad w [ P . (m v + A r) + m M ] - A^T sum w P,
    adj m = sum w (P . v + M) + L : sum w P r^T,   adj V = -(4 dt/dx^2) tau : sum w P r^T
    """
    vec3, vec4, mat33 = vector(real), vector4(real), matrix(real)
    first_node, local, weights, slopes = stencil(real)
    spread_adjoint = columns.spread_adjoint(real, fast)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_adjoint_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] column KICK: how long forces act [s]
        row: wp.array(dtype=int),  # [1] the substep
        mass: wp.array(dtype=real),  # [p] [kg]
        volume: wp.array(dtype=real),  # [p] at rest [m^3]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
        tau: wp.array(dtype=mat33),  # [p] Kirchhoff stress [Pa]
        adjoint_grid: wp.array(dtype=vec4),  # [node]
        # out, added to
        adjoint_offset: wp.array(dtype=vec3),  # [p]
        adjoint_u: wp.array(dtype=vec3),  # [p]
        adjoint_v: wp.array(dtype=vec3),  # [p]
        adjoint_L: wp.array(dtype=mat33),  # [p]
        adjoint_tau: wp.array(dtype=mat33),  # [p]
        adjoint_mass: wp.array(dtype=real),  # [p]
        adjoint_volume: wp.array(dtype=real),  # [p]
    ):
        p = wp.tid() + first
        kick = clock[row[0], wp.static(KICK)]
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            w, g = weights(f), slopes(f)
            m = mass[p]
            stress = real(4.0) * kick * volume[p] / dx
            A = (m * dx) * L[p] - stress * tau[p]
            S = spread_adjoint(adjoint_grid, node, ny, nz, f, w, g, m * v[p] - A * f, m, A)
            mean, slope = vec3(S[0, 0], S[0, 1], S[0, 2]), vec3(S[4, 0], S[4, 1], S[4, 2])
            B = mat33(S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2])
            adjoint_d = slope - wp.transpose(A) * mean
            adjoint_offset[p] = adjoint_offset[p] + adjoint_d
            adjoint_u[p] = adjoint_u[p] + adjoint_d / dx
            adjoint_v[p] = adjoint_v[p] + m * mean
            adjoint_L[p] = adjoint_L[p] + (m * dx) * B
            adjoint_tau[p] = adjoint_tau[p] - stress * B
            adjoint_mass[p] = adjoint_mass[p] + wp.dot(mean, v[p]) + S[0, 3] + dx * wp.ddot(L[p], B)
            adjoint_volume[p] = adjoint_volume[p] - (real(4.0) * kick / dx) * wp.ddot(tau[p], B)

    return scatter_adjoint_kernel


@cache
def gather_adjoint(real, fast: bool = False) -> wp.Kernel:
    """Kernel: adjoint of `gather`, onto nodes of 4-vectors if fast. With the adjoints V of v and (dx/4) B of L, and
    r = x_i - x_p in cells,

    adj v_i = sum_p w (V + B r),   adj x = sum_i grad w [ v_i . (V + B r) ] - B^T v_p
    """
    vec3, mat33 = vector(real), matrix(real)
    first_node, local, weights, slopes = stencil(real)
    gathered_adjoint = columns.gathered_adjoint(real, fast)
    node_kind = vector4(real) if fast else vec3

    @wp.kernel(module="unique", enable_backward=False)
    def gather_adjoint_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        node_velocity: wp.array(dtype=vec3),  # [node] [m/s]
        adjoint_v: wp.array(dtype=vec3),  # [p]
        adjoint_L: wp.array(dtype=mat33),  # [p]
        # out, added to
        adjoint_offset: wp.array(dtype=vec3),  # [p]
        adjoint_u: wp.array(dtype=vec3),  # [p]
        adjoint_node_velocity: wp.array(dtype=node_kind),  # [node]
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        node = first_node(cell[p], d, window)
        ny, nz = window[4], window[5]
        if node >= 0:
            f = local(d)
            w, g = weights(f), slopes(f)
            B = (real(4.0) / dx) * adjoint_L[p]
            S = gathered_adjoint(node_velocity, adjoint_node_velocity, node, ny, nz, w, g, adjoint_v[p] - B * f, B)
            mean, slope = vec3(S[0, 0], S[0, 1], S[0, 2]), vec3(S[1, 0], S[1, 1], S[1, 2])
            adjoint_d = slope - wp.transpose(B) * mean
            adjoint_offset[p] = adjoint_offset[p] + adjoint_d
            adjoint_u[p] = adjoint_u[p] + adjoint_d / dx

    return gather_adjoint_kernel
