"""Release: the first frame from which a motion is a free decay. What a hand does before is no decay and is not fitted.

Of all first frames r, the one with the shortest description of the whole clip (Rissanen 1978): frames after r are told
by the decay and its residual of size e(r), frames before it by themselves, out of a range as wide as the motion, S:

    L(r) = (n - r) k ln e(r) + r k ln S + 1/2 (number of parameters) ln(n k)

At least half of the clip is left, and one and a half periods of the slowest oscillation.
"""

import math

import numpy as np
from jaxtyping import Float

from physics3d.motion.decay import FLOOR, Decay, fit_decay


def free_decay(signal: Float[np.ndarray, "n k"], fps: float, *, most: int = 5) -> tuple[Decay, int]:
    """(the decay, the frame of the release). Raises ValueError for fewer than 8 frames."""
    n, k = signal.shape
    size = max(float(np.sqrt(((signal - signal.mean(0)) ** 2).mean())), FLOOR)
    best, release, shortest = None, 0, math.inf
    for first in sorted({round(i) for i in np.linspace(0, n / 2, 11)}):
        if n - first < 8 and best is not None:
            break
        decay = fit_decay(signal, fps, first=first, most=most)
        swings = decay.frequency > 0
        if first and swings.any() and decay.frequency[swings].min() * (n - first) / fps < 1.5:
            continue
        count = (1 + len(swings) + swings.sum()) * k + len(swings) + swings.sum()
        length = (n - first) * k * math.log(max(decay.residual, FLOOR)) + first * k * math.log(size)
        length += 0.5 * count * math.log(n * k)
        if length < shortest:
            best, release, shortest = decay, first, length
    assert best is not None
    return best, release
