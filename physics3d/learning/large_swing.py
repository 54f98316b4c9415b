"""Large swings are slower than small ones and die out faster: what the amplitude does to frequency and damping.

Of a swing of amplitude A_0 at time 0, with f and d of small swings,

    frequency  f (1 - k (A/A_0)^n),     dA/dt = -d A (1 + g (A/A_0)^n)

so that the phase is 2 pi f (t - k l(t)) and A = A_0 e^(-d (t + g l(t))), with

    l(t) = integral of (A/A_0)^n = ln(1 + g (1 - e^(-n d t)))/(n g d)     (Bernoulli's equation)

This is what a weak force that is not linear does to a vibration, averaged over a period (Nayfeh and Mook 1979,
Nonlinear Oscillations). n = 2 where the force is smooth, as in a stem that softens as it is strained; n = 1 where it
rubs in loops whose area is the cube of the amplitude, or drags as the square of the speed, as air does.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

EARLIEST = -0.9  # of g (1 - e^(-n d t)): before time 0 the amplitude would have been infinite where it is -1


@dataclass(frozen=True, kw_only=True)
class LargeSwing:
    """The law, for an amplitude at time 0."""

    slower: float = 0.0  # k
    sooner: float = 0.0  # g, above -1
    exponent: float = 2.0  # n
    damping: float = 0.0  # d, of the oscillation that is seen most [1/s]

    def late(self, t: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
        """l [s] at times t [s]."""
        rate = max(self.exponent * self.damping, 1e-6)
        passed = -np.expm1(-rate * t)
        if abs(self.sooner) < 1e-6:
            return passed / rate
        return np.log1p(np.maximum(self.sooner * passed, EARLIEST)) / (self.sooner * rate)

    def functions(
        self, f: Float[np.ndarray, " k"], d: Float[np.ndarray, " k"], t: Float[np.ndarray, " t"]
    ) -> Float[np.ndarray, "2 k t"]:
        """Cosine and sine of oscillations whose small swings have frequencies f [Hz] and dampings d [1/s]."""
        late = self.late(t)
        phase = 2 * np.pi * f[:, None] * (t - self.slower * late)
        return np.exp(-d[:, None] * (t + self.sooner * late)) * np.stack([np.cos(phase), np.sin(phase)])

    def of_amplitude(self, ratio: float) -> "LargeSwing":
        """That of a swing whose amplitude at time 0 is `ratio` times as large."""
        share = ratio**self.exponent
        return replace(self, slower=self.slower * share, sooner=self.sooner * share)


SMALL = LargeSwing()
