"""Release: the first frame from which a motion is a free decay. What a hand does before is no decay and is not fitted.

Of all first frames r, the one with the shortest description of the whole clip (Rissanen 1978): frames after r are told
by the decay and its residual of size e(r), frames before it by themselves, out of a range as wide as the motion, S:

    L(r) = (n - r) k ln e(r) + r k ln S + 1/2 (number of parameters) ln(n k)

At least half of the clip is left, and one and a half periods of the slowest oscillation. Eleven r are tried, then those
next to the best with its frequencies and dampings.
"""

import math

import numpy as np
from jaxtyping import Float

from physics3d.motion.decay import FLOOR, Decay, fit_decay, with_start

TRIED = 11


def free_decay(signal: Float[np.ndarray, "n k"], fps: float, *, most: int = 5) -> tuple[Decay, int]:
    """(the decay, the frame of the release). Raises ValueError for fewer than 8 frames."""
    n = len(signal)
    latest = max(0, min(n // 2, n - 8))
    coarse = np.unique(np.linspace(0, latest, TRIED).round().astype(int))
    fits = [fit_decay(signal, fps, first=int(r), most=most) for r in coarse]
    lengths = [_length(fit, signal, int(r), fps) for fit, r in zip(fits, coarse)]
    best, step = int(np.argmin(lengths)), int(np.diff(coarse).max(initial=1))
    release = int(coarse[best])
    near = range(max(0, release - step + 1), min(latest, release + step - 1) + 1)
    release = min(near, key=lambda r: _length(with_start(fits[best], signal, fps, first=r), signal, r, fps))
    return (fits[best] if release == coarse[best] else fit_decay(signal, fps, first=release, most=most)), release


def _length(decay: Decay, signal: np.ndarray, first: int, fps: float) -> float:
    """L; infinite where less than one and a half periods are left."""
    (n, k), swings = signal.shape, decay.frequency > 0
    if first and swings.any() and decay.frequency[swings].min() * (n - first) / fps < 1.5:
        return math.inf
    size = max(float(np.sqrt(((signal - signal.mean(0)) ** 2).mean())), FLOOR)
    count = (1 + len(swings) + swings.sum()) * k + len(swings) + swings.sum()
    told = (n - first) * k * math.log(max(decay.residual, FLOOR)) + first * k * math.log(size)
    return told + 0.5 * count * math.log(n * k)
