"""Return of the logarithmic strain into a box, to the point nearest in the energy: associated flow, which dissipates.

    eps = argmin over lower <= c_i <= upper of 2 mu |c - t|^2 + lam (tr(c - t))^2,   t = principal values of 1/2 ln b

Simo and Hughes, Computational Inelasticity (1998), sec. 2.2 (closest-point projection).
"""

import functools

import warp as wp

from physics3d.materials.tensors.eigen import eigen
from physics3d.materials.tensors.log_strain import FLOOR, exp_slope, log_slope
from physics3d.materials.tensors.scalars import expm1, log1p_extended
from physics3d.warp_types import matrix, vector


@functools.cache
def _box_flow(real: type) -> wp.Function:
    """flow(t, r, lower, upper) -> y = tr(c) - tr(t) of the point c nearest to t in the box lower <= c_i <= upper.

    Nearest in the energy 2 mu |c|^2 + lam (tr c)^2, r = lam/(2 mu) > -1/3: c_i = clamp(t_i - r y), which makes y the
    root of a falling, piecewise linear function. Its six kinks bracket the root, then one linear equation has it.
    """
    vec3 = vector(real)

    @wp.func(name=f"box_excess_{real.__name__}")
    def excess(t: vec3, r: real, lower: real, upper: real, y: real):
        total = -y
        for i in range(3):
            total = total + wp.clamp(t[i] - r * y, lower, upper) - t[i]
        return total

    @wp.func(name=f"box_flow_{real.__name__}")
    def flow(t: vec3, r: real, lower: real, upper: real):
        if wp.min(t) >= lower and wp.max(t) <= upper:
            return real(0.0)
        end = excess(t, r, lower, upper, real(0.0)) / (real(1.0) + real(3.0) * wp.min(r, real(0.0)))
        low = wp.min(end, real(0.0))
        high = wp.max(end, real(0.0))
        for i in range(6):
            bound = lower
            if i >= 3:
                bound = upper
            kink = low
            if r != real(0.0):
                kink = (t[i % 3] - bound) / r
            if kink > low and kink < high:
                if excess(t, r, lower, upper, kink) > real(0.0):
                    low = kink
                else:
                    high = kink
        middle = real(0.5) * (low + high)
        over = real(0.0)
        free = real(0.0)
        for i in range(3):
            c = t[i] - r * middle
            if c < lower:
                over = over + lower - t[i]
            elif c > upper:
                over = over + upper - t[i]
            else:
                free = free + real(1.0)
        return over / (real(1.0) + r * free)

    return flow


@functools.cache
def box_hencky(real: type) -> wp.Function:
    """box(X, r, lower, upper) -> (eps, X_next, y): the logarithmic strain 1/2 ln(I + X) returned into the box
    lower <= principal values <= upper, to the point nearest in the energy of r = lam/(2 mu) (see `_box_flow`).

    X_next = exp(2 eps) - I, and X itself where nothing flows; y = tr(eps) - tr(trial). As the return is associated,
    flow dissipates. The adjoint is exact but where a principal value meets a bound, a set of measure zero.
    """
    mat33 = matrix(real)
    vec3 = vector(real)
    eigen_, expm1_, log1p_ = eigen(real), expm1(real), log1p_extended(real, FLOOR)
    log_slope_, exp_slope_, flow = log_slope(real), exp_slope(real), _box_flow(real)
    floor = real(FLOOR)

    @wp.func(name=f"box_hencky_{real.__name__}")
    def box(X: mat33, r: real, lower: real, upper: real):
        x, Q = eigen_(X)
        t = real(0.5) * vec3(log1p_(x[0]), log1p_(x[1]), log1p_(x[2]))
        y = flow(t, r, lower, upper)
        eps = vec3()
        change = vec3()
        for i in range(3):
            eps[i] = wp.clamp(t[i] - r * y, lower, upper)
            before = x[i]
            if real(1.0) + x[i] < floor:
                before = wp.exp(real(2.0) * t[i]) - real(1.0)
            change[i] = (real(1.0) + before) * expm1_(real(2.0) * (eps[i] - t[i])) + before - x[i]
        if y == real(0.0) and wp.min(t) >= lower and wp.max(t) <= upper:
            change = vec3()
        Qt = wp.transpose(Q)
        return Q * wp.diag(eps) * Qt, X + Q * wp.diag(change) * Qt, y

    @wp.func_grad(box)
    def adj_box(X: mat33, r: real, lower: real, upper: real, adj_eps: mat33, adj_X_next: mat33, adj_y: real):
        x, Q = eigen_(X)
        l = vec3(log1p_(x[0]), log1p_(x[1]), log1p_(x[2]))
        t = real(0.5) * l
        y = flow(t, r, lower, upper)
        Qt = wp.transpose(Q)
        A = Qt * (adj_eps * Q)
        B = Qt * (adj_X_next * Q)
        c = vec3()
        root = vec3()
        side = vec3()  # -1: at the lower bound, 1: at the upper, 0: between
        g = vec3()  # adjoints of c
        free = real(0.0)
        pulled = real(0.0)
        for i in range(3):
            at = t[i] - r * y
            c[i] = wp.clamp(at, lower, upper)
            root[i] = wp.exp(c[i])
            g[i] = A[i, i] + real(2.0) * root[i] * root[i] * B[i, i]
            if at < lower:
                side[i] = real(-1.0)
            elif at > upper:
                side[i] = real(1.0)
            else:
                free = free + real(1.0)
                pulled = pulled + g[i]
        D = real(1.0) + r * free
        total = adj_y - r * pulled
        wp.adjoint[r] += -y * (pulled + total * free / D)
        T = mat33()
        for i in range(3):
            adj_t = g[i]
            if side[i] != real(0.0):
                adj_t = -total / D
                if side[i] < real(0.0):
                    wp.adjoint[lower] += g[i] + total / D
                else:
                    wp.adjoint[upper] += g[i] + total / D
            T[i, i] = real(0.5) * adj_t / wp.max(real(1.0) + x[i], floor)
        for i in range(3):
            j = (i + 1) % 3
            share = real(1.0)  # of the difference of trial strains that is left
            if side[i] * side[j] > real(0.0):
                share = real(0.0)
            elif side[i] != side[j] and t[i] != t[j]:
                share = (c[i] - c[j]) / (t[i] - t[j])
            slope = real(0.5) * share * log_slope_(x[i], x[j], l[i], l[j])
            exp_ij = exp_slope_(real(2.0) * c[i], real(2.0) * c[j], root[i], root[j])
            T_ij = slope * (real(0.5) * (A[i, j] + A[j, i]) + exp_ij * (B[i, j] + B[j, i]))
            T[i, j] = T_ij
            T[j, i] = T_ij
        wp.adjoint[X] += Q * (T * Qt)

    return box
