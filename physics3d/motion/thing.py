"""The thing that moves, cut out of one frame of its clip.

Motion says roughly where it is, colour says where it ends. Of each pixel of the frame, over the clip,

    size      displacement, the root mean square over the frames weighted by how far the flow can be trusted [px]
    change    largest difference of colour from the frame, after a low-pass of 0.8 px [grey levels]

What has hardly any size stays background; what has size and has changed is probably the thing; between these GrabCut
(Rother et al. 2004) decides by colour. Flow runs beyond outlines by the width of its patches, change does not. Of the
pieces that are found, the one that holds most of what moves is the thing.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from physics3d.motion.flow import flow, trust
from physics3d.motion.usable import inside

STILL, MOVES = 0.02, 0.05  # of the largest size
LOW_PASS, CHANGED = 0.8, 8.0  # [px], grey levels
ROUNDS = 8  # of GrabCut
LEAST = 64  # pixels that make a thing

Box = tuple[float, float, float, float]


def standing(frames: UInt8[Tensor, "t h w 3"], picture: UInt8[Tensor, "h w 3"]) -> Bool[Tensor, "h w"]:
    """Pixels whose colour, after a low-pass, is in no frame another than in the picture."""
    import cv2

    soft = lambda frame: cv2.GaussianBlur(frame.numpy().astype(np.float32), (0, 0), LOW_PASS)
    there = soft(picture)
    change = np.maximum.reduce([np.abs(soft(frame) - there).max(-1) for frame in frames])
    return torch.from_numpy(change < max(3 * float(np.median(change)), CHANGED))


def moving_thing(
    frames: UInt8[Tensor, "t h w 3"], *, at: int, box: Box | None = None
) -> tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """(the thing's pixels in frame `at`, the size of the motion as a share of the largest).

    `box`: left, top, right, bottom of the thing as fractions; None: it may be anywhere. Raises ValueError where nothing
    is found.
    """
    import cv2
    from scipy import ndimage

    u = flow(frames, reference=at)
    weight = trust(frames, u, reference=at)
    size = np.sqrt((weight * (u**2).sum(-1)).sum(0) / weight.sum(0))
    allowed = np.ones(size.shape, bool) if box is None else inside(box, *size.shape)
    size = size / max(float(np.percentile(size, 99.5)), 1e-6)
    soft = lambda frame: cv2.GaussianBlur(frame.astype(np.float32), (0, 0), LOW_PASS)
    there, change = soft(frames[at].numpy()), np.zeros(size.shape, np.float32)
    for frame in frames.numpy():  # one at a time: all of them are gigabytes
        change = np.maximum(change, np.sqrt(((soft(frame) - there) ** 2).mean(-1)))
    changed = cv2.dilate((change > max(3 * float(np.median(change)), CHANGED)).astype(np.uint8), np.ones((3, 3))) > 0
    label = np.full(size.shape, cv2.GC_BGD, np.uint8)
    label[allowed & (size > STILL)] = cv2.GC_PR_BGD
    likely = allowed & (size > MOVES) & changed
    label[likely] = cv2.GC_PR_FGD
    if likely.sum() < LEAST or (label == cv2.GC_BGD).sum() < LEAST:
        raise ValueError(
            f"only {int(likely.sum())} pixels move and change{'' if box is None else f' within the box {list(box)}'}: "
            "no thing can be cut out; draw the box around what moves, with room at its sides"
        )
    cv2.setRNGSeed(0)
    picture = np.ascontiguousarray(frames[at].numpy()[..., ::-1])
    cv2.grabCut(picture, label, None, np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    mask = (label & 1).astype(bool)
    pieces, _ = ndimage.label(mask, np.ones((3, 3)))
    moved = np.bincount(pieces.ravel(), weights=(size > 0.3).ravel().astype(float))
    moved[0] = 0
    thing = pieces == int(moved.argmax())
    if moved.max() < LEAST:
        raise ValueError("what moves cannot be told from what is behind it by its colour; draw a smaller box around it")
    return thing, size
