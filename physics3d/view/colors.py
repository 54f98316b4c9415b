"""Numbers and names as colours: a perceptually even map for what is measured, distinct colours for parts.

    colour = viridis((value - low)/(high - low)),    values beyond the ends take the colour of the end

matplotlib's viridis is read off once, at 256 levels; parts take the ten colours of Tableau in turn.
"""

import functools

import numpy as np
from jaxtyping import Float, Int, UInt8

LEVELS = 256
PALE = 0.35  # what remains of the contrast of things that have no value, before white


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    import matplotlib

    return (
        np.asarray(matplotlib.colormaps["viridis"](np.arange(LEVELS), bytes=True))[:, :3],
        np.asarray(matplotlib.colormaps["tab10"](np.arange(10), bytes=True))[:, :3],
    )


def of_values(value: Float[np.ndarray, " n"], low: float, high: float) -> UInt8[np.ndarray, "n 3"]:
    """Colours of `value` between the ends, which have its unit. Equal ends: the middle of the map. Raises ValueError
    if a value or an end is not finite, or the ends are in the wrong order."""
    if not (np.isfinite([low, high]).all() and low <= high):
        raise ValueError(f"the ends of the colours are {low:g} and {high:g}; take two finite numbers in this order")
    if not np.isfinite(value).all():
        raise ValueError(f"{int((~np.isfinite(value)).sum())} of {len(value)} values to be coloured are not finite")
    table, _ = _tables()
    if high == low:
        return np.broadcast_to(table[LEVELS // 2], (len(value), 3))
    share = np.clip((value - low) / (high - low), 0, 1)
    return table[np.minimum(share * LEVELS, LEVELS - 1).astype(np.int64)]


def of_parts(part: Int[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """A colour for each number of a part, from 0 on; those of more than ten parts repeat."""
    _, table = _tables()
    return table[part % len(table)]


def pale(color: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Grey and light, of colours in 0..1: for what stands still while what moves is coloured by a value."""
    grey = 1 - PALE * (1 - np.clip(color, 0, 1) @ np.array([0.299, 0.587, 0.114]))
    return np.repeat((255 * grey + 0.5).astype(np.uint8)[:, None], 3, 1)
