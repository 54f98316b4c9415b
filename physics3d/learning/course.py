"""Where theta has been while it was learned, and how well it did there: a point for every trial and every step.

Losses of the search and the polish are over all views and frames, those of the descent over the ones drawn for a step,
but for its last point. "across" is where a polish ended in the valley that was left (`mirror.py`). The last point of
all is what was learned.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from physics3d.learning.fields import AbstractField, physical

WAYS = ("search", "descent", "polish", "across")


@dataclass(frozen=True, kw_only=True)
class Point:
    """One of them."""

    way: Literal["search", "descent", "polish", "across"]  # in which it was reached
    theta: Float[Tensor, " k"]
    loss: float


def history(field: AbstractField, course: Sequence[Point]) -> dict[str, list[float]]:
    """Physical values [SI] by name, `loss`, and `way`, the number of the way in WAYS; one number per point."""
    if not course:
        return {}
    values = [physical(field, point.theta) for point in course]
    told = {"loss": [point.loss for point in course], "way": [float(WAYS.index(point.way)) for point in course]}
    return told | {name: [value[name] for value in values] for name in values[0]}
