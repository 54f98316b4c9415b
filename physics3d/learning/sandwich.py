"""Covariance of least squares whose residuals hang together in space and time: a sandwich over two kinds of blocks.

With J_i the derivatives of number i of the data by the k parameters, r_i its residual and s_i = J_i^T r_i its score,

    A = sum_i J_i^T J_i,     V = A^-1 B A^-1,     B = sum over pairs i, j that may hang together of s_i s_j^T

(Huber 1967; White 1980). Pairs may hang together in the same block of pixels at any two times, for what is drawn wrong
is drawn wrong in every frame, or in the same block of frames anywhere in the pictures, for a motion that is predicted
wrong is wrong all over the thing. With c_TP the sum of scores in block of frames T and block of pixels P (two-way
clusters, Cameron, Gelbach and Miller 2011; X_+ is X without its negative part, measured by A, so that B stays positive)

    B_P = sum_P (sum_T c) (sum_T c)^T,  B_T = sum_T (sum_P c) (sum_P c)^T,  B_PT = sum_PT c c^T
    B   = B_PT + (g_P B_P - B_PT)_+ + (g_T B_T - B_PT)_+

A block of pixels is SIDE correlation lengths wide, less where what is seen is smaller than LEAST of them; a block of
frames as long as Andrews (1991) advises for the Bartlett kernel and scores that follow an AR(1). Few blocks know their
own spread badly: g = n/(n - 1), and the quantiles are Student's, with n the effective number of blocks, that is
(sum I)^2/sum I^2 of their shares I of J^T J (Carter, Schnepel and Steigerwald 2017), and the degrees of freedom of a
sum of variances with n - 1 each (Satterthwaite 1946). With residuals independent from pixel to pixel V is s^2 A^-1,
orders of magnitude less than the truth in a video.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

SIDE = 6.0  # of a block of pixels, in correlation lengths
LEAST = 3  # blocks along what is seen, however small: one block says nothing
CERTAIN = 0.9  # share of the truths that an interval is to hold
NORMAL = float(stats.norm.ppf(0.5 + CERTAIN / 2))  # half width in standard deviations


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Least squares around its solution. Residuals, and with them scores, in any unit, but in one; n frames, p blocks
    of pixels, of all views."""

    JJ: Float[np.ndarray, "k k"]  # A
    score: Float[np.ndarray, "n p k"]  # sums of s over a block of pixels in a frame
    share: Float[np.ndarray, "n p k"]  # sums of squares of J, likewise


@dataclass(frozen=True, kw_only=True)
class Spread:
    """What `spread` finds."""

    B: Float[np.ndarray, "k k"]
    student: Float[np.ndarray, " k"]  # factor on a standard deviation that makes a normal quantile Student's
    freedom: Float[np.ndarray, " k"]  # degrees of freedom by which B is known
    places: float  # effective blocks of pixels, of the parameter that has fewest
    times: float  # and of frames
    frames: int  # in a block of frames


def spread(evidence: Evidence) -> Spread:
    """B and how well it is known. Parameters that nothing depends on have rows of zeros."""
    course = evidence.score.sum(1)
    length = block_length(course)
    starts = np.arange(0, len(course), length)
    c, share = np.add.reduceat(evidence.score, starts), np.add.reduceat(evidence.share, starts)
    outer = lambda x: x.reshape(-1, x.shape[-1]).T @ x.reshape(-1, x.shape[-1])
    root, inverse = _root(evidence.JJ), np.linalg.pinv(evidence.JJ, hermitian=True)
    variance = lambda X: np.einsum("ij,jk,ki->i", inverse, X, inverse)
    places, times, every = (effective(share.sum(0)), effective(share.sum(1)), effective(share.reshape(-1, len(root))))
    B = outer(c)
    parts = [(B, every)]
    for sums, count in ((c.sum(0), places), (c.sum(1), times)):
        few = np.sqrt(count / np.maximum(count - 1, 0.5))
        parts.append((_positive(outer(sums * few) - B, root), count))
    freedom = np.sum([variance(X) ** 2 / np.maximum(count - 1, 1.0) for X, count in parts], axis=0)
    total = np.sum([X for X, _ in parts], axis=0)
    freedom = np.where(freedom > 0, variance(total) ** 2 / np.maximum(freedom, 1e-300), np.inf)
    freedom = np.maximum(freedom, 1.0)
    return Spread(
        B=total,
        student=stats.t.ppf(0.5 + CERTAIN / 2, freedom) / NORMAL,
        freedom=freedom,
        places=float(places.min()),
        times=float(times.min()),
        frames=length,
    )


def effective(share: Float[np.ndarray, "b k"]) -> Float[np.ndarray, " k"]:
    """Number of blocks that would be, had all the same share of what is known of each parameter."""
    total = share.sum(0)
    return np.where(total > 0, total**2 / np.maximum((share**2).sum(0), 1e-300), 1.0)


def block_length(course: Float[np.ndarray, "n k"]) -> int:
    """Frames in a block, by the correlation of the scores of neighbouring frames; at most a quarter of them."""
    n = len(course)
    power = (course**2).sum(0)
    rho = np.where(power > 0, (course[1:] * course[:-1]).sum(0) / np.maximum(power, 1e-300), 0.0).clip(0, 0.97)
    alpha = 4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)
    return max(1, min(round(1.1447 * float(alpha.max() * n) ** (1 / 3)), n // 4))


def correlation_length(residual: Float[np.ndarray, "n h w"]) -> float:
    """Distance [px] at which the correlation of residuals, mean over all frames and directions, falls below 1/e; at
    least 1. Pixels that do not count are 0 in all frames."""
    h, w = residual.shape[1:]
    size = (2 * h, 2 * w)
    autocorrelation = lambda x: np.fft.irfft2(np.abs(np.fft.rfft2(x, size)) ** 2, size)
    power = np.zeros(size)
    for frame in residual:
        power += autocorrelation(frame)
    pairs = autocorrelation((np.abs(residual).max(0) > 0).astype(float))
    y, x = np.fft.fftfreq(size[0], 1 / size[0]), np.fft.fftfreq(size[1], 1 / size[1])
    ring = np.round(np.hypot(y[:, None], x[None])).astype(int).ravel()
    total, count = np.bincount(ring, power.ravel()), np.bincount(ring, pairs.ravel())
    if not total[0] > 0:
        return 1.0
    correlation = (total / np.maximum(count, 1.0)) / (total[0] / count[0])
    below = np.flatnonzero(correlation < np.exp(-1))
    if not len(below):
        return float(max(h, w))
    i = below[0]
    before = correlation[i - 1]
    return max(1.0, float(i - 1 + (before - np.exp(-1)) / max(before - correlation[i], 1e-12)))


def blocks(
    row: Int[np.ndarray, " m"], column: Int[np.ndarray, " m"], length: float
) -> tuple[Int[np.ndarray, " m"], int]:
    """(block of each pixel, how many) by the correlation length of residuals [px]; of pixels that count."""
    extent = max(int(np.ptp(row)), int(np.ptp(column))) + 1
    side = max(1, min(round(SIDE * length), math.ceil(extent / LEAST)))
    places = np.stack([(row - row.min()) // side, (column - column.min()) // side])
    _, block = np.unique(places, axis=1, return_inverse=True)
    return block.reshape(-1), int(block.max()) + 1


def _root(A: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(A)
    return vectors * np.sqrt(np.maximum(values, 1e-12 * max(values[-1], 1e-300)))


def _positive(X: np.ndarray, root: np.ndarray) -> np.ndarray:
    """X without its negative part, where lengths are measured by root root^T."""
    inverse = np.linalg.pinv(root)
    values, vectors = np.linalg.eigh(inverse @ X @ inverse.T)
    half = root @ (vectors * np.sqrt(np.maximum(values, 0)))
    return half @ half.T
