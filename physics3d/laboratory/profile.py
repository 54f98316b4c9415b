"""How far each parameter can go before the tests object: where a valley is flat, curved or long.

    C_i(x) = min over the other parameters of the sum of squares with theta_i = x,   ends: C_i(x) = limit

An interval from derivatives holds where the curves tell all parameters; where they do not tell one of them, the best
fit itself is an accident of the noise, and so are the derivatives there. Each parameter is walked from the best
towards either bound, all others fitted again from where the last point left them (profile likelihood; Venzon and
Moolgavkar 1988).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy import optimize

WALK = (0.1, 0.25, 0.5, 1.0)  # of the way to the bound
HALVINGS = 2  # between the last point that the tests allow and the first that they do not
EVALUATIONS = 25  # at most, of a fit of the others
ENOUGH = 1e-3  # change of the sum of squares, or of a parameter, at which it stops: the limit is a tenth or so away

Vector = Float[np.ndarray, " p"]


def ends(
    theta: Vector,
    bounds: tuple[Vector, Vector],
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], np.ndarray],
    limit: float,
) -> tuple[Vector, Vector]:
    """(lower, upper) of every parameter; `limit` is the largest sum of squares that is as good as the best."""
    lower, upper = theta.copy(), theta.copy()
    for i in range(len(theta)):
        for end, bound in ((lower, bounds[0][i]), (upper, bounds[1][i])):
            end[i] = _end(theta, i, bound, bounds, residuals, slopes, limit)
    return lower, upper


def _end(theta, i: int, bound: float, bounds, residuals, slopes, limit: float) -> float:
    others = np.arange(len(theta)) != i
    inside = [b[others] for b in bounds]
    last, good = theta, 0.0

    def reached(share: float) -> tuple[bool, np.ndarray]:
        point = last.copy()
        point[i] = theta[i] + share * (bound - theta[i])

        def full(x: np.ndarray) -> np.ndarray:
            whole = point.copy()
            whole[others] = x
            return whole

        found = optimize.least_squares(
            lambda x: residuals(full(x)), np.clip(point[others], inside[0] + 1e-9, inside[1] - 1e-9),
            lambda x: slopes(full(x))[:, others], bounds=inside, max_nfev=EVALUATIONS, ftol=ENOUGH, xtol=ENOUGH,
        )  # fmt: skip
        return 2 * found.cost <= limit, full(found.x)

    bad = None
    for share in WALK:
        allowed, point = reached(share)
        if not allowed:
            bad = share
            break
        last, good = point, share
    if bad is None:
        return bound
    for _ in range(HALVINGS):
        middle = (good + bad) / 2
        allowed, point = reached(middle)
        if allowed:
            last, good = point, middle
        else:
            bad = middle
    return float(theta[i] + bad * (bound - theta[i]))
