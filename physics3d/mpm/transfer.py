"""Particles to grid and back: quadratic B-splines with the affine (APIC, MLS) transfers.

    w(r) = 3/4 - r^2 (|r| < 1/2),  (3/2 - |r|)^2 / 2 (|r| < 3/2)                     per axis, r in cells
    m_i     = sum_p w_ip m_p
    (m v)_i = sum_p w_ip [ m_p v_p + (m_p L_p - dt V_p (4/dx^2) tau_p) (x_i - x_p) ]       [kg m/s]
    v_p     = sum_i w_ip v_i                                                           [m/s]
    L_p     = (4/dx^2) sum_i w_ip v_i (x_i - x_p)^T                                    [1/s]

V_p is the rest volume and tau the Kirchhoff stress, so the bracket is the momentum after the internal forces of one
symplectic Euler step. L is both the affine velocity of the next scatter and the velocity gradient of the material.

A particle's place is its rest cell, its rest offset in that cell and a displacement, so that increments are never lost
against a large coordinate in float32. The grid is a window of nodes around the particles (lower corner and size in
`window`); a particle whose 27 nodes are not all inside it writes nothing and is counted in `lost`.

Sources: Jiang et al. (2015) The affine particle-in-cell method; Hu et al. (2018) A moving least squares material point
method. The adjoints of the two transfers are written out, each a transfer in the other direction, three times as fast
as those Warp generates; a test compares them with torch.
"""

from functools import cache

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.mpm import columns
from physics3d.warp_types import matrix, vector, vector4


@cache
def stencil(real) -> tuple[wp.Function, wp.Function, wp.Function, wp.Function]:
    """Warp functions (base, local, weights, slopes) of the 27 nodes around a particle.

    base(cell, d) is the lowest node as real numbers (exact), local(d) the position relative to it in cells, in
    [0.5, 1.5], weights(f) a matrix whose row a holds the three weights along axis a, slopes(f) its derivative by f."""
    vec3, mat33 = vector(real), matrix(real)

    @wp.func
    def base(cell: wp.vec3i, d: vec3) -> vec3:
        half = real(0.5)
        return vec3(
            real(cell[0]) + wp.floor(d[0] - half),
            real(cell[1]) + wp.floor(d[1] - half),
            real(cell[2]) + wp.floor(d[2] - half),
        )

    @wp.func
    def local(d: vec3) -> vec3:
        half = real(0.5)
        return vec3(d[0] - wp.floor(d[0] - half), d[1] - wp.floor(d[1] - half), d[2] - wp.floor(d[2] - half))

    @wp.func
    def weights(f: vec3) -> mat33:
        half = real(0.5)
        a = vec3(real(1.5) - f[0], real(1.5) - f[1], real(1.5) - f[2])
        b = vec3(f[0] - real(1.0), f[1] - real(1.0), f[2] - real(1.0))
        c = vec3(f[0] - half, f[1] - half, f[2] - half)
        q = real(0.75)
        return mat33(
            half * a[0] * a[0], q - b[0] * b[0], half * c[0] * c[0],
            half * a[1] * a[1], q - b[1] * b[1], half * c[1] * c[1],
            half * a[2] * a[2], q - b[2] * b[2], half * c[2] * c[2],
        )  # fmt: skip

    @wp.func
    def slopes(f: vec3) -> mat33:
        a, b, two = real(1.5), real(0.5), real(2.0)
        return mat33(
            f[0] - a, two - two * f[0], f[0] - b,
            f[1] - a, two - two * f[1], f[1] - b,
            f[2] - a, two - two * f[2], f[2] - b,
        )  # fmt: skip

    return base, local, weights, slopes


@cache
def scatter(real, fast: bool = False) -> wp.Kernel:
    """Kernel: mass and momentum (with the internal forces of one step) of particles onto the nodes."""
    vec3, vec4, mat33 = vector(real), vector4(real), matrix(real)
    base, local, weights, _ = stencil(real)
    spread = columns.spread(real, fast)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] column 0: dt [s]
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
        dt = clock[row[0], 0]
        d = offset[p] + u[p] / dx
        corner = base(cell[p], d)
        nx, ny, nz = window[3], window[4], window[5]
        ix, iy, iz = corner[0] - real(window[0]), corner[1] - real(window[1]), corner[2] - real(window[2])
        zero = real(0.0)
        inside = ix >= zero and iy >= zero and iz >= zero and ix <= real(nx - 3) and iy <= real(ny - 3)
        if inside and iz <= real(nz - 3):
            f = local(d)
            w = weights(f)
            m = mass[p]
            A = (m * dx) * L[p] - (real(4.0) * dt * volume[p] / dx) * tau[p]
            q = m * v[p] - A * f
            spread(grid, (int(ix) * ny + int(iy)) * nz + int(iz), ny, nz, w, q, m, A)
        else:
            wp.atomic_add(lost, 0, 1)

    return scatter_kernel


@cache
def gather(real, fast: bool = False) -> wp.Kernel:
    """Kernel: velocity and velocity gradient of particles from the nodes."""
    vec3, mat33 = vector(real), matrix(real)
    base, local, weights, _ = stencil(real)
    gathered = columns.gathered(real, fast)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_kernel(
        # in
        first: int,
        dx: real,
        window: wp.array(dtype=int),
        cell: wp.array(dtype=wp.vec3i),
        offset: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),  # [p] displacement at the scatter [m]
        node_velocity: wp.array(dtype=vec3),  # [node] [m/s]
        # out
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        corner = base(cell[p], d)
        nx, ny, nz = window[3], window[4], window[5]
        ix, iy, iz = corner[0] - real(window[0]), corner[1] - real(window[1]), corner[2] - real(window[2])
        zero = real(0.0)
        inside = ix >= zero and iy >= zero and iz >= zero and ix <= real(nx - 3) and iy <= real(ny - 3)
        if inside and iz <= real(nz - 3):
            f = local(d)
            w = weights(f)
            S = gathered(node_velocity, (int(ix) * ny + int(iy)) * nz + int(iz), ny, nz, f, w)
            v[p] = vec3(S[0, 0], S[0, 1], S[0, 2])
            L[p] = (real(4.0) / dx) * mat33(
                S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2]
            )

    return gather_kernel


@cache
def scatter_adjoint(real, fast: bool = False) -> wp.Kernel:
    """Kernel: adjoint of `scatter`. With the adjoint (P, M) of a node's momentum and mass and r = x_i - x_p in cells,

    adj v = m sum w P,   adj A = sum w P r^T,   adj x = sum grad w [ P . (m v + A r) + m M ] - A^T sum w P
    """
    vec3, vec4, mat33 = vector(real), vector4(real), matrix(real)
    base, local, weights, slopes = stencil(real)
    spread_adjoint = columns.spread_adjoint(real, fast)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_adjoint_kernel(
        # in
        first: int,
        dx: real,
        window: wp.array(dtype=int),
        clock: wp.array2d(dtype=real),
        row: wp.array(dtype=int),
        mass: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        cell: wp.array(dtype=wp.vec3i),
        offset: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        L: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        adjoint_grid: wp.array(dtype=vec4),  # [node]
        # out, added to
        adjoint_offset: wp.array(dtype=vec3),
        adjoint_u: wp.array(dtype=vec3),
        adjoint_v: wp.array(dtype=vec3),
        adjoint_L: wp.array(dtype=mat33),
        adjoint_tau: wp.array(dtype=mat33),
    ):
        p = wp.tid() + first
        dt = clock[row[0], 0]
        d = offset[p] + u[p] / dx
        corner = base(cell[p], d)
        nx, ny, nz = window[3], window[4], window[5]
        ix, iy, iz = corner[0] - real(window[0]), corner[1] - real(window[1]), corner[2] - real(window[2])
        zero = real(0.0)
        inside = ix >= zero and iy >= zero and iz >= zero and ix <= real(nx - 3) and iy <= real(ny - 3)
        if inside and iz <= real(nz - 3):
            f = local(d)
            w, g = weights(f), slopes(f)
            m = mass[p]
            stress = real(4.0) * dt * volume[p] / dx
            A = (m * dx) * L[p] - stress * tau[p]
            S = spread_adjoint(
                adjoint_grid, (int(ix) * ny + int(iy)) * nz + int(iz), ny, nz, f, w, g, m * v[p] - A * f, m, A
            )
            mean, slope = vec3(S[0, 0], S[0, 1], S[0, 2]), vec3(S[4, 0], S[4, 1], S[4, 2])
            B = mat33(S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2])
            adjoint_d = slope - wp.transpose(A) * mean
            adjoint_offset[p] = adjoint_offset[p] + adjoint_d
            adjoint_u[p] = adjoint_u[p] + adjoint_d / dx
            adjoint_v[p] = adjoint_v[p] + m * mean
            adjoint_L[p] = adjoint_L[p] + (m * dx) * B
            adjoint_tau[p] = adjoint_tau[p] - stress * B

    return scatter_adjoint_kernel


@cache
def gather_adjoint(real, fast: bool = False) -> wp.Kernel:
    """Kernel: adjoint of `gather`, onto nodes of 4-vectors if fast. With the adjoints V of v and (dx/4) B of L, and
    r = x_i - x_p in cells,

    adj v_i = sum_p w (V + B r),   adj x = sum_i grad w [ v_i . (V + B r) ] - B^T v_p
    """
    vec3, mat33 = vector(real), matrix(real)
    base, local, weights, slopes = stencil(real)
    gathered_adjoint = columns.gathered_adjoint(real, fast)
    node_kind = vector4(real) if fast else vec3

    @wp.kernel(module="unique", enable_backward=False)
    def gather_adjoint_kernel(
        # in
        first: int,
        dx: real,
        window: wp.array(dtype=int),
        cell: wp.array(dtype=wp.vec3i),
        offset: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        adjoint_v: wp.array(dtype=vec3),  # [p]
        adjoint_L: wp.array(dtype=mat33),  # [p]
        # out, added to
        adjoint_offset: wp.array(dtype=vec3),
        adjoint_u: wp.array(dtype=vec3),
        adjoint_node_velocity: wp.array(dtype=node_kind),
    ):
        p = wp.tid() + first
        d = offset[p] + u[p] / dx
        corner = base(cell[p], d)
        nx, ny, nz = window[3], window[4], window[5]
        ix, iy, iz = corner[0] - real(window[0]), corner[1] - real(window[1]), corner[2] - real(window[2])
        zero = real(0.0)
        inside = ix >= zero and iy >= zero and iz >= zero and ix <= real(nx - 3) and iy <= real(ny - 3)
        if inside and iz <= real(nz - 3):
            f = local(d)
            w, g = weights(f), slopes(f)
            B = (real(4.0) / dx) * adjoint_L[p]
            first_node = (int(ix) * ny + int(iy)) * nz + int(iz)
            S = gathered_adjoint(
                node_velocity, adjoint_node_velocity, first_node, ny, nz, w, g, adjoint_v[p] - B * f, B
            )
            mean, slope = vec3(S[0, 0], S[0, 1], S[0, 2]), vec3(S[1, 0], S[1, 1], S[1, 2])
            adjoint_d = slope - wp.transpose(B) * mean
            adjoint_offset[p] = adjoint_offset[p] + adjoint_d
            adjoint_u[p] = adjoint_u[p] + adjoint_d / dx

    return gather_adjoint_kernel


@cache
def clear(dtype) -> wp.Kernel:
    """Kernel: set a range of an array to zero."""

    @wp.kernel(module="unique", enable_backward=False)
    def clear_kernel(
        # in
        first: int,
        # out
        values: wp.array(dtype=dtype),
    ):
        values[wp.tid() + first] = dtype()

    return clear_kernel


@cache
def total(dtype) -> wp.Kernel:
    """Kernel: sum over the rows of grids [threads, node] into the first row, in a fixed order."""

    @wp.kernel(module="unique", enable_backward=False)
    def total_kernel(
        # in
        first: int,  # node of thread 0
        # in, out
        grids: wp.array2d(dtype=dtype),  # [threads, node]
    ):
        i = wp.tid() + first
        s = grids[0, i]
        for t in range(1, grids.shape[0]):
            s = s + grids[t, i]
        grids[0, i] = s

    return total_kernel


@cache
def total_of_fours(real) -> wp.Kernel:
    """Kernel: the first three numbers of the sum over the rows of grids [threads, node], in a fixed order."""
    vec3, vec4 = vector(real), vector4(real)

    @wp.kernel(module="unique", enable_backward=False)
    def total_of_fours_kernel(
        # in
        first: int,
        grids: wp.array2d(dtype=vec4),  # [threads, node]
        # out
        values: wp.array(dtype=vec3),  # [node]
    ):
        i = wp.tid() + first
        s = grids[0, i]
        for t in range(1, grids.shape[0]):
            s = s + grids[t, i]
        values[i] = vec3(s[0], s[1], s[2])

    return total_of_fours_kernel


def velocity_gradient(
    x: Float[Tensor, "p 3"], v: Float[Tensor, "p 3"], mass: Float[Tensor, " p"]
) -> Float[Tensor, "p 3 3"]:
    """Gradient, per unit of x, of a field of particle velocities at the particles; x in cells, float64, differentiable.

        L_p = sum_i w_ip v_i r_i^T ( sum_i w_ip r_i r_i^T )^-1,   r_i = x_i - sum_j w_jp x_j

    over the nodes' mean velocities v_i and centres of mass x_i: exact for linear fields, zero across a sheet. A body
    that starts to spin or to stretch needs it: with L = 0 the first scatter would take the part of the motion that
    lives below a cell (a quarter of the angular momentum of a body three cells wide)."""
    base = (x.detach() - 0.5).floor()
    f = x - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    base = (base - base.amin(0)).long()
    size = base.amax(0) + 3
    nodes = []
    for step in torch.cartesian_prod(*[torch.arange(3, device=x.device)] * 3):
        i, j, k = (base + step).unbind(1)
        weight = w[step[0], :, 0] * w[step[1], :, 1] * w[step[2], :, 2]
        nodes.append(((i * size[1] + j) * size[2] + k, weight))
    sums = x.new_zeros(int(size.prod()), 7)  # mass times (1, velocity, position)
    for node, weight in nodes:
        sums = sums.index_add(0, node, (weight * mass)[:, None] * torch.cat([torch.ones_like(x[:, :1]), v, x], 1))
    mean = sums[:, 1:] / sums[:, :1].clamp(min=torch.finfo(x.dtype).tiny)
    at_particle = sum(weight[:, None] * mean[node] for node, weight in nodes)
    left, right = x.new_zeros(len(x), 3, 3), 1e-9 * torch.eye(3, dtype=x.dtype, device=x.device)
    for node, weight in nodes:
        dv, r = (mean[node] - at_particle).split(3, 1)
        left = left + (weight[:, None] * dv)[:, :, None] * r[:, None]
        right = right + (weight[:, None] * r)[:, :, None] * r[:, None]
    return left @ torch.linalg.inv(right)
