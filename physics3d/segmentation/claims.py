"""Pixels that several parts claim, and whose they are."""

import numpy as np
from jaxtyping import Bool, Float, Int

from physics3d.segmentation.maskers.base import AbstractMasker
from physics3d.segmentation.views import View


def told_apart(
    masks: dict[str, Bool[np.ndarray, "h w"]], view: View, masker: AbstractMasker
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Parts prompted in one view, again: what only one of them claims teaches the masker what the others are not."""
    claims = np.sum(list(masks.values()), axis=0)
    again = {}
    for part, mask in masks.items():
        share = np.where(mask, np.where(claims > 1, 0.5, 1.0), 0.0)
        # a part that lies wholly on another has nothing of its own to learn from
        own = (share == 1).sum() > 0.3 * mask.sum()
        again[part] = masker.refine(view.image, share) if own and (claims > 1).any() else mask
    return again


def contested(masks: list[Bool[np.ndarray, "h w"]], drawn: Float[np.ndarray, "k h w"]) -> list[Bool[np.ndarray, "h w"]]:
    """Where two parts meet both outlines are guesses: a pixel that both claim is of the one that shows most there."""
    claims = np.where(masks, drawn, -1.0)
    return [mask & (share >= claims.max(0) - 1e-6) for mask, share in zip(masks, drawn)]


def numbered(masks: list[Bool[np.ndarray, "h w"]]) -> Int[np.ndarray, "h w"]:
    """Map of labels 1, 2, ...; a pixel claimed twice belongs to the part named first."""
    labelled = np.zeros(masks[0].shape, np.int64)
    for k in range(len(masks), 0, -1):
        labelled[masks[k - 1]] = k
    return labelled
