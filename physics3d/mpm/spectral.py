"""Functions of 3x3 matrices that stay exact near the identity and differentiable at repeated stretches.

Every argument is a deviation from the identity (H = F - I, X = b - I), because 1 + x in float32 loses x below 6e-8.
Derivatives are those of the tensor function, never of single eigenvectors, so equal eigenvalues are nothing special:

    f(S) = Q f(l) Q^T,   adjoint of S = Q [K o (Q^T sym(A) Q)] Q^T,   K_ij = (f_i - f_j)/(l_i - l_j)   (Daleckii, Krein)

and the polar factor has denominators s_i + s_j only. Each name below is a memoised factory: given `real` = wp.float32
or wp.float64 it returns the Warp function. Higham, Functions of Matrices (2008), sec. 3.2; Lin, Chitalu, Komura (2022)
for the polar factor from invariants.
"""

import functools
import math

import warp as wp


def matrix_type(real: type) -> type:
    """3x3 matrix of `real`."""
    return wp.types.matrix((3, 3), real)


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
        series = real(0.0)
        for i in range(terms):
            series = series * s * s + real(1.0) / real(2 * (terms - i) - 1)
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
        series = real(1.0)
        for i in range(terms):
            series = real(1.0) + series * x / real(terms + 1 - i)
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
    """ln det(I + X) of a positive semidefinite I + X, its tangent below det = 1e-12 (all lengths a hundredth)."""
    mat33 = matrix_type(real)
    volume_change_, cofactor_, log1p_ = volume_change(real), cofactor(real), log1p(real)
    floor = real(1e-12)

    @wp.func(name=f"log_det_{real.__name__}")
    def log_det(X: mat33):
        change = volume_change_(X)
        if wp.abs(change) < real(0.5):
            return log1p_(change)
        det = wp.determinant(wp.identity(n=3, dtype=real) + X)
        above = wp.max(det, floor)
        return wp.log(above) + (det - above) / floor

    @wp.func_grad(log_det)
    def adj_log_det(X: mat33, adj_ret: real):
        A = wp.identity(n=3, dtype=real) + X
        wp.adjoint[X] += adj_ret / wp.max(wp.determinant(A), floor) * cofactor_(A)

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
    vec3 = wp.types.vector(3, real)
    volume_change_, cofactor_ = volume_change(real), cofactor(real)
    near_steps = 3 if real is wp.float32 else 4
    tolerance = real(1e-7 if real is wp.float32 else 1e-15)
    least = real(1e-5 if real is wp.float32 else 1e-9)

    @wp.func(name=f"polar_denominator_{real.__name__}")
    def denominator(D: real, i1: real):
        return wp.max(D, least * i1 * wp.sqrt(i1) + real(1e-30))

    @wp.func(name=f"polar_rotation_{real.__name__}")
    def rotation(F: mat33, b: mat33, i1: real, l: real, D: real):
        return (real(0.5) * (l * l + i1) * F + l * cofactor_(F) - b * F) / D

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

    @wp.func_grad(stretch)
    def adj_stretch(H: mat33, adj_ret: mat33):
        one = wp.identity(n=3, dtype=real)
        F = one + H
        V = one + stretch(H)
        A = real(0.5) * (adj_ret + wp.transpose(adj_ret))
        b = F * wp.transpose(F)
        i1 = wp.ddot(F, F)
        l = wp.trace(V)
        T = l * one - V  # eigenvalues s_i + s_j
        D = denominator(wp.determinant(T), i1)
        W = V * A - A * V
        q = (cofactor_(T) * vec3(W[2, 1], W[0, 2], W[1, 0])) / D
        Q = wp.skew(q)
        wp.adjoint[H] += (A - Q) * rotation(F, b, i1, l, D)

    return stretch


@functools.cache
def eigen(real: type) -> wp.Function:
    """(x, Q) of a symmetric matrix X = Q diag(x) Q^T by cyclic Jacobi rotations. Not differentiable by itself."""
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    small = real((6e-8 if real is wp.float32 else 1e-16) ** 2)

    @wp.func(name=f"jacobi_angle_{real.__name__}")
    def angle(app: real, aqq: real, apq: real):
        """(cos, sin) of the rotation that annihilates apq."""
        if apq * apq == real(0.0):  # also where the square underflows: h would be 0
            return real(1.0), real(0.0)
        d = aqq - app
        h = wp.sqrt(d * d + real(4.0) * apq * apq)
        c = wp.sqrt(real(0.5) + real(0.5) * wp.abs(d) / h)
        s = apq / (h * c)
        if d < real(0.0):
            s = -s
        return c, s

    @wp.func(name=f"eigen_{real.__name__}")
    def eigen(X: mat33):
        a = X[0, 0]
        b = X[1, 1]
        c = X[2, 2]
        f = X[1, 2]
        g = X[0, 2]
        h = X[0, 1]
        u = vec3(real(1.0), real(0.0), real(0.0))
        v = vec3(real(0.0), real(1.0), real(0.0))
        w = vec3(real(0.0), real(0.0), real(1.0))
        for _ in range(8):
            off = f * f + g * g + h * h
            if off <= small * (a * a + b * b + c * c):
                break
            # rows 0, 1
            cos, sin = angle(a, b, h)
            a_, b_ = a, b
            a = cos * cos * a_ - real(2.0) * cos * sin * h + sin * sin * b_
            b = sin * sin * a_ + real(2.0) * cos * sin * h + cos * cos * b_
            g_ = g
            g = cos * g_ - sin * f
            f = sin * g_ + cos * f
            h = real(0.0)
            u_ = u
            u = cos * u_ - sin * v
            v = sin * u_ + cos * v
            # rows 0, 2
            cos, sin = angle(a, c, g)
            a_, c_ = a, c
            a = cos * cos * a_ - real(2.0) * cos * sin * g + sin * sin * c_
            c = sin * sin * a_ + real(2.0) * cos * sin * g + cos * cos * c_
            h_ = h
            h = cos * h_ - sin * f
            f = sin * h_ + cos * f
            g = real(0.0)
            u_ = u
            u = cos * u_ - sin * w
            w = sin * u_ + cos * w
            # rows 1, 2
            cos, sin = angle(b, c, f)
            b_, c_ = b, c
            b = cos * cos * b_ - real(2.0) * cos * sin * f + sin * sin * c_
            c = sin * sin * b_ + real(2.0) * cos * sin * f + cos * cos * c_
            h_ = h
            h = cos * h_ - sin * g
            g = sin * h_ + cos * g
            f = real(0.0)
            v_ = v
            v = cos * v_ - sin * w
            w = sin * v_ + cos * w
        return vec3(a, b, c), wp.matrix_from_cols(u, v, w)

    return eigen


@functools.cache
def _relax_by_series(real: type) -> wp.Function:
    """`relax_hencky` for |X| < 0.4. Powers beyond the second are eliminated by Cayley-Hamilton, so a term costs three
    multiplications:

        eps = atanh Z = Z (1 + W/3 + W^2/5 + ...),   Z = X (2 I + X)^-1,   W = Z^2          |W| < 1/16
        X_next = X + (I + X) (e^D - I),   D = 2 (expm1(-d) dev eps + expm1(-v) tr(eps)/3 I)  |D| < 0.52
    """
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    expm1_ = expm1(real)
    log_terms = 6 if real is wp.float32 else 13  # truncated below 1e-8, 1e-17; at most 16, which Warp unrolls
    exp_terms = 8 if real is wp.float32 else 14

    @wp.func(name=f"invariants_{real.__name__}")
    def invariants(A: mat33):
        trace = wp.trace(A)
        return vec3(trace, real(0.5) * (trace * trace - wp.ddot(A, A)), wp.determinant(A))

    @wp.func(name=f"times_{real.__name__}")
    def times(c: vec3, I: vec3):
        """Coefficients of (c0 + c1 A + c2 A^2) A, reduced by A^3 = I1 A^2 - I2 A + I3."""
        return vec3(c[2] * I[2], c[0] - c[2] * I[1], c[1] + c[2] * I[0])

    @wp.func(name=f"relax_by_series_{real.__name__}")
    def relax(X: mat33, d: real, v: real):
        one = wp.identity(n=3, dtype=real)
        Z = X * wp.inverse(real(2.0) * one + X)
        W = Z * Z
        I = invariants(W)
        c = vec3()
        for i in range(log_terms):
            c = times(c, I) + vec3(real(1.0) / real(2 * (log_terms - i) - 1), real(0.0), real(0.0))
        eps = Z * (c[0] * one + c[1] * W + c[2] * (W * W))
        mean = wp.trace(eps) / real(3.0) * one
        dev = eps - mean
        dh = expm1_(-real(0.5) * d)
        vh = expm1_(-real(0.5) * v)
        D = real(2.0) * (dh * (real(2.0) + dh) * dev + vh * (real(2.0) + vh) * mean)
        I_D = invariants(D)
        e = vec3(real(1.0), real(0.0), real(0.0))
        for i in range(exp_terms):
            e = times(e, I_D) / real(exp_terms + 1 - i) + vec3(real(1.0), real(0.0), real(0.0))
        change = D * (e[0] * one + e[1] * D + e[2] * (D * D))
        return eps + dh * dev + vh * mean, X + change + X * change

    return relax


@functools.cache
def relax_hencky(real: type) -> wp.Function:
    """Strang-exponential relaxation of the log strain eps = 1/2 ln(I + X).

        relax(X, d, v) -> (eps_half, X_next)      X symmetric; d, v = dt / relaxation time of the deviator and the trace
        eps_half = e^{-d/2} dev eps + e^{-v/2} tr(eps)/3 I
        X_next   = exp(2 (e^{-d} dev eps + e^{-v} tr(eps)/3 I)) - I

    Relaxation enters as expm1, so a slow one is an exact small increment of X and none leaves X as it is. Below 20 %
    strain by series, twice as fast as the eigendecomposition that serves all others and the adjoint. Principal values
    of I + X below 1e-5 (compression to 0.3 %) go on along the tangent of the logarithm.
    """
    mat33 = matrix_type(real)
    vec3 = wp.types.vector(3, real)
    eigen_, log1p_, expm1_ = eigen(real), log1p(real), expm1(real)
    floor = real(1e-5)
    extended = log1p_extended(real, 1e-5)
    relax_by_series = _relax_by_series(real)

    @wp.func(name=f"relax_hencky_{real.__name__}")
    def relax(X: mat33, d: real, v: real):
        if wp.ddot(X, X) < real(0.16):
            eps_near, X_near = relax_by_series(X, d, v)
            return eps_near, X_near
        x, Q = eigen_(X)
        dh = expm1_(-real(0.5) * d)
        vh = expm1_(-real(0.5) * v)
        df = dh * (real(2.0) + dh)  # expm1(-d)
        vf = vh * (real(2.0) + vh)
        eps = real(0.5) * vec3(extended(x[0]), extended(x[1]), extended(x[2]))
        mean = (eps[0] + eps[1] + eps[2]) / real(3.0)
        half = vec3()
        change = vec3()
        for i in range(3):
            dev = eps[i] - mean
            half[i] = eps[i] + dh * dev + vh * mean
            before = x[i]
            if real(1.0) + x[i] < floor:
                before = wp.exp(real(2.0) * eps[i]) - real(1.0)
            change[i] = (real(1.0) + before) * expm1_(real(2.0) * (df * dev + vf * mean)) + before - x[i]
        eps_half = Q * wp.diag(half) * wp.transpose(Q)
        X_next = X + Q * wp.diag(change) * wp.transpose(Q)
        return eps_half, X_next

    @wp.func(name=f"log1p_slope_{real.__name__}")
    def log_slope(x: real, y: real):
        """Divided difference of the extended ln(1 + x)."""
        if wp.min(x, y) < floor - real(1.0):
            if wp.abs(x - y) < real(1e-3) * floor:
                return real(1.0) / wp.max(real(1.0) + x, floor)
            return (extended(x) - extended(y)) / (x - y)
        r = (x - y) / (real(1.0) + y)
        slope = real(1.0)
        if r != real(0.0):
            slope = log1p_(r) / r
        return slope / (real(1.0) + y)

    @wp.func(name=f"exp_slope_{real.__name__}")
    def exp_slope(x: real, y: real):
        """Divided difference of exp."""
        r = x - y
        slope = real(1.0)
        if r != real(0.0):
            slope = expm1_(r) / r
        return wp.exp(y) * slope

    @wp.func_grad(relax)
    def adj_relax(X: mat33, d: real, v: real, adj_eps_half: mat33, adj_X_next: mat33):
        x, Q = eigen_(X)
        eps = real(0.5) * vec3(extended(x[0]), extended(x[1]), extended(x[2]))
        mean = (eps[0] + eps[1] + eps[2]) / real(3.0)
        dev = eps - vec3(mean, mean, mean)
        dh = wp.exp(-real(0.5) * d)
        vh = wp.exp(-real(0.5) * v)
        y = real(2.0) * (dh * dh * dev + vh * vh * vec3(mean, mean, mean))
        A = wp.transpose(Q) * adj_eps_half * Q
        B = wp.transpose(Q) * adj_X_next * Q
        for i in range(3):
            for j in range(3):
                B[i, j] = real(2.0) * exp_slope(y[i], y[j]) * B[i, j]
        a = wp.get_diag(A)
        b = wp.get_diag(B)
        a_sum = a[0] + a[1] + a[2]
        b_sum = b[0] + b[1] + b[2]
        wp.adjoint[d] += -real(0.5) * dh * wp.dot(dev, a) - dh * dh * wp.dot(dev, b)
        wp.adjoint[v] += -real(0.5) * vh * mean * a_sum - vh * vh * mean * b_sum
        trace = ((vh - dh) * a_sum + (vh * vh - dh * dh) * b_sum) / real(3.0)
        T = dh * A + dh * dh * B + trace * wp.identity(n=3, dtype=real)
        for i in range(3):
            for j in range(3):
                T[i, j] = real(0.5) * log_slope(x[i], x[j]) * T[i, j]
        G = Q * T * wp.transpose(Q)
        wp.adjoint[X] += real(0.5) * (G + wp.transpose(G))

    return relax
