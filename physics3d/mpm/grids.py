"""Grids are cleared, and those of all threads summed into the first, over a range of nodes for each thread."""

from functools import cache

import warp as wp

from physics3d.warp_types import vector, vector4


@wp.kernel(module="unique", enable_backward=False)
def count_up(
    # in
    more: int,  # so many
    # out
    number: wp.array(dtype=int),  # [1]
):
    """So many more, where the host may not say which: in a graph, which is recorded once."""
    number[0] = number[0] + more


@cache
def clear(dtype) -> wp.Kernel:
    """Kernel: set a range of an array to zero."""
    zero = dtype(0.0)

    @wp.kernel(module="unique", enable_backward=False)
    def clear_kernel(
        # in
        first: int,  # node of thread 0
        # out
        values: wp.array(dtype=dtype),  # [node]
    ):
        values[wp.tid() + first] = wp.static(zero)

    return clear_kernel


@cache
def total_of_sums(real, sums) -> wp.Kernel:
    """Kernel: momentum and mass in `real`, the sum over the rows of grids [threads, node] of `sums`, in a fixed order;
    zero is left there for the next scatter.

    Where `sums` are wider, the momentum is that of the rounded mass at the rounded velocity, so that what is divided
    afterwards is rounded once, not three times: bodies that spin for thousands of substeps drift by these roundings.
    """
    vec3, vec4, wide = vector(real), vector4(real), vector4(sums)
    zero = wide(sums(0.0))

    @wp.kernel(module="unique", enable_backward=False)
    def total_of_sums_kernel(
        # in
        first: int,  # node of thread 0
        # out
        grids: wp.array2d(dtype=wide),  # [threads, node] read, then zero
        values: wp.array(dtype=vec4),  # [node]
    ):
        i = wp.tid() + first
        s = grids[0, i]
        grids[0, i] = wp.static(zero)
        for t in range(1, grids.shape[0]):
            s = s + grids[t, i]
            grids[t, i] = wp.static(zero)
        m = real(s[3])
        p = vec3(real(s[0]), real(s[1]), real(s[2]))
        if wp.static(sums != real) and m > real(0.0):
            p = m * vec3(real(s[0] / s[3]), real(s[1] / s[3]), real(s[2] / s[3]))
        values[i] = vec4(p[0], p[1], p[2], m)

    return total_of_sums_kernel


@cache
def total(dtype) -> wp.Kernel:
    """Kernel: sum over the rows of grids [threads, node] into the first row, in a fixed order."""

    @wp.kernel(module="unique", enable_backward=False)
    def total_kernel(
        # in
        first: int,  # node of thread 0
        # out
        grids: wp.array2d(dtype=dtype),  # [threads, node] read, and the first row written
    ):
        i = wp.tid() + first
        s = grids[0, i]
        for t in range(1, grids.shape[0]):
            s = s + grids[t, i]
        grids[0, i] = s

    return total_kernel


@cache
def total_of_fours(real) -> wp.Kernel:
    """Kernel: the first three numbers of the sum over the rows of grids [threads, node], in a fixed order; zero is left
    there for the next sum."""
    vec3, vec4 = vector(real), vector4(real)
    zero = vec4(0.0)

    @wp.kernel(module="unique", enable_backward=False)
    def total_of_fours_kernel(
        # in
        first: int,  # node of thread 0
        # out
        grids: wp.array2d(dtype=vec4),  # [threads, node] read, then zero
        values: wp.array(dtype=vec3),  # [node]
    ):
        i = wp.tid() + first
        s = vec4()
        for t in range(grids.shape[0]):
            s = s + grids[t, i]
            grids[t, i] = wp.static(zero)
        values[i] = vec3(s[0], s[1], s[2])

    return total_of_fours_kernel
