"""Masks of one photograph carried to the others through the Gaussians, and refined in each by what all of them say.

The mask of the prompted photograph labels the Gaussians that it shows (see `lift`); those that it hides or barely
shows may be the object's where there is room. Drawn from the next camera this says of every pixel which share is the
object's, and the masker finds the outline near there. Views are taken in the order of their angle to the prompted one,
and each adds what it shows, so that the far side is reached step by step. What is farther behind the prompted view's
surface than the object is wide is never part of it: prompt a view that shows it large.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float

from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.segmentation.belief import expected, shares
from physics3d.segmentation.claims import contested, numbered
from physics3d.segmentation.lift import contributions
from physics3d.segmentation.maskers.base import AbstractMasker, AbstractVideoMasker
from physics3d.segmentation.pixels import eroded, intersection_over_union, share_of, size_of
from physics3d.segmentation.rooms import Room, clearly_outside
from physics3d.segmentation.views import View

UNSEEN = 0.7  # belief that what may be a part is one, before a view shows it: likelier than not, for colours to decide
LEAST_SHOWN = 20  # pixels; a part that shows less in a view is not looked for there


def carry_masks(
    gaussians: Gaussians,
    first: View,
    prompted: dict[str, Bool[np.ndarray, "h w"]],
    rooms: dict[str, Room],
    views: list[View],
    masker: AbstractMasker,
    *,
    log: Log,
) -> dict[int, dict[str, Bool[np.ndarray, "h w"]]]:
    """Masks by view index and part, of the parts prompted in one view together, so that they compete for pixels.

    A view in which the masker finds something else than what was carried to it is left out.
    """
    path = along_path(first, views)
    followed: dict[str, list[np.ndarray]] = {}
    if isinstance(masker, AbstractVideoMasker):
        start = next(k for k, v in enumerate(path) if v.index == first.index)
        followed = {part: masker.follow([v.image for v in path], start, mask) for part, mask in prompted.items()}
    mean = gaussians.mean.cpu()
    allowed = torch.stack([rooms[part].holds(mean) for part in prompted])
    masks = {first.index: {part: mask & ~rooms[part].excludes(first) for part, mask in prompted.items()}}
    seen_in = lambda view: contributions(
        gaussians, [view.camera], [torch.from_numpy(numbered(list(masks[view.index].values())))], 1 + len(prompted)
    )
    weights = seen_in(first)
    centre = torch.stack([room.centre for room in rooms.values()]).mean(0)
    towards = lambda view: torch.nn.functional.normalize(view.camera.centre.to(centre) - centre, dim=0)
    order = sorted((v for v in views if v.index != first.index), key=lambda v: -float(towards(v) @ towards(first)))
    for view in log.progress(order, "carrying the prompt"):
        said, possible = expected(mean, weights, allowed)
        known = shares(gaussians, said, view.camera)
        drawn = known + UNSEEN * shares(gaussians, possible, view.camera)
        if all((share > 0.5).sum() < LEAST_SHOWN for share in known):
            log.info(f"{view.name} hardly shows {' and '.join(prompted)}, left out")
            continue
        found, recall, leak = {}, 1.0, 0.0
        for part, sure, share in zip(prompted, known, drawn):
            mask = np.zeros(share.shape, bool)
            if (share > 0.5).sum() >= LEAST_SHOWN:  # else it is behind another part
                mask = followed[part][path.index(view)] if followed else masker.refine(view.image, share)
                mask = mask & ~clearly_outside(rooms[part], view, share > 0.5)
                recall = min(recall, share_of(sure > 0.5, mask))
                leak = max(leak, share_of(mask, eroded(share < 0.05, 0.1 * size_of(share > 0.5))))
            found[part] = mask
        found = dict(zip(found, contested(list(found.values()), drawn)))
        if recall < 0.6 or leak > 0.3:
            log.info(
                f"{view.name}: a mask holds {100 * recall:.0f} % of what other views say is the object's, and "
                f"{100 * leak:.0f} % of it is far off, left out"
            )
            continue
        masks[view.index] = found
        weights += seen_in(view)
    return masks


def refined_masks(
    drawn: Float[np.ndarray, "k h w"], view: View, rooms: list[Room | None], masker: AbstractMasker
) -> list[Bool[np.ndarray, "h w"]]:
    """Masks of parts from their own labels: `drawn` are the shares of pixels that Gaussians with each label contribute.

    A mask that contradicts the labels is replaced by them.
    """
    found = []
    for share, room in zip(drawn, rooms):
        guess = share > 0.5
        mask = np.zeros_like(guess)
        if guess.sum() >= LEAST_SHOWN:
            mask = masker.refine(view.image, share)
            if room is not None:
                mask = mask & ~clearly_outside(room, view, guess)
            mask = mask if intersection_over_union(mask, guess) > 0.6 else guess
        found.append(mask)
    return contested(found, drawn)


def along_path(first: View, views: list[View]) -> list[View]:
    """All views as a video would show them: from the first in both directions, always on to the nearest camera."""
    path = [first]
    rest = [v for v in views if v.index != first.index]
    distance = lambda a, b: float((a.camera.centre - b.camera.centre).norm())
    while rest:
        ahead, behind = (min(rest, key=lambda v: distance(end, v)) for end in (path[-1], path[0]))
        if distance(path[-1], ahead) <= distance(path[0], behind):
            path.append(ahead)
            rest.remove(ahead)
        else:
            path.insert(0, behind)
            rest.remove(behind)
    return path
