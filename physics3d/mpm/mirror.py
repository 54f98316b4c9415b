"""Walls that mirror: a node behind the wall holds the image of the node as far before it.

`walls` [12] are, per axis, the node of the lower wall, then of the upper one, then 1 for each that is sticky
(`mirror_nodes` of the boundaries). In the image the velocity component across the wall is reversed; all of them are, if
it is sticky. Momentum and mass behind the wall are folded onto the nodes before it, and velocities copied back: the
trial functions then vanish on the plane itself, an error of second order.
"""

from functools import cache

import warp as wp

from physics3d.mpm.stencil import node_number
from physics3d.warp_types import vector, vector4


@cache
def mirror(real) -> tuple[wp.Function, wp.Function]:
    """Warp functions (flip, folded).

    flip(axis, sticky) is the sign of each velocity component in the image; folded(at, window, walls, grid) the momentum
    and mass of a node in front of the walls with those of its images one node behind them (27 at an inner corner)."""
    vec3, vec4 = vector(real), vector4(real)

    @wp.func
    def flip(axis: int, sticky: int) -> vec3:
        one = real(1.0)
        sign = vec3(-one, -one, -one)
        if sticky == 0:
            sign = vec3(wp.where(axis == 0, -one, one), wp.where(axis == 1, -one, one), wp.where(axis == 2, -one, one))
        return sign

    @wp.func
    def folded(at: wp.vec3i, window: wp.array(dtype=int), walls: wp.array(dtype=int), grid: wp.array(dtype=vec4)):
        total = vec4()
        # along each axis: itself, then its images in the lower and in the upper wall where it has them
        low = wp.vec3i(0, 0, 0)
        ways = wp.vec3i(1, 1, 1)
        for axis in range(3):
            low[axis] = wp.where(at[axis] == walls[axis] + 1, 1, 0)
            ways[axis] = 1 + low[axis] + wp.where(at[axis] == walls[3 + axis] - 1, 1, 0)
        for c in range(ways[0] * ways[1] * ways[2]):
            choice = wp.vec3i(c % ways[0], (c / ways[0]) % ways[1], c / (ways[0] * ways[1]))
            shift = wp.vec3i(0, 0, 0)
            sign = vec3(real(1.0), real(1.0), real(1.0))
            for axis in range(3):
                if choice[axis] > 0:
                    lower = choice[axis] == 1 and low[axis] == 1
                    shift[axis] = wp.where(lower, -2, 2)
                    sign = wp.cw_mul(sign, flip(axis, walls[wp.where(lower, 6, 9) + axis]))
            n = node_number(at + shift, window)
            if n >= 0:
                node = grid[n]
                total = total + vec4(sign[0] * node[0], sign[1] * node[1], sign[2] * node[2], node[3])
        return total

    return flip, folded
