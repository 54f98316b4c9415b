"""Small helpers for masks and points in an image. Points are (u, v) [px], pixel centres at integer + 0.5."""

import numpy as np
from jaxtyping import Bool, Float


def centres(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "m 2"]:
    """Points of the masked pixels."""
    return np.argwhere(mask)[:, ::-1] + 0.5


def bounds(
    uv: Float[np.ndarray, "m 2"], margin: float, shape: tuple[int, ...], share: float = 0.98
) -> Float[np.ndarray, " 4"]:
    """Left, top, right, bottom around that share of the points [px], widened by `margin` times the longer side."""
    lower, upper = np.quantile(uv, (0.5 - share / 2, 0.5 + share / 2), axis=0)
    margin = margin * (upper - lower).max() + 2
    return np.clip(np.concatenate([lower - margin, upper + margin]), 0, np.tile(shape[1::-1], 2))


def eroded(mask: Bool[np.ndarray, "h w"], reach: float) -> Bool[np.ndarray, "h w"]:
    """Away from the outline, where depths mix; a thin object that would vanish keeps all its pixels."""
    core = depth_in(mask) > reach
    return core if core.sum() > 0.2 * mask.sum() else mask


def depth_in(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance to the nearest pixel beside the mask [px], 0 outside; the image's edge is no outline."""
    from scipy import ndimage

    return ndimage.distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]


def size_of(mask: Bool[np.ndarray, "h w"]) -> float:
    """Geometric mean of width and height of the pixels' bounding box [px]; of an object with thin limbs, its reach."""
    rows, columns = (np.flatnonzero(mask.any(k)) for k in (1, 0))
    return float(np.sqrt((1 + np.ptp(rows)) * (1 + np.ptp(columns)))) if len(rows) else 0.0


def thinned(points, most: int):
    """At most that many, evenly taken in order."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).round().astype(int)]


def share_of(part: Bool[np.ndarray, "h w"], whole: Bool[np.ndarray, "h w"]) -> float:
    """Share of the part that lies on the whole; 1 for nothing."""
    return float((part & whole).sum() / part.sum()) if part.any() else 1.0


def intersection_over_union(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union; 1 for two empty masks."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0
