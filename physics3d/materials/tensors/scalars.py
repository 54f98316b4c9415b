"""Logarithm and exponential of numbers near one, which Warp does not have on the CPU: ln(1 + x) and exp(x) - 1.

Near zero both are series, elsewhere the functions of the processor. Abramowitz and Stegun (1964), 4.1.27 and 4.2.1.
"""

import functools
import math

import warp as wp


@functools.cache
def log1p(real: type) -> wp.Function:
    """ln(1 + x), exact for small x: 2 atanh(x / (2 + x)) by its series (Warp has no log1p on the CPU)."""
    terms = 6 if real is wp.float32 else 13  # |x / (2 + x)|^2 < 0.05: truncation below 1e-9 and 1e-18

    @wp.func(name=f"log1p_{real.__name__}")
    def log1p(x: real):
        if wp.abs(x) > real(0.3):
            return wp.log(real(1.0) + x)
        s = x / (real(2.0) + x)
        s2 = s * s
        series = real(0.0)
        for i in range(wp.static(terms)):
            series = series * s2 + wp.static(real(1.0 / (2 * (terms - i) - 1)))
        return real(2.0) * s * series

    @wp.func_grad(log1p)
    def adj_log1p(x: real, adj_ret: real):
        wp.adjoint[x] += adj_ret / (real(1.0) + x)

    return log1p


@functools.cache
def expm1(real: type) -> wp.Function:
    """exp(x) - 1, exact for small x: its Taylor series there."""
    terms = 8 if real is wp.float32 else 14  # 0.3^n / (n + 1)!: 2e-10 and 4e-20

    @wp.func(name=f"expm1_{real.__name__}")
    def expm1(x: real):
        if wp.abs(x) > real(0.3):
            return wp.exp(x) - real(1.0)
        series = real(0.0)
        for i in range(wp.static(terms + 1)):
            series = series * x + wp.static(real(1.0 / math.factorial(terms + 1 - i)))
        return x * series

    @wp.func_grad(expm1)
    def adj_expm1(x: real, adj_ret: real):
        wp.adjoint[x] += adj_ret * wp.exp(x)

    return expm1


@functools.cache
def log1p_extended(real: type, floor: float) -> wp.Function:
    """ln(1 + x) where 1 + x > floor, its tangent below: finite, and still pushing back, for inverted elements."""
    lowest = real(floor)
    log1p_ = log1p(real)

    @wp.func(name=f"log1p_extended_{-round(math.log10(floor))}_{real.__name__}")
    def log1p_extended(x: real):
        above = wp.max(x, lowest - real(1.0))
        return log1p_(above) + (x - above) / lowest

    @wp.func_grad(log1p_extended)
    def adj_log1p_extended(x: real, adj_ret: real):
        wp.adjoint[x] += adj_ret / wp.max(real(1.0) + x, lowest)

    return log1p_extended
