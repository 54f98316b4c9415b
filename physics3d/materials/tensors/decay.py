"""Exponential decay at unit rate over a step of length x while something is fed in at a constant rate.

    s_next = e^-x s + w(x) D,   w = (1 - e^-x)/x         exact: D is fed in at the rate D/x, s is what was there before
           = w(x) (g(x) s + D),   g = e^-x / w = x/(e^x - 1)

w is the mean of e^-t over 0 .. x; g is what has to be left of s for the step to be: add D, let all of it decay by w.
Both are given less one, exact for small x. Certaine (1960), exponential integrators.
"""

import functools
import math

import warp as wp

from physics3d.materials.tensors.scalars import expm1


@functools.cache
def mean_decay(real: type) -> wp.Function:
    """mean_decay(x) -> (w, w - 1), x >= 0: each to all of its digits."""
    expm1_, slope = expm1(real), mean_decay_slope(real)
    terms = 8 if real is wp.float32 else 14  # 0.3^n / (n + 1)!: 2e-10 and 4e-20

    @wp.func(name=f"mean_decay_{real.__name__}")
    def mean_decay(x: real):
        w = real(1.0)
        less = real(0.0)
        if x > real(0.3):
            w = -expm1_(-x) / x
            less = w - real(1.0)
        else:
            series = real(0.0)
            for i in range(wp.static(terms + 1)):
                series = wp.static(real(1.0 / math.factorial(terms + 2 - i))) - series * x
            less = -x * series
            w = real(1.0) + less
        return w, less

    @wp.func_grad(mean_decay)
    def adj_mean_decay(x: real, adj_w: real, adj_less: real):
        _w, less = mean_decay(x)
        wp.adjoint[x] += (adj_w + adj_less) * slope(x, less)

    return mean_decay


@functools.cache
def mean_decay_slope(real: type) -> wp.Function:
    """slope(x, w - 1) -> dw/dx = (e^-x - w)/x."""
    expm1_ = expm1(real)

    @wp.func(name=f"mean_decay_slope_{real.__name__}")
    def slope(x: real, less: real):
        result = real(-0.5)
        if x > real(0.0):
            result = (expm1_(-x) - less) / x
        return result

    return slope


@functools.cache
def share_left(real: type) -> wp.Function:
    """share_left(x) -> g - 1."""
    expm1_, mean_decay_ = expm1(real), mean_decay(real)

    @wp.func(name=f"share_left_{real.__name__}")
    def share_left(x: real):
        w, less = mean_decay_(x)
        return (expm1_(-x) - less) / w

    return share_left
