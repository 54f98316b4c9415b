"""Functions of 3x3 matrices that stay exact near the identity and differentiable at repeated stretches.

Every argument is a deviation from the identity (H = F - I, X = b - I), every function a memoised Warp function for
`real` = wp.float32 or wp.float64.
"""

import functools

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
def log1p(real: type) -> wp.Function:
    """ln(1 + x), accurate for small x (Kahan; Warp has no log1p on the CPU)."""

    @wp.func(name=f"log1p_{real.__name__}")
    def log1p(x: real):
        u = real(1.0) + x
        if u == real(1.0):
            return x
        return wp.log(u) * (x / (u - real(1.0)))

    @wp.func_grad(log1p)
    def adj_log1p(x: real, adj_ret: real):
        wp.adjoint[x] += adj_ret / (real(1.0) + x)

    return log1p


@functools.cache
def log1p_extended(real: type, floor: float) -> wp.Function:
    """ln(1 + x) where 1 + x > floor, its tangent there below."""
    lowest = real(floor)
    log1p_ = log1p(real)

    @wp.func(name=f"log1p_extended_{real.__name__}_{floor:.0e}".replace("-", "m"))
    def log1p_extended(x: real):
        above = wp.max(x, lowest - real(1.0))
        return log1p_(above) + (x - above) / lowest

    @wp.func_grad(log1p_extended)
    def adj_log1p_extended(x: real, adj_ret: real):
        wp.adjoint[x] += adj_ret / wp.max(real(1.0) + x, lowest)

    return log1p_extended
