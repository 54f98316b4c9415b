"""GrabCut: needs no weights. What a person prompts is found by OpenCV's, what other views say by our `outline.py`.

Rother, Kolmogorov, Blake (2004), "GrabCut".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from physics3d.checks import Count
from physics3d.segmentation.maskers.base import AbstractMasker
from physics3d.segmentation.outline import outlined
from physics3d.segmentation.pixels import bounds, centres, thinned

UNLIKE = 15.0  # Lab units to the nearest sample: what is in the box and farther resembles nothing outside it


@dataclass(frozen=True, kw_only=True)
class GrabCut(AbstractMasker):
    """Colour models of object and surroundings, separated by a minimum cut: OpenCV's, or near a guess our `outline`."""

    iterations: Count = 5
    most_points: Count = 400

    def __call__(self, image, *, box, positive, negative):
        import cv2

        height, width = image.shape[:2]
        kinds = np.zeros((height, width), np.uint8)
        if box is None:
            # nothing but points: the object is what resembles their neighbourhood
            kinds[:] = cv2.GC_PR_BGD
            reach = max(2, round(0.03 * max(height, width)))
            near = slice(0, height), slice(0, width)
        else:
            left, top, right, bottom = np.round(np.clip(box, 0, [width, height, width, height])).astype(int)
            if right - left < 3 or bottom - top < 3:
                return np.zeros((height, width), bool)
            kinds[:] = cv2.GC_BGD
            kinds[top:bottom, left:right] = cv2.GC_PR_FGD
            reach = max(1, round(0.004 * max(height, width)))
            # the surroundings are what lies near the box: sharper colour models, and fewer pixels to cut
            du, dv = (right - left) // 2, (bottom - top) // 2
            near = slice(max(0, top - dv), bottom + dv), slice(max(0, left - du), right + du)
            if len(positive) and len(negative):
                inside = slice(top, bottom), slice(left, right)
                kinds[inside] = np.where(
                    like_the_clicks(image, inside, near, positive, negative), cv2.GC_PR_FGD, cv2.GC_PR_BGD
                )
        for points, value in ((positive, cv2.GC_FGD), (negative, cv2.GC_BGD)):
            for u, v in np.floor(points).astype(int).tolist():
                cv2.circle(kinds, (u, v), reach, value, -1)
        mask = cut(image, kinds, near, self.iterations)
        closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return without_holes(connected_to(closed.astype(bool), positive))

    def refine(self, image, share):
        """By `outline`, in the surroundings of the guess, and with small holes of the guess's own filled."""
        guess = share > 0.5
        if not guess.any():
            return guess
        left, top, right, bottom = bounds(centres(guess), 0.5, guess.shape, share=1.0).astype(int)
        near, mask = (slice(top, bottom), slice(left, right)), np.zeros_like(guess)
        mask[near] = outlined(image[near], share[near])
        return mask | (without_holes(mask) & guess)


def like_the_clicks(
    image: UInt8[np.ndarray, "h w 3"],
    inside: tuple[slice, slice],
    near: tuple[slice, slice],
    positive: Float[np.ndarray, "p 2"],
    negative: Float[np.ndarray, "q 2"],
) -> Bool[np.ndarray, "a b"]:
    """Pixels in the box that resemble a positive click more than a negative one or what surrounds the box.

    Distance is that to the nearest sample, in Lab colour and, weakly, in place: else what is clicked away but makes up
    much of the box would teach the colours of the object.
    """
    import cv2
    from scipy.spatial import cKDTree

    height, width = image.shape[:2]
    colour = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    rows, columns = np.indices((height, width))
    reach = 60.0 / max(inside[0].stop - inside[0].start, inside[1].stop - inside[1].start)  # Lab units per pixel
    feature = np.concatenate([colour, reach * columns[..., None], reach * rows[..., None]], -1)

    def under(points):
        marked = np.zeros((height, width), np.uint8)
        for u, v in np.floor(points).astype(int).tolist():
            cv2.circle(marked, (u, v), max(1, round(0.006 * max(height, width))), 1, -1)
        return marked > 0

    around = np.zeros((height, width), bool)
    around[near] = True
    around[inside] = False
    on, off = under(positive), under(negative)
    samples = feature[on], np.concatenate([feature[off], thinned(feature[around], 2000)])
    to_on, to_off = (cKDTree(s).query(feature[inside].reshape(-1, 5))[0] for s in samples)
    return ((to_on < to_off) | (to_off > UNLIKE)).reshape(feature[inside].shape[:2])


def cut(
    image: UInt8[np.ndarray, "h w 3"], kinds: UInt8[np.ndarray, "h w"], near: tuple[slice, slice], iterations: int
) -> Bool[np.ndarray, "h w"]:
    """The object by GrabCut in a part of the image; `kinds` are OpenCV's four classes of pixels."""
    import cv2

    guess = kinds[near].copy()
    is_object = lambda: np.isin(guess, (cv2.GC_FGD, cv2.GC_PR_FGD))
    # without any object or any surroundings there is no colour model to learn
    if is_object().any() and not is_object().all():
        cv2.setRNGSeed(0)
        models, pixels = (np.zeros((1, 65)), np.zeros((1, 65))), np.ascontiguousarray(image[near][..., ::-1])
        cv2.grabCut(pixels, guess, None, *models, iterations, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    mask = np.zeros(kinds.shape, bool)
    mask[near] = is_object()
    return mask


def connected_to(mask: Bool[np.ndarray, "h w"], positive: Float[np.ndarray, "p 2"]) -> Bool[np.ndarray, "h w"]:
    """The connected parts of a mask on which a positive point lies, and those a tenth as large as the largest."""
    from scipy import ndimage

    parts, count = ndimage.label(mask)
    if count == 0:
        return mask
    size = np.bincount(parts.reshape(-1))
    size[0] = 0
    keep = size >= 0.1 * size.max()
    if len(positive):
        u, v = np.floor(positive).astype(int).T
        touched = parts[np.clip(v, 0, mask.shape[0] - 1), np.clip(u, 0, mask.shape[1] - 1)]
        if touched.any():
            keep = np.bincount(touched, minlength=count + 1) > 0
    keep[0] = False
    return keep[parts]


def without_holes(mask: Bool[np.ndarray, "h w"], share: float = 0.02) -> Bool[np.ndarray, "h w"]:
    """The mask with its small holes filled, up to that share of its area each: eyes, buttons, highlights."""
    from scipy import ndimage

    holes, count = ndimage.label(~mask)
    if count == 0:
        return mask
    small = np.bincount(holes.reshape(-1)) <= share * mask.sum()
    edge = np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]])
    small[edge], small[0] = False, False
    return mask | small[holes]
