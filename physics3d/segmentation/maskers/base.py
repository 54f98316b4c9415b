"""One photograph and a prompt -> the pixels of the object: what a masker answers; one per file of this folder.

A masker answers two questions: what a person points at (the call), and what the object is, given what other views
say of every pixel (`refine`). One that also follows a mask through a video has `follow`. Pixel coordinates are (u, v),
from the upper left corner of the image, pixel centres at integer + 0.5.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8


class AbstractMasker:
    """A frozen dataclass; the call returns the mask, which may be empty (the caller knows which view and prompt)."""

    most_points: int  # of each sign that help; more are thinned by the caller

    def __call__(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        *,
        box: Float[np.ndarray, " 4"] | None,  # left, top, right, bottom [px]
        positive: Float[np.ndarray, "p 2"],  # points on the object [px]
        negative: Float[np.ndarray, "q 2"],  # points beside it [px]
    ) -> Bool[np.ndarray, "h w"]:
        raise NotImplementedError

    def refine(self, image: UInt8[np.ndarray, "h w 3"], share: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """The mask, where `share` (0..1) of each pixel is the object's by a guess that is right but not sharp."""
        raise NotImplementedError


class AbstractVideoMasker(AbstractMasker):
    """A masker that can also carry a mask from one picture of a sequence to all others."""

    def follow(
        self, images: Sequence[UInt8[np.ndarray, "h w 3"]], start: int, mask: Bool[np.ndarray, "h w"]
    ) -> list[Bool[np.ndarray, "h w"]]:
        """Masks of pictures that follow each other along a path, from that of picture `start`."""
        raise NotImplementedError
