"""What a person says of one part: points and a box in one photograph, or a box in space."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from physics3d.checks import Corners, LeftTopRightBottom, Share, Text, Whole, at_least_one, require_fields

Point = tuple[Share, Share]


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """Where one part is, in one view or in space. Image coordinates: fractions of width and height, from upper left."""

    part: Text = "body"  # several prompts may describe one part
    view: Text | Whole = 0  # name of the photograph, or index in the capture
    positive: tuple[Point, ...] = ()  # points on the part
    negative: tuple[Point, ...] = ()  # points beside it
    box: Annotated[tuple[Share, Share, Share, Share], LeftTopRightBottom()] | None = None
    lower: tuple[float, float, float] | None = None  # corners of a box in space [m] that holds the part
    upper: tuple[float, float, float] | None = None

    RULES = (Corners("lower", "upper"), at_least_one("positive", "box", "lower"))

    @property
    def in_image(self) -> bool:
        return self.box is not None or len(self.positive) > 0

    def check(self) -> None:
        """Raise ValueError naming the entry that cannot be right."""
        require_fields(self, f"prompt for {self.part!r} in view {self.view!r}")

    def within(self, point: Float[Tensor, "n 3"], margin: float = 0.0) -> Bool[Tensor, " n"]:
        """Which points lie in the box in space, shrunk by the share `margin` on each side; all if there is none."""
        if self.lower is None:
            return torch.ones(len(point), dtype=torch.bool)
        lower, upper = torch.tensor(self.lower).to(point), torch.tensor(self.upper).to(point)
        inset = margin * (upper - lower)
        return ((point >= lower + inset) & (point <= upper - inset)).all(1)


def within_any(boxes: tuple[Prompt, ...], point: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Which points lie in at least one of the boxes in space; all if there is no box."""
    if not boxes:
        return torch.ones(len(point), dtype=torch.bool)
    return torch.stack([p.within(point) for p in boxes]).any(0)
