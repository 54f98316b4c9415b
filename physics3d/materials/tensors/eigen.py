"""Eigenvalues and eigenvectors of symmetric matrices in closed form.

Smith (1961) for the values; Scherzinger and Dohrmann (2008) for the vectors.
"""

import functools
import math

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.tensors.volume import determinant
from physics3d.warp_types import matrix, vector


@functools.cache
def separated_root(real: type, steps: int) -> wp.Function:
    """The root t of t^3 - 3 t = det that is far from the two others, by 1.7 at least: a polynomial in |det|, off by
    1.2e-6, then Newton `steps`, each of which squares the error."""

    @wp.func(name=f"separated_root_{steps}_{real.__name__}")
    def separated_root(det: real):
        r = wp.min(real(0.5) * wp.abs(det), real(1.0))
        t = real(-0.018108650) + r * real(0.0039638839)
        t = real(1.7320520) + r * (real(0.33324518) + r * (real(-0.095107484) + r * (real(0.043955990) + r * t)))
        for _ in range(steps):
            t = t - (t * (t * t - real(3.0)) - real(2.0) * r) / (real(3.0) * t * t - real(3.0))
        if det < real(0.0):
            t = -t
        return t

    return separated_root


@functools.cache
def eigen(real: type) -> wp.Function:
    """(x, Q) of a symmetric matrix X = Q diag(x) Q^T, not differentiable by itself. No iteration:

        X = m I + p B,   tr B = 0,  |B|^2 = 6:   t^3 - 3 t = det B,   |t| <= 2

    The root far from the two others is known to round-off, so its eigenvector is a column of adj(B - t I). In the plane
    across one Jacobi rotation is exact, whatever these two are.
    """
    mat33 = matrix(real)
    vec3 = vector(real)
    separated_root_ = separated_root(real, 1 if real is wp.float32 else 2)
    least = real(1e-18 if real is wp.float32 else 1e-150)

    @wp.func(name=f"eigen_{real.__name__}")
    def eigen(X: mat33):
        m = (X[0, 0] + X[1, 1] + X[2, 2]) / real(3.0)
        a, b, c = X[0, 0] - m, X[1, 1] - m, X[2, 2] - m
        f, g, h = X[1, 2], X[0, 2], X[0, 1]
        p = wp.sqrt((a * a + b * b + c * c + real(2.0) * (f * f + g * g + h * h)) / real(6.0))
        scale = real(1.0) / wp.max(p, least)
        a, b, c = scale * a, scale * b, scale * c
        f, g, h = scale * f, scale * g, scale * h
        det = a * (b * c - f * f) + h * (g * f - h * c) + g * (h * f - g * b)
        t = separated_root_(det)
        # eigenvector u of t
        A, B, C = a - t, b - t, c - t
        aa, bb, cc = B * C - f * f, A * C - g * g, A * B - h * h
        ab, ac, bc = g * f - h * C, h * f - g * B, h * g - f * A
        u = vec3(aa, ab, ac)
        if bb > aa and bb >= cc:
            u = vec3(ab, bb, bc)
        elif cc > aa:
            u = vec3(ac, bc, cc)
        u = (real(1.0) / wp.sqrt(wp.dot(u, u))) * u
        # v, w across it
        sign = real(1.0)
        if u[2] < real(0.0):
            sign = real(-1.0)
        k = real(-1.0) / (sign + u[2])
        l = u[0] * u[1] * k
        v = vec3(real(1.0) + sign * u[0] * u[0] * k, sign * l, -sign * u[0])
        w = vec3(l, sign + u[1] * u[1] * k, -u[1])
        Bu = vec3(a * u[0] + h * u[1] + g * u[2], h * u[0] + b * u[1] + f * u[2], g * u[0] + f * u[1] + c * u[2])
        Bv = vec3(a * v[0] + h * v[1] + g * v[2], h * v[0] + b * v[1] + f * v[2], g * v[0] + f * v[1] + c * v[2])
        Bw = vec3(a * w[0] + h * w[1] + g * w[2], h * w[0] + b * w[1] + f * w[2], g * w[0] + f * w[1] + c * w[2])
        vv, ww, vw = wp.dot(v, Bv), wp.dot(w, Bw), wp.dot(v, Bw)
        # the rotation that annihilates vw
        difference = ww - vv
        size = wp.sqrt(difference * difference + real(4.0) * vw * vw)
        cosine = real(1.0)
        sine = real(0.0)
        if size > real(0.0):
            cosine = wp.sqrt(real(0.5) + real(0.5) * wp.abs(difference) / size)
            sine = vw / (size * cosine)
            if difference < real(0.0):
                sine = -sine
        both = cosine * sine * real(2.0) * vw
        x = vec3(
            m + p * wp.dot(u, Bu),
            m + p * (cosine * cosine * vv - both + sine * sine * ww),
            m + p * (sine * sine * vv + both + cosine * cosine * ww),
        )
        return x, wp.matrix_from_cols(u, cosine * v - sine * w, sine * v + cosine * w)

    return eigen


def principal_values(S: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, " n"], ...]:
    """(lowest, middle, highest) of many symmetric matrices at once, in closed form (Smith 1961).

    Near equal ones single values are known to half of the digits only; symmetric functions of the three to all."""
    one = torch.eye(3, dtype=S.dtype, device=S.device)
    mean = S.diagonal(dim1=1, dim2=2).mean(1)
    B = S - mean[:, None, None] * one
    p = (B.square().sum((1, 2)) / 6).sqrt()
    r = determinant(B / p.clamp(min=torch.finfo(S.dtype).tiny ** 0.5)[:, None, None]) / 2
    angle = torch.acos(r.clamp(-1, 1)) / 3
    low, high = mean + 2 * p * torch.cos(angle + 2 * math.pi / 3), mean + 2 * p * torch.cos(angle)
    return low, 3 * mean - low - high, high
