"""What curves tell of parameters: a 90 % interval that is true although residuals in a curve are correlated.

theta minimises sum_i |r_i|^2 over the tests i, r_i = (predicted - measured) of test i in its own scale, J = dr/dtheta.
What makes the residuals of one curve (noise, drift, a law that is not quite that of the specimen) is taken for an AR(1)
process along its rows, S_i = s_i^2 rho_i^|j - k|, apart for each test; tests are independent. Then (sandwich estimate)

    C = A^-1 B A^-1,   A = sum J_i^T J_i,   B = sum J_i^T S_i J_i

A fit takes from its residuals what it can explain, correlation above all. With R the matrix rho^|j - k|, L that of a
row to the next and M = 1 - J_i A^-1 J_i^T, rho_i and s_i are therefore those for which residuals of noise are as found:

    r^T L r/r^T r = tr(L M R M)/tr(M R M),   s_i^2 = r^T r/tr(M R M)

with Student's t of sum tr(M R)^2/tr(M R M R) degrees of freedom (Satterthwaite). Directions that the curves do not see
carry no information; what the bounds of the fit allow (a uniform distribution between them, by its variance) is added
to all of them, so that an interval never reaches beyond.

Rows of the prescribed column are taken as exact. White (1980); Newey and West (1987); Andrews (1991) for AR(1) plug-in.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import linalg, stats

LEVEL = 0.9
RHO = np.concatenate([np.arange(0, 0.9, 0.05), np.arange(0.9, 0.995, 0.01), [0.995]])  # what is tried


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


@dataclass(frozen=True, kw_only=True)
class _Noise:
    """AR(1) noise of one curve, as its residual tells."""

    rho: float
    variance: float  # s^2
    freedom: float
    spread: Float[np.ndarray, "p p"]  # J^T S J
    worth: float  # independent rows


def _noise(r: Float[np.ndarray, " n"], J: Float[np.ndarray, "n p"], inverse: Float[np.ndarray, "p p"]) -> _Noise:
    """The rho of a grid whose expected correlation of residuals is nearest to the one that was found."""
    n, square = len(r), float(r @ r)
    found = float(r[1:] @ r[:-1]) / square if square > 0 else 0.0
    tried = [_expected(rho, J, inverse) for rho in RHO]
    best = int(np.argmin([abs(shifted / size - found) for size, shifted, _, _ in tried]))
    size, _, freedom, JRJ = tried[best]
    rho, variance = float(RHO[best]), square / size
    worth = n * (1 - rho) / (1 + rho)
    return _Noise(rho=rho, variance=variance, freedom=freedom, spread=variance * JRJ, worth=worth)


def _expected(rho: float, J: np.ndarray, inverse: np.ndarray) -> tuple[float, float, float, np.ndarray]:
    """(tr(M R M), tr(L M R M), tr(M R)^2/tr(M R M R), J^T R J) without a matrix of n x n."""
    n = len(J)
    powers = rho ** np.arange(n)
    RJ = linalg.matmul_toeplitz(powers, J)
    up, down = (np.roll(J, k, 0) for k in (1, -1))
    up[0], down[-1] = 0, 0
    LJ = (up + down) / 2  # of the symmetric part of L: its trace with a symmetric matrix is that of L
    JRJ, JJ = J.T @ RJ, J.T @ J
    H_R, H_H = inverse @ JRJ, inverse @ JJ
    size = n - 2 * np.trace(H_R) + np.trace(H_R @ H_H)
    shifted = (n - 1) * rho - 2 * np.trace(inverse @ (LJ.T @ RJ)) + np.trace(inverse @ JRJ @ inverse @ (J.T @ LJ))
    R_R = n + 2 * float((n - np.arange(1, n)) @ powers[1:] ** 2)
    once = n - np.trace(H_R)
    twice = R_R - 2 * np.trace(inverse @ (RJ.T @ RJ)) + np.trace(H_R @ H_R)
    least = 1e-3 * n  # of what a fit leaves: rounding, where it explains everything
    return max(size, least), float(shifted), float(once**2 / max(twice, least)), JRJ


def interval(
    theta: Float[np.ndarray, " p"],
    residuals: list[Float[np.ndarray, " _"]],
    slopes: list[Float[np.ndarray, "_ p"]],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
) -> Interval:
    """Of a fit theta within its bounds. `residuals` and `slopes` are of the tests; rows that tell nothing are left
    out."""
    A = sum((J.T @ J for J in slopes), np.zeros((len(theta), len(theta))))
    inverse = np.linalg.pinv(A, rcond=1e-12, hermitian=True)
    noises = [_noise(r, J, inverse) for r, J in zip(residuals, slopes)]
    B = sum((noise.spread for noise in noises), np.zeros_like(A))
    freedom = sum(noise.freedom for noise in noises)
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
    return Interval(
        lower=low,
        upper=high,
        determined=told(low, high, bounds),
        correlation=tuple(n.rho for n in noises),
        worth=sum(n.worth for n in noises),
    )


def widened(of: Interval, lower: np.ndarray, upper: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> Interval:
    """The interval that reaches to both."""
    low, high = np.minimum(of.lower, lower), np.maximum(of.upper, upper)
    return replace(of, lower=low, upper=high, determined=told(low, high, bounds))


def told(low: np.ndarray, high: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> tuple[bool, ...]:
    """Whether the tests determine a parameter: a factor of ten between its ends, or half of what was allowed, is no
    answer."""
    return tuple(bool(x) for x in (high - low < np.minimum(np.log(10), (bounds[1] - bounds[0]) / 2)))
