"""What a person says of one part: points and a box in one photograph, or a box in space."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """Where one part is, in one view or in space. Image coordinates: fractions of width and height, from upper left."""

    part: str = "body"  # several prompts may describe one part
    view: str | int = 0  # name of the photograph, or index in the capture
    positive: tuple[tuple[float, float], ...] = ()  # points on the part
    negative: tuple[tuple[float, float], ...] = ()  # points beside it
    box: tuple[float, float, float, float] | None = None  # left, top, right, bottom
    lower: tuple[float, float, float] | None = None  # corners of a box in space [m] that holds the part
    upper: tuple[float, float, float] | None = None

    @property
    def in_image(self) -> bool:
        return self.box is not None or len(self.positive) > 0

    def check(self) -> None:
        """Raise ValueError naming the entry that cannot be right."""
        name = f"prompt for {self.part!r} in view {self.view!r}"
        if (self.lower is None) != (self.upper is None):
            raise ValueError(f"{name}: give both lower and upper corner of the box in space, or neither")
        if self.lower is not None and not all(a < b for a, b in zip(self.lower, self.upper)):  # type: ignore[arg-type]
            raise ValueError(f"{name}: lower {tuple(self.lower)} must be below upper {tuple(self.upper)} in every axis")  # type: ignore[arg-type]
        if not self.in_image and self.lower is None:
            raise ValueError(f"{name}: give positive points, a box, or lower and upper corners in space")
        for what, points in (("positive", self.positive), ("negative", self.negative)):
            for point in points:
                if len(point) != 2 or not all(0 <= x <= 1 for x in point):
                    raise ValueError(
                        f"{name}: {what} point {tuple(point)} is outside the image; "
                        "give fractions of width and height between 0 and 1"
                    )
        if self.box is not None:
            box = tuple(self.box)
            if len(box) != 4 or not (0 <= box[0] < box[2] <= 1 and 0 <= box[1] < box[3] <= 1):
                raise ValueError(
                    f"{name}: box {box} must be left < right and top < bottom, as fractions of width and height in 0..1"
                )

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
