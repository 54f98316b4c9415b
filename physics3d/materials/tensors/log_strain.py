"""Logarithmic (Hencky) strain eps = 1/2 ln b of the stored X = b - I, and what is left of it when it relaxes.

Deviator and trace of eps relax by themselves, each by a factor, so that one spectral function does it. Principal
values of I + X below 1e-5 (compression to 0.3 %) go on along the tangent of the logarithm. Higham, Functions of
Matrices (2008), ch. 3 and 11.
"""

import functools
import math

import warp as wp

from physics3d.materials.tensors.eigen import eigen, separated_root
from physics3d.materials.tensors.scalars import expm1, log1p, log1p_extended
from physics3d.warp_types import matrix, vector

FLOOR = 1e-5  # principal values of I + X below it (compression to 0.3 %) go on along the tangent of the logarithm


@functools.cache
def _rescale_by_eigenvectors(real: type) -> wp.Function:
    """`rescaled` at any strain."""
    mat33, vec3 = matrix(real), vector(real)
    eigen_, expm1_, log1p_ = eigen(real), expm1(real), log1p_extended(real, FLOOR)
    floor = real(FLOOR)

    @wp.func(name=f"rescale_by_eigenvectors_{real.__name__}")
    def rescale(X: mat33, shear: real, pressure: real, d: real, v: real):
        x, Q = eigen_(X)
        eps = real(0.5) * vec3(log1p_(x[0]), log1p_(x[1]), log1p_(x[2]))
        mean = (eps[0] + eps[1] + eps[2]) / real(3.0)
        scaled = vec3()
        change = vec3()
        for i in range(3):
            dev = eps[i] - mean
            scaled[i] = shear * dev + pressure * mean
            before = x[i]
            if real(1.0) + x[i] < floor:
                before = wp.exp(real(2.0) * eps[i]) - real(1.0)
            change[i] = (real(1.0) + before) * expm1_(real(2.0) * (d * dev + v * mean)) + before - x[i]
        Qt = wp.transpose(Q)
        return Q * wp.diag(scaled) * Qt, X + Q * wp.diag(change) * Qt

    return rescale


@functools.cache
def rescaled(real: type) -> wp.Function:
    """rescaled(X, shear, pressure, d, v) -> (A, X_next): the logarithmic strain eps = 1/2 ln(I + X), its deviator and
    its trace multiplied by two factors each.

        A      = shear dev eps + pressure tr(eps)/3 I
        X_next = exp(2 [(1 + d) dev eps + (1 + v) tr(eps)/3 I]) - I

    d and v near zero are exact small increments of X, and d = v = 0 leaves X as it is. Not differentiable by itself:
    `rescale` is, and who writes an adjoint of his own takes `adjoint_of_rescaled`.

    Unless stretches are very unequal, no eigenvectors: both results are quadratic polynomials of B (see `eigen`)
    through the values at three nodes t_i. The error is p^3 prod(t - t_i) times a third derivative, of the order of
    prod(t - t_i) as long as p is below every 1 + x: an uncertain node costs little, and two may be held apart.
    """
    mat33 = matrix(real)
    expm1_, log1p_ = expm1(real), log1p(real)
    separated_root_ = separated_root(real, 1 if real is wp.float32 else 2)
    by_eigenvectors = _rescale_by_eigenvectors(real)
    least = real(1e-18 if real is wp.float32 else 1e-150)
    third = real(1 / 3)
    apart = real(1e-6 if real is wp.float32 else 4e-16)

    @wp.func(name=f"rescaled_{real.__name__}")
    def rescaled(X: mat33, shear: real, pressure: real, d: real, v: real):
        m = third * (X[0, 0] + X[1, 1] + X[2, 2])
        a, b, c = X[0, 0] - m, X[1, 1] - m, X[2, 2] - m
        f, g, h = X[1, 2], X[0, 2], X[0, 1]
        p = wp.sqrt(third * (real(0.5) * (a * a + b * b + c * c) + f * f + g * g + h * h))
        scale = real(1.0) / wp.max(p, least)
        a, b, c = scale * a, scale * b, scale * c
        f, g, h = scale * f, scale * g, scale * h
        # nodes
        t0 = separated_root_(a * (b * c - f * f) + h * (g * f - h * c) + g * (h * f - g * b))
        r = wp.sqrt(wp.max(real(3.0) - real(0.75) * t0 * t0, apart))
        t1 = -real(0.5) * t0 + r
        t2 = -real(0.5) * t0 - r
        # values
        x0, x1, x2 = m + p * t0, m + p * t1, m + p * t2
        if real(1.0) + wp.min(x0, wp.min(x1, x2)) < wp.max(p, real(0.1)):
            A_far, X_far = by_eigenvectors(X, shear, pressure, d, v)
            return A_far, X_far
        e0, e1, e2 = real(0.5) * log1p_(x0), real(0.5) * log1p_(x1), real(0.5) * log1p_(x2)
        mean = third * (e0 + e1 + e2)
        stretching, growth = real(2.0) * d, real(2.0) * v * mean
        n0 = (real(1.0) + x0) * expm1_(stretching * (e0 - mean) + growth)
        n1 = (real(1.0) + x1) * expm1_(stretching * (e1 - mean) + growth)
        n2 = (real(1.0) + x2) * expm1_(stretching * (e2 - mean) + growth)
        # divided differences
        both = real(1.0) / ((t0 - t1) * (t0 - t2))
        r01, r02, r12 = both * (t0 - t2), both * (t0 - t1), real(0.5) / r
        e01, n01 = (e0 - e1) * r01, (n0 - n1) * r01
        e012 = (e01 - (e0 - e2) * r02) * r12
        n012 = (n01 - (n0 - n2) * r02) * r12
        # powers of B
        sum01, product01 = t0 + t1, t0 * t1
        a_0 = shear * (e0 - mean - e01 * t0 + e012 * product01) + pressure * mean
        a_1, a_2 = shear * (e01 - e012 * sum01), shear * e012
        n_0, n_1 = n0 - n01 * t0 + n012 * product01, n01 - n012 * sum01
        aa, bb, cc = a * a + h * h + g * g, h * h + b * b + f * f, g * g + f * f + c * c
        bc, ac, ab = g * h + f * (b + c), g * (a + c) + h * f, h * (a + b) + g * f
        a_xx, a_yy = a_0 + a_1 * a + a_2 * aa, a_0 + a_1 * b + a_2 * bb
        a_zz = a_0 + a_1 * c + a_2 * cc
        a_yz, a_xz, a_xy = a_1 * f + a_2 * bc, a_1 * g + a_2 * ac, a_1 * h + a_2 * ab
        x_xx, x_yy = X[0, 0] + n_0 + n_1 * a + n012 * aa, X[1, 1] + n_0 + n_1 * b + n012 * bb
        x_zz = X[2, 2] + n_0 + n_1 * c + n012 * cc
        x_yz, x_xz = X[1, 2] + n_1 * f + n012 * bc, X[0, 2] + n_1 * g + n012 * ac
        x_xy = X[0, 1] + n_1 * h + n012 * ab
        return (
            mat33(a_xx, a_xy, a_xz, a_xy, a_yy, a_yz, a_xz, a_yz, a_zz),
            mat33(x_xx, x_xy, x_xz, x_xy, x_yy, x_yz, x_xz, x_yz, x_zz),
        )

    return rescaled


@functools.cache
def log_slope(real: type) -> wp.Function:
    floor = real(FLOOR)
    log_terms = 6 if real is wp.float32 else 12  # 0.04^n / (2n + 1): 3e-10, 7e-19

    @wp.func(name=f"log_slope_{real.__name__}")
    def log_slope(x: real, y: real, log_x: real, log_y: real):
        """Divided difference of the extended ln(1 + x)."""
        total = real(2.0) + x + y
        difference = x - y
        if wp.min(x, y) < floor - real(1.0):
            if wp.abs(difference) < real(1e-3) * floor:
                return real(1.0) / wp.max(real(1.0) + x, floor)
            return (log_x - log_y) / difference
        inverse = real(1.0) / total
        s = difference * inverse
        s2 = s * s
        if s2 > real(0.04):
            return (log_x - log_y) / difference
        series = real(0.0)
        for i in range(wp.static(log_terms)):
            series = series * s2 + wp.static(real(1.0 / (2 * (log_terms - i) - 1)))
        return real(2.0) * inverse * series

    return log_slope


@functools.cache
def exp_slope(real: type) -> wp.Function:
    exp_terms = 5 if real is wp.float32 else 9  # 1 / (2n + 1)!: 3e-8, 8e-18

    @wp.func(name=f"exp_slope_{real.__name__}")
    def exp_slope(x: real, y: real, root_x: real, root_y: real):
        """Divided difference of exp, whose square roots at x and y are given."""
        h = real(0.5) * (x - y)
        h2 = h * h
        if h2 > real(1.0):
            return (root_x * root_x - root_y * root_y) / (x - y)
        series = real(0.0)
        for i in range(wp.static(exp_terms)):
            series = series * h2 + wp.static(real(1.0 / math.factorial(2 * (exp_terms - i) - 1)))
        return root_x * root_y * series

    return exp_slope


@functools.cache
def adjoint_of_rescaled(real: type) -> wp.Function:
    """adjoint(X, shear, pressure, d, v, adj_A, adj_X_next) -> (adj_X, dev eps : adj_A, tr(eps)/3 tr adj_A,
    dev eps : B, tr(eps)/3 tr B), of `rescaled`: the last four are the adjoints of shear, pressure, d and v.

    B = 2 (I + X_next) adj_X_next in principal axes is the adjoint of the strain that is of_dev.
    """
    mat33, vec3 = matrix(real), vector(real)
    eigen_, log1p_, expm1_ = eigen(real), log1p_extended(real, FLOOR), expm1(real)
    log_slope_, exp_slope_ = log_slope(real), exp_slope(real)
    floor = real(FLOOR)

    @wp.func(name=f"adjoint_of_rescaled_{real.__name__}")
    def adjoint(X: mat33, shear: real, pressure: real, d: real, v: real, adj_A: mat33, adj_X_next: mat33):
        x, Q = eigen_(X)
        l = vec3(log1p_(x[0]), log1p_(x[1]), log1p_(x[2]))
        mean = (l[0] + l[1] + l[2]) / real(6.0)
        dev = vec3(real(0.5) * l[0] - mean, real(0.5) * l[1] - mean, real(0.5) * l[2] - mean)
        of_dev, of_mean = real(1.0) + d, real(1.0) + v  # factors of deviator and trace
        # ln(1 + next) and its root
        y = vec3(
            real(2.0) * (of_dev * dev[0] + of_mean * mean),
            real(2.0) * (of_dev * dev[1] + of_mean * mean),
            real(2.0) * (of_dev * dev[2] + of_mean * mean),
        )
        one = real(1.0)
        root = vec3(
            one + expm1_(real(0.5) * y[0]), one + expm1_(real(0.5) * y[1]), one + expm1_(real(0.5) * y[2])
        )  # fmt: skip
        Qt = wp.transpose(Q)
        A = Qt * (adj_A * Q)
        B = Qt * (adj_X_next * Q)
        a = wp.get_diag(A)
        b = real(2.0) * vec3(root[0] * root[0] * B[0, 0], root[1] * root[1] * B[1, 1], root[2] * root[2] * B[2, 2])
        a_sum = a[0] + a[1] + a[2]
        b_sum = b[0] + b[1] + b[2]
        adj_mean = ((pressure - shear) * a_sum + (of_mean - of_dev) * b_sum) / real(3.0)
        T = mat33()
        for i in range(3):
            T[i, i] = real(0.5) * (shear * a[i] + of_dev * b[i] + adj_mean) / wp.max(real(1.0) + x[i], floor)
        for i in range(3):
            j = (i + 1) % 3
            slope = real(0.5) * log_slope_(x[i], x[j], l[i], l[j])
            exp_ij = exp_slope_(y[i], y[j], root[i], root[j])
            T_ij = slope * (real(0.5) * shear * (A[i, j] + A[j, i]) + of_dev * exp_ij * (B[i, j] + B[j, i]))
            T[i, j] = T_ij
            T[j, i] = T_ij
        return Q * (T * Qt), wp.dot(dev, a), mean * a_sum, wp.dot(dev, b), mean * b_sum

    return adjoint


@functools.cache
def rescale(real: type) -> wp.Function:
    """`rescaled` with its adjoint."""
    mat33 = matrix(real)
    rescaled_, adjoint = rescaled(real), adjoint_of_rescaled(real)

    @wp.func(name=f"rescale_{real.__name__}")
    def rescale(X: mat33, shear: real, pressure: real, d: real, v: real):
        A, X_next = rescaled_(X, shear, pressure, d, v)
        return A, X_next

    @wp.func_grad(rescale)
    def adj_rescale(X: mat33, shear: real, pressure: real, d: real, v: real, adj_A: mat33, adj_X_next: mat33):
        adj_X, adj_shear, adj_pressure, adj_d, adj_v = adjoint(X, shear, pressure, d, v, adj_A, adj_X_next)
        wp.adjoint[X] += adj_X
        wp.adjoint[shear] += adj_shear
        wp.adjoint[pressure] += adj_pressure
        wp.adjoint[d] += adj_d
        wp.adjoint[v] += adj_v

    return rescale
