"""What curves tell of parameters: a 90 % interval that is true although residuals in a curve are correlated.

theta minimises sum_i |r_i|^2 over the tests i, r_i = (measured - predicted) of test i in its own scale, J = dr/dtheta.
What makes the residuals of one curve (noise, drift, a law that is not quite that of the specimen) is taken for an
AR(1) process along its rows, S_i = s_i^2 rho_i^|j - k|, apart for each test; tests are independent. Then (sandwich
estimate)

    C = A^-1 B A^-1,   A = sum J_i^T J_i,   B = sum J_i^T S_i J_i
    n_i' = n_i (1 - rho_i)/(1 + rho_i)          independent rows that the curve is worth
    s_i^2 = mean r_i^2  n_i'/(n_i' - h_i),      h_i = tr(J_i A^-1 J_i^T) n_i'/n_i, the parameters that test i pays for

with Student's t of sum (n_i' - h_i) degrees of freedom. Directions that the curves do not see carry no information;
what the bounds of the fit allow (a uniform distribution between them, by its variance) is added to all of them, so
that an interval never reaches beyond.

Rows of the prescribed column are taken as exact. White (1980); Newey and West (1987); Andrews (1991) for AR(1) plug-in.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import linalg, stats

LEVEL = 0.9
MOST_CORRELATED = 0.995  # rho of a residual that hardly ever changes its sign


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Of theta, symmetric about the fit but where it meets a bound."""

    lower: Float[np.ndarray, " p"]
    upper: Float[np.ndarray, " p"]
    determined: tuple[bool, ...]  # by the tests, rather than by the bounds
    correlation: tuple[float, ...]  # rho of each test
    worth: float  # independent rows of all tests

    @property
    def half(self) -> Float[np.ndarray, " p"]:
        return (self.upper - self.lower) / 2


def correlation(residual: Float[np.ndarray, " n"]) -> float:
    """rho of one row to the next, its bias of -(1 + 3 rho)/n for short curves put right; not below 0."""
    square = float(residual @ residual)
    rho = float(residual[1:] @ residual[:-1]) / square if square > 0 else 0.0
    return float(np.clip(rho + (1 + 3 * rho) / len(residual), 0.0, MOST_CORRELATED))


def interval(
    theta: Float[np.ndarray, " p"],
    residuals: list[Float[np.ndarray, " _"]],
    slopes: list[Float[np.ndarray, "_ p"]],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
) -> Interval:
    """Of a fit theta within its bounds. `residuals` and `slopes` are of the tests; rows that tell nothing are left
    out."""
    A = sum((J.T @ J for J in slopes), np.zeros((len(theta), len(theta))))
    rho = [correlation(r) for r in residuals]
    inverse = np.linalg.pinv(A, rcond=1e-12, hermitian=True)
    B, freedom, worth = np.zeros_like(A), 0.0, 0.0
    for r, J, q in zip(residuals, slopes, rho):
        independent = max(len(r) * (1 - q) / (1 + q), 1.0)
        paid = float(np.trace(J @ inverse @ J.T)) * independent / len(r)
        left = max(independent - paid, 0.5)
        variance = float(r @ r) / len(r) * independent / left
        B += variance * J.T @ linalg.matmul_toeplitz(q ** np.arange(len(r)), J)
        freedom, worth = freedom + left, worth + independent
    # information of the directions that are seen
    size, axes = np.linalg.eigh(A)
    seen = axes[:, size > 1e-10 * size.max()]
    A_seen, B_seen = seen.T @ A @ seen, seen.T @ B @ seen
    B_seen += 1e-14 * np.trace(B_seen) * np.eye(len(B_seen)) + 1e-300 * np.eye(len(B_seen))
    information = seen @ (A_seen @ np.linalg.solve(B_seen, A_seen)) @ seen.T
    lower, upper = bounds
    allowed = (upper - lower) / np.sqrt(12)
    covariance = np.linalg.inv(information + np.diag(allowed**-2))
    half = stats.t.ppf((1 + LEVEL) / 2, max(freedom, 1.0)) * np.sqrt(np.diag(covariance))
    low, high = np.maximum(theta - half, lower), np.minimum(theta + half, upper)
    return Interval(lower=low, upper=high, determined=told(low, high, bounds), correlation=tuple(rho), worth=worth)


def widened(of: Interval, lower: np.ndarray, upper: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> Interval:
    """The interval that reaches to both."""
    low, high = np.minimum(of.lower, lower), np.maximum(of.upper, upper)
    return replace(of, lower=low, upper=high, determined=told(low, high, bounds))


def told(low: np.ndarray, high: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> tuple[bool, ...]:
    """Whether the tests determine a parameter: a factor of ten between its ends, or half of what was allowed, is no
    answer."""
    return tuple(bool(x) for x in (high - low < np.minimum(np.log(10), (bounds[1] - bounds[0]) / 2)))
