"""Linear systems that are known by their products alone: preconditioned conjugate gradients, and BiCGStab.

Conjugate gradients want a symmetric operator and end at a direction of negative curvature; BiCGStab wants neither.

Sources: Nocedal and Wright (2006) ch. 7; van der Vorst (1992).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from physics3d.mpm.implicit.slow import Course
from physics3d.mpm.implicit.system import dot

MOST = 2000  # products in one solve
Operator = Callable[[Tensor], Tensor]


def conjugate_gradients(
    product: Operator,
    rhs: Tensor,
    *,
    precondition: Operator,
    size: Callable[[Tensor], float],
    target: float,
    course: Course | None = None,
) -> tuple[Tensor, int, bool]:
    """x with product(x) = rhs, in the range of `precondition`; count of products; is the `size` of the residual at most
    `target`? What it did is noted in `course`."""
    x, r = torch.zeros_like(rhs), rhs.clone()
    z = precondition(r)
    p, rz = z.clone(), dot(r, z)
    for used in range(MOST):
        if size(r) <= target:
            return x, used, True
        Ap = product(p)
        curvature = dot(p, Ap)
        if not curvature > 0:
            return (x if used else p), used + 1, False
        a = rz / curvature
        x += a * p
        r -= a * Ap
        if course is not None:
            course.note(z, rz)
        z = precondition(r)
        rz, last = dot(r, z), rz
        p = z + (rz / last) * p
        if course is not None:
            course.a.append(a)
            course.b.append(rz / last)
    return x, MOST, False


def bicgstab(
    product: Operator, rhs: Tensor, *, precondition: Operator, size: Callable[[Tensor], float], target: float
) -> tuple[Tensor, int]:
    """x with product(x) = rhs up to a residual of `size` `target`, or the best that was found; count of products."""
    x, r = torch.zeros_like(rhs), rhs.clone()
    shadow, rho, alpha, omega = rhs.clone(), 1.0, 1.0, 1.0
    v = p = torch.zeros_like(rhs)
    best, lowest, used = x, size(r), 0
    while lowest > target and used < MOST:
        rho, last = dot(shadow, r), rho
        if abs(rho) < 1e-300 or omega == 0:
            break
        p = r + (rho / last) * (alpha / omega) * (p - omega * v)
        y = precondition(p)
        v = product(y)
        alpha = rho / dot(shadow, v)
        s = r - alpha * v
        z = precondition(s)
        t = product(z)
        square = dot(t, t)
        omega = dot(t, s) / square if square > 0 else 0.0
        x = x + alpha * y + omega * z
        r = s - omega * t
        used += 2
        now = size(r)
        if not math.isfinite(now):
            break
        if now < lowest:
            best, lowest = x, now
    return best, used
