"""The 27 nodes around a particle: quadratic B-splines, and whether the nodes are all in the window.

    w(r) = 3/4 - r^2 (|r| < 1/2),  (3/2 - |r|)^2 / 2 (|r| < 3/2)                     per axis, r in cells

A particle's place is its rest cell, its rest offset in that cell and a displacement, so that increments are never lost
against a large coordinate in float32: d = offset + u/dx is the place in cells from the corner of the rest cell. The
grid is a window of nodes around the particles, `window` its lowest node and its number of nodes along each axis.

Source: Steffen, Kirby and Berzins (2008) Analysis and reduction of quadrature errors in the material point method.
"""

from functools import cache

import warp as wp

from physics3d.warp_types import matrix, vector


@wp.func
def node_number(at: wp.vec3i, window: wp.array(dtype=int)):
    """Number of a node in the window, -1 if it is not there."""
    i, j, k = at[0] - window[0], at[1] - window[1], at[2] - window[2]
    n = (i * window[4] + j) * window[5] + k
    if i < 0 or j < 0 or k < 0 or i >= window[3] or j >= window[4] or k >= window[5]:
        n = -1
    return n


@cache
def stencil(real) -> tuple[wp.Function, wp.Function, wp.Function, wp.Function]:
    """Warp functions (first_node, local, weights, slopes).

    first_node(cell, d, window) is the number of the lowest of the 27 nodes, -1 unless all of them are in the window,
    local(d) the position relative to it in cells, in [0.5, 1.5], weights(f) a matrix whose row a holds the three
    weights along axis a, slopes(f) its derivative by f."""
    vec3, mat33 = vector(real), matrix(real)

    @wp.func
    def first_node(cell: wp.vec3i, d: vec3, window: wp.array(dtype=int)) -> int:
        half, zero = real(0.5), real(0.0)
        # as real numbers, which are exact here and cannot overflow: no node is below zero if a number is not one
        ix = real(cell[0]) + wp.floor(d[0] - half) - real(window[0])
        iy = real(cell[1]) + wp.floor(d[1] - half) - real(window[1])
        iz = real(cell[2]) + wp.floor(d[2] - half) - real(window[2])
        nx, ny, nz = window[3], window[4], window[5]
        node = -1
        inside = ix >= zero and iy >= zero and iz >= zero and ix <= real(nx - 3) and iy <= real(ny - 3)
        if inside and iz <= real(nz - 3):
            node = (int(ix) * ny + int(iy)) * nz + int(iz)
        return node

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

    return first_node, local, weights, slopes
