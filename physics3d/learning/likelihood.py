"""How much a clip speaks for one theta against another, where residuals hang together in space and time.

With r the residuals at theta, N L = |r|^2/2 their loss, Delta the difference that the other theta makes to the data,
and B the variance of Delta . r (`sandwich.py`, of Delta as if it were a derivative),

    lambda = B/|Delta|^2,     T = 2 N (L_other - L)/lambda

is a likelihood ratio whose residuals have been counted as often as they are independent (adjusted composite likelihood,
Pace, Salvan and Sartori 2011): next to theta it is the square of the distance in the sandwich's standard deviations.
lambda is known by nu blocks only, so that of theta against the other, which has d numbers less, speaks

    ln B = (nu + 1)/2 ln(1 + T/nu) - d/2 ln n,     n = |r|^2/lambda

with Student's likelihood, and Schwarz (1978) for the numbers; n are the places and times that are independent as far as
Delta sees them. Where neither theta needs to be at the bottom of its valley, nor the model right, the difference of the
losses is asked to be more than chance (Vuong 1989): the clip tells them apart with 90 % where

    N (L_other - L) > t_nu(0.95) sqrt(B)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scipy import stats
from torch import Tensor

from physics3d.learning.linear import apart
from physics3d.learning.loss import Chain
from physics3d.learning.sandwich import CERTAIN, Evidence, spread


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Of what was learned to another theta; losses are sums over all numbers, N L."""

    rise: float  # N (L_other - L)
    variance: float  # lambda
    deviation: float  # sqrt(B)
    freedom: float  # nu
    looks: float  # n

    @property
    def statistic(self) -> float:
        """T, negative where the other theta does better."""
        return 2 * self.rise / self.variance

    @property
    def told_apart(self) -> bool:
        """Whether the other theta does worse than chance would let it."""
        return self.rise > float(stats.t.ppf(0.5 + CERTAIN / 2, self.freedom)) * self.deviation

    def odds(self, fewer: int = 0, rise: float | None = None) -> float:
        """ln B against a theta that is described by so many numbers less; by another `rise` seen as well as this."""
        T = self.statistic if rise is None else 2 * rise / self.variance
        gain = math.copysign(0.5 * (self.freedom + 1) * math.log1p(abs(T) / self.freedom), T)
        return gain - 0.5 * fewer * math.log(self.looks)


def ratio(evidence: Evidence, rise: float, loss: float) -> Ratio:
    """By the `evidence` of Delta, k = 1; `rise` N (L_other - L), `loss` N L."""
    found, square = spread(evidence), float(evidence.JJ[0, 0])
    variance = float(found.B[0, 0]) / square if square > 0 else 0.0
    variance = max(variance, 1e-12 * 2 * loss, 1e-300)  # without residuals everything is told apart
    return Ratio(
        rise=rise,
        variance=variance,
        deviation=math.sqrt(variance * square),
        freedom=float(min(max(found.freedom[0], 1.0), 1e6)),
        looks=max(2 * loss / variance, 2.0),
    )


def ratios(chain: Chain, theta: Tensor, others: Sequence[tuple[Tensor, float]], *, seed: int) -> list[Ratio]:
    """Of the chain at theta to each of the others, whose losses L are given: one motion for each and two more."""
    if not others:
        return []
    pixels = sum(clip.numel() for clip in chain.clips.values())
    here = chain.measure(theta, seed)
    evidence = apart(chain, theta, [other for other, _ in others], seed=seed)
    return [
        ratio(one, rise=pixels * (loss - here), loss=pixels * here)
        for one, (_, loss) in zip(evidence, others, strict=True)
    ]
