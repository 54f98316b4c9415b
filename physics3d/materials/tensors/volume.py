"""Change of volume: J - 1 of F = I + H, its derivative, and what is left of a strain when the volume is taken out.

    J - 1 = tr H + (principal minors of H) + det H,   dJ/dF = cof F = J F^-T,   A -> det(A)^(1/3) A^-1

Bonet and Wood (2008), sec. 4.5 and 4.9.
"""

import functools
import math

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.tensors.scalars import expm1, log1p
from physics3d.warp_types import matrix


@functools.cache
def volume_change(real: type) -> wp.Function:
    """J - 1 of F = I + H without cancellation: tr H + the principal minors of H + det H."""
    mat33 = matrix(real)

    @wp.func(name=f"volume_change_{real.__name__}")
    def volume_change(H: mat33):
        minors = (
            H[0, 0] * H[1, 1]
            - H[0, 1] * H[1, 0]
            + H[1, 1] * H[2, 2]
            - H[1, 2] * H[2, 1]
            + H[2, 2] * H[0, 0]
            - H[2, 0] * H[0, 2]
        )
        return H[0, 0] + H[1, 1] + H[2, 2] + minors + wp.determinant(H)

    return volume_change


@functools.cache
def cofactor(real: type) -> wp.Function:
    """dJ/dF = J F^-T, defined for singular F too."""
    mat33 = matrix(real)

    @wp.func(name=f"cofactor_{real.__name__}")
    def cofactor(F: mat33):
        a, b, c = F[0], F[1], F[2]
        return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))

    return cofactor


@functools.cache
def carried_volume(real: type) -> wp.Function:
    """carried(j, M) -> J - 1 after the increment I + M, from j = J - 1 before it.

    J integrated by itself: taken from an F of float32 it would be off by 1e-7, which a bulk modulus of a thousand times
    the shear modulus makes a stress of the order of the others."""
    mat33, change = matrix(real), volume_change(real)

    @wp.func(name=f"carried_volume_{real.__name__}")
    def carried(j: real, M: mat33):
        return j + (real(1.0) + j) * change(M)

    return carried


LEAST_J = 1e-4  # below it the isochoric part of a strain is taken at this volume: finite for inverted elements


@functools.cache
def isochoric(real: type) -> wp.Function:
    """isochoric(X, j) -> b~ - I = J^(-2/3) (I + X) - I, of X = b - I and j = J - 1."""
    mat33 = matrix(real)
    log1p_, expm1_ = log1p(real), expm1(real)
    least = real(LEAST_J - 1)

    @wp.func(name=f"isochoric_{real.__name__}")
    def isochoric(X: mat33, j: real):
        scale = expm1_(real(-2.0 / 3.0) * log1p_(wp.max(j, least)))
        return X + scale * (wp.identity(n=3, dtype=real) + X)

    return isochoric


@functools.cache
def log_det(real: type) -> wp.Function:
    """ln det(I + X) of a positive semidefinite I + X, its tangent below det = 1e-12 (all lengths a hundredth), or below
    what rounding leaves of the determinant of very unequal stretches."""
    mat33 = matrix(real)
    volume_change_, cofactor_, log1p_ = volume_change(real), cofactor(real), log1p(real)
    round_off = real(5e-7 if real is wp.float32 else 1e-15)

    @wp.func(name=f"least_det_{real.__name__}")
    def least(A: mat33, C: mat33):
        return wp.max(real(1e-12), round_off * wp.sqrt(wp.ddot(A, A)) * wp.sqrt(wp.ddot(C, C)))

    @wp.func(name=f"log_det_{real.__name__}")
    def log_det(X: mat33):
        change = volume_change_(X)
        if wp.ddot(X, X) < real(0.1):
            return log1p_(change)
        A = wp.identity(n=3, dtype=real) + X
        det = wp.determinant(A)
        floor = least(A, cofactor_(A))
        above = wp.max(det, floor)
        return wp.log(above) + (det - above) / floor

    @wp.func_grad(log_det)
    def adj_log_det(X: mat33, adj_ret: real):
        A = wp.identity(n=3, dtype=real) + X
        C = cofactor_(A)
        wp.adjoint[X] += adj_ret / wp.max(wp.determinant(A), least(A, C)) * C

    return log_det


@functools.cache
def unimodular_inverse(real: type) -> wp.Function:
    """det(A)^(1/3) A^-1 - I of a positive semidefinite A = I + X."""
    mat33 = matrix(real)
    log_det_, cofactor_, expm1_ = log_det(real), cofactor(real), expm1(real)
    lowest = real(math.log(1e-12))

    @wp.func(name=f"unimodular_inverse_{real.__name__}")
    def unimodular_inverse(X: mat33):
        one = wp.identity(n=3, dtype=real)
        A = one + X
        third = wp.max(log_det_(X), lowest) / real(3.0)
        if wp.ddot(X, X) < real(0.1):
            c = expm1_(third)
            return c * one - (real(1.0) + c) * (X * wp.inverse(A))
        return wp.exp(-real(2.0) * third) * cofactor_(A) - one  # cof A = det(A) A^-1: A is symmetric

    @wp.func_grad(unimodular_inverse)
    def adj_unimodular_inverse(X: mat33, adj_ret: mat33):
        Z = wp.identity(n=3, dtype=real) + unimodular_inverse(X)
        G = real(0.5) * (adj_ret + wp.transpose(adj_ret))
        scale = wp.exp(-wp.max(log_det_(X), lowest) / real(3.0))
        wp.adjoint[X] += scale * (wp.ddot(G, Z) / real(3.0) * Z - Z * G * Z)

    return unimodular_inverse


def determinant(A: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """Of many matrices at once, which torch takes one by one."""
    return (torch.linalg.cross(A[:, 0], A[:, 1]) * A[:, 2]).sum(1)


def change(H: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """J - 1 of many F = I + H, as `volume_change`."""
    trace = H.diagonal(dim1=1, dim2=2).sum(1)
    return trace + (trace**2 - (H * H.mT).sum((1, 2))) / 2 + determinant(H)


def isochoric_strain(H: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """b~ - I of many F = I + H, as `isochoric`."""
    X = H + H.mT + H @ H.mT
    scale = torch.expm1(-2 / 3 * torch.log1p(change(H).clamp(min=LEAST_J - 1)))[:, None, None]
    return X + scale * (torch.eye(3, dtype=H.dtype, device=H.device) + X)


def volumetric_energy(H: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """[(J^2 - 1)/2 - ln J]/2 of many F = I + H, per bulk modulus; its stress is (J^2 - 1)/2."""
    j = change(H)
    return (j + j**2 / 2 - torch.log1p(j.clamp(min=1e-30 - 1))) / 2
