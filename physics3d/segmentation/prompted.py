"""A prompt -> the mask of a part in one view: of what is pointed at there, or of what lies in a box in space."""

import numpy as np
from jaxtyping import Bool

from physics3d.segmentation.maskers.base import AbstractMasker
from physics3d.segmentation.pixels import centres, thinned
from physics3d.segmentation.prompts import Prompt
from physics3d.segmentation.views import View


def prompted_mask(prompts: tuple[Prompt, ...], others: tuple[Prompt, ...], view: View, masker: AbstractMasker):
    """Mask [h, w] of one part from its prompts in this view; what is positive for other parts is negative here.

    Raises ValueError naming view and prompts if nothing is found.
    """
    size = np.array([view.camera.width, view.camera.height], float)
    pixels = lambda points: np.array(points, float).reshape(-1, 2) * size
    mask = np.zeros(view.image.shape[:2], bool)
    boxes = [np.array(p.box, float) * np.tile(size, 2) for p in prompts if p.box is not None]
    positive = np.concatenate([pixels(p.positive) for p in prompts])
    negative = np.concatenate([*(pixels(p.negative) for p in prompts), *(pixels(p.positive) for p in others)])
    for box in boxes or [None]:
        mask |= masker(view.image, box=box, positive=positive, negative=negative)
    if not mask.any():
        said = "; ".join(
            f"box {tuple(p.box)}" if p.box is not None else f"points {[tuple(x) for x in p.positive]}" for p in prompts
        )
        raise ValueError(
            f"the mask of {prompts[0].part!r} in view {view.name} is empty for {said}; "
            "move the prompt onto the object, or add positive points"
        )
    return mask


def mask_of_boxes(prompts: tuple[Prompt, ...], view: View, masker: AbstractMasker) -> Bool[np.ndarray, "h w"] | None:
    """Mask of what is in any of the boxes in space: pixels inside of one are positive, those outside of all negative,
    the masker decides between. None where the view shows next to nothing of them."""
    everything = np.ones(view.image.shape[:2], bool)
    opaque = (view.rendered.alpha > 0.5).numpy()
    point = view.points(everything)
    in_box, core = np.zeros_like(opaque), np.zeros_like(opaque)
    in_box[opaque] = np.any([prompt.within(point).numpy() for prompt in prompts], 0)
    core[opaque] = np.any([prompt.within(point, margin=0.1).numpy() for prompt in prompts], 0)
    if core.sum() < 10:
        return None
    v, u = np.nonzero(in_box)
    return masker(
        view.image,
        box=np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float),
        positive=thinned(centres(core), masker.most_points),
        negative=thinned(centres(opaque & ~in_box), masker.most_points),
    )
