"""What is gripped, and how it moves: Warp functions that several boundaries share."""

import functools

import warp as wp

from physics3d.warp_types import matrix, vector


@functools.cache
def while_on(real: type) -> wp.Function:
    """grip: the weight of the particle while the first signal is above 0."""

    @wp.func(name=f"grip_while_on_{real.__name__}")
    def grip(weight: real, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        return wp.where(clock[row, b] > real(0.0), weight, real(0.0))

    return grip


@functools.cache
def still(real: type) -> wp.Function:
    """steer: no motion."""
    vec3, mat33 = vector(real), matrix(real)

    @wp.func(name=f"steer_still_{real.__name__}")
    def steer(x: vec3, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        return vec3(), mat33()

    return steer
