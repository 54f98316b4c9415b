"""Functions of 3x3 matrices that stay exact near the identity and differentiable at repeated stretches.

Every argument is a deviation from the identity (H = F - I, X = b - I), because 1 + x in float32 loses x below 6e-8.
Derivatives are those of the tensor function, never of single eigenvectors, so equal eigenvalues are nothing special:

    f(S) = Q f(l) Q^T,   adjoint of S = Q [K o (Q^T sym(A) Q)] Q^T,   K_ij = (f_i - f_j)/(l_i - l_j)   (Daleckii, Krein)

and the polar factor has denominators s_i + s_j only. Each name below is a memoised factory: given `real` = wp.float32
or wp.float64 it returns the Warp function. Higham, Functions of Matrices (2008), sec. 3.2; Lin, Chitalu, Komura (2022)
for the polar factor from invariants; Scherzinger, Dohrmann (2008) for the eigenvectors.

Generated adjoints evaluate every function once more on each level of calls. What costs most is therefore written as one
function with one adjoint, and marked `without_replay`.
"""

import functools
import math

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor


def matrix_type(real: type) -> type:
    """3x3 matrix of `real`."""
    return wp.types.matrix((3, 3), real)


def without_replay(function: wp.Function) -> wp.Function:
    """`function`, not evaluated again in the reverse pass of its caller, to whom its values are then unknown: for
    functions whose results are only stored (by a function without replay as well) or added."""
    function.skip_replay = True
    return function


@functools.cache
def volume_change(real: type) -> wp.Function:
    """J - 1 of F = I + H without cancellation: tr H + the principal minors of H + det H."""
    mat33 = matrix_type(real)

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
    mat33 = matrix_type(real)

    @wp.func(name=f"cofactor_{real.__name__}")
    def cofactor(F: mat33):
        a, b, c = F[0], F[1], F[2]
        return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))

    return cofactor


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


@functools.cache
def log_det(real: type) -> wp.Function:
    """ln det(I + X) of a positive semidefinite I + X, its tangent below det = 1e-12 (all lengths a hundredth), or below
    what rounding leaves of the determinant of very unequal stretches."""
    mat33 = matrix_type(real)
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
    mat33 = matrix_type(real)
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
    mat33 = matrix_type(real)
    cofactor_ = cofactor(real)

    @wp.func(name=f"polar_rotation_{real.__name__}")
    def rotation(F: mat33, b: mat33, i1: real, l: real, D: real):
        return (real(0.5) * (l * l + i1) * F + l * cofactor_(F) - b * F) / D

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
    mat33 = matrix_type(real)
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
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
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
        q = (cofactor_(T) * vec3(W[2, 1], W[0, 2], W[1, 0])) / D
        return (A - wp.skew(q)) * rotation(F, b, i1, l, D)

    return adjoint_of_stretch


@functools.cache
def _separated_root(real: type, steps: int) -> wp.Function:
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
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    separated_root = _separated_root(real, 1 if real is wp.float32 else 2)
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
        t = separated_root(det)
        # eigenvector u of t
        A, B, C = a - t, b - t, c - t
        aa, bb, cc = B * C - f * f, A * C - g * g, A * B - h * h
        ab, ac, bc = g * f - h * C, h * f - g * B, h * g - f * A
        u = vec3(aa, ab, ac)
        if bb > aa and bb >= cc:
            u = vec3(ab, bb, bc)
        elif cc > aa:
            u = vec3(ac, bc, cc)
        u = u / wp.sqrt(wp.dot(u, u))
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


_FLOOR = 1e-5  # principal values of I + X below it (compression to 0.3 %) go on along the tangent of the logarithm


@functools.cache
def _relax_by_eigenvectors(real: type) -> wp.Function:
    """`_relax` at any strain."""
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    eigen_, expm1_, log1p_ = eigen(real), expm1(real), log1p_extended(real, _FLOOR)
    floor = real(_FLOOR)

    @wp.func(name=f"relax_by_eigenvectors_{real.__name__}")
    def relax(X: mat33, mu: real, K: real, d: real, v: real):
        x, Q = eigen_(X)
        eps = real(0.5) * vec3(log1p_(x[0]), log1p_(x[1]), log1p_(x[2]))
        mean = (eps[0] + eps[1] + eps[2]) / real(3.0)
        dh = expm1_(-real(0.5) * d)
        vh = expm1_(-real(0.5) * v)
        shear = real(2.0) * mu * (real(1.0) + dh)
        pressure = real(3.0) * K * (real(1.0) + vh) * mean
        df = real(2.0) * dh * (real(2.0) + dh)  # 2 expm1(-d)
        vf = real(2.0) * vh * (real(2.0) + vh) * mean
        stress = vec3()
        change = vec3()
        for i in range(3):
            dev = eps[i] - mean
            stress[i] = shear * dev + pressure
            before = x[i]
            if real(1.0) + x[i] < floor:
                before = wp.exp(real(2.0) * eps[i]) - real(1.0)
            change[i] = (real(1.0) + before) * expm1_(df * dev + vf) + before - x[i]
        Qt = wp.transpose(Q)
        return Q * wp.diag(stress) * Qt, X + Q * wp.diag(change) * Qt

    return relax


@functools.cache
def _relax(real: type) -> wp.Function:
    """The forward function of `maxwell_hencky` and `relax_hencky`.

    Unless stretches are very unequal, no eigenvectors: both results are quadratic polynomials of B (see `eigen`)
    through the values at three nodes t_i. The error is p^3 prod(t - t_i) times a third derivative, of the order of
    prod(t - t_i) as long as p is below every 1 + x: an uncertain node costs little, and two may be held apart.
    """
    mat33 = matrix_type(real)
    expm1_, log1p_ = expm1(real), log1p(real)
    separated_root = _separated_root(real, 1 if real is wp.float32 else 2)
    relax_by_eigenvectors = _relax_by_eigenvectors(real)
    least = real(1e-18 if real is wp.float32 else 1e-150)
    third = real(1 / 3)
    apart = real(1e-6 if real is wp.float32 else 4e-16)

    @wp.func(name=f"relax_{real.__name__}")
    def relax(X: mat33, mu: real, K: real, d: real, v: real):
        m = third * (X[0, 0] + X[1, 1] + X[2, 2])
        a, b, c = X[0, 0] - m, X[1, 1] - m, X[2, 2] - m
        f, g, h = X[1, 2], X[0, 2], X[0, 1]
        p = wp.sqrt(third * (real(0.5) * (a * a + b * b + c * c) + f * f + g * g + h * h))
        scale = real(1.0) / wp.max(p, least)
        a, b, c = scale * a, scale * b, scale * c
        f, g, h = scale * f, scale * g, scale * h
        # nodes
        t0 = separated_root(a * (b * c - f * f) + h * (g * f - h * c) + g * (h * f - g * b))
        r = wp.sqrt(wp.max(real(3.0) - real(0.75) * t0 * t0, apart))
        t1 = -real(0.5) * t0 + r
        t2 = -real(0.5) * t0 - r
        # values
        x0, x1, x2 = m + p * t0, m + p * t1, m + p * t2
        if real(1.0) + wp.min(x0, wp.min(x1, x2)) < wp.max(p, real(0.1)):
            far_tau, far_X = relax_by_eigenvectors(X, mu, K, d, v)
            return far_tau, far_X
        e0, e1, e2 = real(0.5) * log1p_(x0), real(0.5) * log1p_(x1), real(0.5) * log1p_(x2)
        mean = third * (e0 + e1 + e2)
        dh = expm1_(-real(0.5) * d)
        vh = expm1_(-real(0.5) * v)
        df = real(2.0) * dh * (real(2.0) + dh)  # 2 expm1(-d)
        vf = real(2.0) * vh * (real(2.0) + vh) * mean
        n0 = (real(1.0) + x0) * expm1_(df * (e0 - mean) + vf)
        n1 = (real(1.0) + x1) * expm1_(df * (e1 - mean) + vf)
        n2 = (real(1.0) + x2) * expm1_(df * (e2 - mean) + vf)
        # divided differences
        both = real(1.0) / ((t0 - t1) * (t0 - t2))
        r01, r02, r12 = both * (t0 - t2), both * (t0 - t1), real(0.5) / r
        e01, n01 = (e0 - e1) * r01, (n0 - n1) * r01
        e012 = (e01 - (e0 - e2) * r02) * r12
        n012 = (n01 - (n0 - n2) * r02) * r12
        # powers of B
        sum01, product01 = t0 + t1, t0 * t1
        shear = real(2.0) * mu * (real(1.0) + dh)
        tau0 = shear * (e0 - mean - e01 * t0 + e012 * product01) + real(3.0) * K * (real(1.0) + vh) * mean
        tau1, tau2 = shear * (e01 - e012 * sum01), shear * e012
        n_0, n_1 = n0 - n01 * t0 + n012 * product01, n01 - n012 * sum01
        aa, bb, cc = a * a + h * h + g * g, h * h + b * b + f * f, g * g + f * f + c * c
        bc, ac, ab = g * h + f * (b + c), g * (a + c) + h * f, h * (a + b) + g * f
        tau_a, tau_b = tau0 + tau1 * a + tau2 * aa, tau0 + tau1 * b + tau2 * bb
        tau_c = tau0 + tau1 * c + tau2 * cc
        tau_f, tau_g, tau_h = tau1 * f + tau2 * bc, tau1 * g + tau2 * ac, tau1 * h + tau2 * ab
        x_a, x_b = X[0, 0] + n_0 + n_1 * a + n012 * aa, X[1, 1] + n_0 + n_1 * b + n012 * bb
        x_c = X[2, 2] + n_0 + n_1 * c + n012 * cc
        x_f, x_g = X[1, 2] + n_1 * f + n012 * bc, X[0, 2] + n_1 * g + n012 * ac
        x_h = X[0, 1] + n_1 * h + n012 * ab
        return (
            mat33(tau_a, tau_h, tau_g, tau_h, tau_b, tau_f, tau_g, tau_f, tau_c),
            mat33(x_a, x_h, x_g, x_h, x_b, x_f, x_g, x_f, x_c),
        )

    return relax


@functools.cache
def _log_slope(real: type) -> wp.Function:
    floor = real(_FLOOR)
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
def _exp_slope(real: type) -> wp.Function:
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
def _adjoint_of_relax(real: type) -> wp.Function:
    """Adjoints of (X, mu, K, d, v) of `_relax`, of those of its two results."""
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    eigen_, log1p_ = eigen(real), log1p_extended(real, _FLOOR)
    log_slope, exp_slope = _log_slope(real), _exp_slope(real)
    floor = real(_FLOOR)

    @wp.func(name=f"adjoint_of_relax_{real.__name__}")
    def adjoint(X: mat33, mu: real, K: real, d: real, v: real, adj_tau: mat33, adj_X_next: mat33):
        x, Q = eigen_(X)
        l = vec3(log1p_(x[0]), log1p_(x[1]), log1p_(x[2]))
        mean = (l[0] + l[1] + l[2]) / real(6.0)
        dev = vec3(real(0.5) * l[0] - mean, real(0.5) * l[1] - mean, real(0.5) * l[2] - mean)
        dh = wp.exp(-real(0.5) * d)
        vh = wp.exp(-real(0.5) * v)
        df = dh * dh
        vf = vh * vh
        # ln(1 + next) and its root
        y = vec3(
            real(2.0) * (df * dev[0] + vf * mean),
            real(2.0) * (df * dev[1] + vf * mean),
            real(2.0) * (df * dev[2] + vf * mean),
        )
        root = vec3(wp.exp(real(0.5) * y[0]), wp.exp(real(0.5) * y[1]), wp.exp(real(0.5) * y[2]))
        Qt = wp.transpose(Q)
        A = Qt * (adj_tau * Q)
        B = Qt * (adj_X_next * Q)
        a = wp.get_diag(A)
        b = real(2.0) * vec3(root[0] * root[0] * B[0, 0], root[1] * root[1] * B[1, 1], root[2] * root[2] * B[2, 2])
        a_sum = a[0] + a[1] + a[2]
        b_sum = b[0] + b[1] + b[2]
        shear = real(2.0) * mu * dh
        adj_mean = K * vh * a_sum + (vf * b_sum - shear * a_sum - df * b_sum) / real(3.0)
        T = mat33()
        for i in range(3):
            T[i, i] = real(0.5) * (shear * a[i] + df * b[i] + adj_mean) / wp.max(real(1.0) + x[i], floor)
        for i in range(3):
            j = (i + 1) % 3
            slope = real(0.5) * log_slope(x[i], x[j], l[i], l[j])
            exp_ij = exp_slope(y[i], y[j], root[i], root[j])
            T_ij = slope * (real(0.5) * shear * (A[i, j] + A[j, i]) + df * exp_ij * (B[i, j] + B[j, i]))
            T[i, j] = T_ij
            T[j, i] = T_ij
        dev_a = wp.dot(dev, a)
        dev_b = wp.dot(dev, b)
        return (
            Q * (T * Qt),
            real(2.0) * dh * dev_a,
            real(3.0) * vh * mean * a_sum,
            -real(0.5) * shear * dev_a - df * dev_b,
            -real(1.5) * K * vh * mean * a_sum - vf * mean * b_sum,
        )

    return adjoint


@functools.cache
def maxwell_hencky(real: type) -> wp.Function:
    """One step of a Hencky spring in series with a dash-pot, from the carried strain X = b - I.

        maxwell(X, mu, K, d, v) -> (tau, X_next)      d, v = dt / relaxation time of the deviator and the trace
        tau    = 2 mu e^{-d/2} dev eps + K e^{-v/2} tr(eps) I,   eps = 1/2 ln(I + X)             [Pa], as mu and K
        X_next = exp(2 (e^{-d} dev eps + e^{-v} tr(eps)/3 I)) - I

    Relaxation enters as expm1, so a slow one is an exact small increment of X and none leaves X as it is. Principal
    values of I + X below 1e-5 (compression to 0.3 %) go on along the tangent of the logarithm. `without_replay`.
    """
    mat33 = matrix_type(real)
    relax, adjoint = _relax(real), _adjoint_of_relax(real)

    @wp.func(name=f"maxwell_hencky_{real.__name__}")
    def maxwell(X: mat33, mu: real, K: real, d: real, v: real):
        tau, X_next = relax(X, mu, K, d, v)
        return tau, X_next

    @wp.func_grad(maxwell)
    def adj_maxwell(X: mat33, mu: real, K: real, d: real, v: real, adj_tau: mat33, adj_X_next: mat33):
        adj_X, adj_mu, adj_K, adj_d, adj_v = adjoint(X, mu, K, d, v, adj_tau, adj_X_next)
        wp.adjoint[X] += adj_X
        wp.adjoint[mu] += adj_mu
        wp.adjoint[K] += adj_K
        wp.adjoint[d] += adj_d
        wp.adjoint[v] += adj_v

    return without_replay(maxwell)


@functools.cache
def relax_hencky(real: type) -> wp.Function:
    """relax(X, d, v) -> (e^{-d/2} dev eps + e^{-v/2} tr(eps)/3 I, X_next): `maxwell_hencky` of 2 mu = 3 K = 1, whose
    results may enter further functions."""
    mat33 = matrix_type(real)
    relax, adjoint = _relax(real), _adjoint_of_relax(real)
    mu, K = real(1 / 2), real(1 / 3)

    @wp.func(name=f"relax_hencky_{real.__name__}")
    def relax_hencky(X: mat33, d: real, v: real):
        eps_half, X_next = relax(X, mu, K, d, v)
        return eps_half, X_next

    @wp.func_grad(relax_hencky)
    def adj_relax_hencky(X: mat33, d: real, v: real, adj_eps_half: mat33, adj_X_next: mat33):
        adj_X, _mu, _K, adj_d, adj_v = adjoint(X, mu, K, d, v, adj_eps_half, adj_X_next)
        wp.adjoint[X] += adj_X
        wp.adjoint[d] += adj_d
        wp.adjoint[v] += adj_v

    return relax_hencky


@functools.cache
def _box_flow(real: type) -> wp.Function:
    """flow(t, r, lower, upper) -> y = tr(c) - tr(t) of the point c nearest to t in the box lower <= c_i <= upper.

    Nearest in the energy 2 mu |c|^2 + lam (tr c)^2, r = lam/(2 mu) > -1/3: c_i = clamp(t_i - r y), which makes y the
    root of a falling, piecewise linear function. Its six kinks bracket the root, then one linear equation has it.
    """
    vec3 = wp.types.vector(3, real)

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
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    eigen_, expm1_, log1p_ = eigen(real), expm1(real), log1p_extended(real, _FLOOR)
    log_slope, exp_slope, flow = _log_slope(real), _exp_slope(real), _box_flow(real)
    floor = real(_FLOOR)

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
            slope = real(0.5) * share * log_slope(x[i], x[j], l[i], l[j])
            exp_ij = exp_slope(real(2.0) * c[i], real(2.0) * c[j], root[i], root[j])
            T_ij = slope * (real(0.5) * (A[i, j] + A[j, i]) + exp_ij * (B[i, j] + B[j, i]))
            T[i, j] = T_ij
            T[j, i] = T_ij
        wp.adjoint[X] += Q * (T * Qt)

    return box


def determinant(A: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """Of many matrices at once, which torch takes one by one."""
    return (torch.linalg.cross(A[:, 0], A[:, 1]) * A[:, 2]).sum(1)


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
