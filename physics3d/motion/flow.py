"""Dense flow from one frame of a clip to all others (DIS, Kroeger et al. 2016).

    u(t, x) [px]    what is seen at pixel x of the reference frame r is seen at x + u(t, x) in frame t,   u(r, x) = 0

The frames are followed outwards from r in both directions, each starting from the flow of its neighbour, so that
displacements of many pixels are found. Where the thing covers what was seen in r, the flow is a guess: `trust` says so,

    w(t, x) = 1/(1 + (e/5)^2)^2,    e = |I_t(x + u) - I_r(x)| after a low-pass of 1.5 px, in grey levels of 0..255
"""

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

BLUR = 1.5  # [px]
LEVELS = 5.0  # grey levels of difference at which a quarter of the trust is left


def flow(video: UInt8[Tensor, "t h w 3"], *, reference: int = 0) -> Float[np.ndarray, "t h w 2"]:
    """Displacement of what is seen at each pixel of frame `reference`, from there to frame t [px]."""
    import cv2

    grey = greys(video)
    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    fields = np.zeros((*grey.shape, 2), np.float32)
    for side in (range(reference + 1, len(grey)), range(reference - 1, -1, -1)):
        last = None
        for t in side:
            if np.array_equal(grey[t], grey[reference]):  # a picture that stands still costs nothing
                last = np.zeros_like(fields[t])
            else:
                last = method.calc(grey[reference], grey[t], None if last is None else last.copy())
            fields[t] = last
    return fields


def size(u: Float[np.ndarray, "*n h w 2"]) -> Float[np.ndarray, "*n h w"]:
    """|u| [px]."""
    return np.sqrt(u[..., 0] ** 2 + u[..., 1] ** 2)  # several times faster than a norm along the last axis


def trust(
    video: UInt8[Tensor, "t h w 3"], u: Float[np.ndarray, "t h w 2"], *, reference: int = 0
) -> Float[np.ndarray, "t h w"]:
    """w in 0..1: 1 where what the flow says is seen again looks the same."""
    import cv2

    grey = [cv2.GaussianBlur(g.astype(np.float32), (0, 0), BLUR) for g in greys(video)]
    y, x = np.mgrid[: u.shape[1], : u.shape[2]].astype(np.float32)
    weights = np.empty(u.shape[:3], np.float32)
    for t, frame in enumerate(grey):
        seen = cv2.remap(frame, x + u[t, ..., 0], y + u[t, ..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        weights[t] = 1 / (1 + ((seen - grey[reference]) / LEVELS) ** 2) ** 2
    return weights


def greys(video: UInt8[Tensor, "t h w 3"]) -> UInt8[np.ndarray, "t h w"]:
    """Luma of every frame."""
    import cv2

    return np.stack([cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY) for frame in video.numpy()])
