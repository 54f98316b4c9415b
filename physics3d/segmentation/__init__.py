"""What may move: prompts in one photograph -> masks in many -> one label per Gaussian."""

from dataclasses import dataclass

from jaxtyping import Int, UInt8
from torch import Tensor

from physics3d.artifact import AbstractArtifact


@dataclass(frozen=True, kw_only=True)
class Segmentation(AbstractArtifact):
    """Which of n Gaussians may move, and which part of the thing each belongs to."""

    label: Int[Tensor, " n"]  # int32 per Gaussian: 0 is static, k moves and belongs to parts[k - 1]
    parts: tuple[str, ...]
    masks: UInt8[Tensor, "v h w"] | None  # labels of pixels; smaller views are padded with 0 at the right and below
    mask_views: tuple[int, ...]  # index of each mask's photograph in the capture

    def check(self) -> None:
        if self.label.ndim != 1 or len(self.label) == 0:
            raise ValueError(f"Segmentation.label has shape {tuple(self.label.shape)}, expected one label per Gaussian")
        if int(self.label.min()) < 0 or int(self.label.max()) > len(self.parts):
            raise ValueError(
                f"Segmentation.label lies in {int(self.label.min())}..{int(self.label.max())}, "
                f"expected 0..{len(self.parts)} for the parts {', '.join(self.parts)}"
            )
        if not bool((self.label > 0).any()):
            raise ValueError("Segmentation: no Gaussian may move; correct segment.prompts, see the previews of segment")
        if self.masks is not None and len(self.masks) != len(self.mask_views):
            raise ValueError(f"Segmentation: {len(self.masks)} masks for {len(self.mask_views)} mask_views")
