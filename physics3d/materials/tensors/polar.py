"""Left polar decomposition F = V R from invariants: no iteration over matrices, no singular vectors.

The adjoint of V has denominators s_i + s_j only, so that equal stretches are nothing special. Lin, Chitalu and Komura
(2022), Isotropic ARAP energy using Cauchy-Green invariants.
"""

import functools

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.tensors.volume import cofactor, determinant, volume_change
from physics3d.warp_types import matrix, vector

_LEAST_DENOMINATOR = {wp.float32: 1e-5, wp.float64: 1e-9}  # of (s1 + s2)(s2 + s3)(s3 + s1) / |F|^3


@functools.cache
def _polar_denominator(real: type) -> wp.Function:
    least = real(_LEAST_DENOMINATOR[real])

    @wp.func(name=f"polar_denominator_{real.__name__}")
    def denominator(D: real, i1: real):
        return wp.max(D, least * i1 * wp.sqrt(i1) + real(1e-30))

    return denominator


@functools.cache
def _polar_rotation(real: type) -> wp.Function:
    mat33 = matrix(real)
    cofactor_ = cofactor(real)

    @wp.func(name=f"polar_rotation_{real.__name__}")
    def rotation(F: mat33, b: mat33, i1: real, l: real, D: real):
        return (real(1.0) / D) * (real(0.5) * (l * l + i1) * F + l * cofactor_(F) - b * F)

    return rotation


@functools.cache
def stretch(real: type) -> wp.Function:
    """Y = V - I of the left polar decomposition I + H = V R; R is a rotation also when J < 0.

    With l = tr V, b = V^2 = I + X and its invariants i1, i2: l is the largest root of
    II^2 = i2 + 2 J l, II = (l^2 - i1)/2, and then

        V = (b + II)^-1 (l b + J)      R = [(l^2 + i1)/2 F + l cof F - b F] / D      D = (s1 + s2)(s2 + s3)(s3 + s1).

    Near the identity the same is done with the deviations d = l - 3, e = II - 3, j = J - 1. Where D vanishes (two
    stretches of opposite sign) no rotation is defined and R shrinks to zero instead.
    """
    mat33 = matrix(real)
    volume_change_, cofactor_ = volume_change(real), cofactor(real)
    denominator, rotation = _polar_denominator(real), _polar_rotation(real)
    near_steps = 3 if real is wp.float32 else 4
    tolerance = real(1e-7 if real is wp.float32 else 1e-15)
    least = real(_LEAST_DENOMINATOR[real])

    @wp.func(name=f"stretch_{real.__name__}")
    def stretch(H: mat33):
        one = wp.identity(n=3, dtype=real)
        X = H + wp.transpose(H) + H * wp.transpose(H)
        if wp.ddot(X, X) < real(0.1):
            j = volume_change_(H)
            x1 = wp.trace(X)
            x2 = real(0.5) * (x1 * x1 - wp.ddot(X, X))
            d = x1 / (real(1.0) + wp.sqrt(real(1.0) + x1 / real(3.0)))  # l <= sqrt(3 i1), the error is second order
            for _ in range(near_steps):
                e = real(3.0) * d + real(0.5) * (d * d - x1)
                g = e * (real(6.0) + e) - real(2.0) * x1 - x2 - real(6.0) * j - real(2.0) * d * (real(1.0) + j)
                d = d - g / (real(2.0) * (real(3.0) + e) * (real(3.0) + d) - real(2.0) * (real(1.0) + j))
            e = real(3.0) * d + real(0.5) * (d * d - x1)
            Y = wp.inverse(X + (real(4.0) + e) * one) * ((real(2.0) + d) * X + (d + j - e) * one)
            return real(0.5) * (Y + wp.transpose(Y))
        F = one + H
        b = one + X
        C = cofactor_(F)
        J = wp.determinant(F)
        i1 = wp.ddot(F, F)
        i2 = wp.ddot(C, C)
        l = wp.sqrt(real(3.0) * i1)
        least_D = least * i1 * wp.sqrt(i1)
        D = real(0.5) * (l * l - i1) * l - J
        for _ in range(30):  # monotone from above; quadratic unless D = 0
            if D - least_D <= real(0.0):
                break
            II = real(0.5) * (l * l - i1)
            step = (II * II - i2 - real(2.0) * J * l) / (real(2.0) * D)
            l = l - wp.max(step, real(0.0))
            D = real(0.5) * (l * l - i1) * l - J
            if step <= tolerance * l:
                break
        D = denominator(D, i1)
        V = F * wp.transpose(rotation(F, b, i1, l, D))
        return real(0.5) * (V + wp.transpose(V)) - one

    return stretch


@functools.cache
def adjoint_of_stretch(real: type) -> wp.Function:
    """adjoint_of_stretch(F, V, A) -> adjoint of H, given F = I + H, V = I + stretch(H) and its symmetric adjoint A."""
    mat33 = matrix(real)
    vec3 = vector(real)
    cofactor_, denominator, rotation = cofactor(real), _polar_denominator(real), _polar_rotation(real)

    @wp.func(name=f"adjoint_of_stretch_{real.__name__}")
    def adjoint_of_stretch(F: mat33, V: mat33, A: mat33):
        one = wp.identity(n=3, dtype=real)
        b = F * wp.transpose(F)
        i1 = wp.ddot(F, F)
        l = wp.trace(V)
        T = l * one - V  # eigenvalues s_i + s_j
        D = denominator(wp.determinant(T), i1)
        W = V * A - A * V
        q = (real(1.0) / D) * (cofactor_(T) * vec3(W[2, 1], W[0, 2], W[1, 0]))
        return (A - wp.skew(q)) * rotation(F, b, i1, l, D)

    return adjoint_of_stretch


def stretch_distance(H: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """sum (s_i - 1)^2 over the signed singular values of I + H, without cancellation: tr E - 2 e.

    E = F^T F - I, and e = tr U - 3 belongs to the largest root of the quartic whose roots are s_1 +- s_2 +- s_3; Newton
    comes to it from above."""
    E = H + H.mT + H.mT @ H
    tr = E.diagonal(dim1=1, dim2=2).sum(1)
    second = (tr.square() - E.square().sum((1, 2))) / 2
    h = H.diagonal(dim1=1, dim2=2).sum(1)
    j = h + (h.square() - (H * H.mT).sum((1, 2))) / 2 + determinant(H)  # J - 1
    mean = (1 + tr / 3).clamp(min=0).sqrt()
    e = upper = tr / (mean + 1)  # of equal stretches
    for _ in range(60):
        g = (6 * e + e.square() - tr) / 2  # sum of products of two stretches, minus 3
        slope = (6 + 2 * g) * (3 + e) - 2 * (1 + j)
        step = (6 * g + g.square() - 2 * tr - second - 2 * (e + 3 * j + j * e)) / slope.clamp(min=1e-30)
        # of a body crushed to nothing, rounding takes the slope: 3 + e is at least the mean stretch
        e = torch.minimum(torch.maximum(e - step, mean - 3), upper)
        if not bool((step.abs() > torch.finfo(H.dtype).eps * (e.abs() + tr.abs())).any()):
            break
    return tr - 2 * e
