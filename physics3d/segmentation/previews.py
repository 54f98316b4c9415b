"""Pictures for the person who checks a segmentation."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, UInt8

COLOURS = np.array([(230, 60, 40), (40, 120, 230), (50, 170, 60), (220, 160, 20), (150, 60, 200)], np.uint8)


def tinted(image: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The photograph with every label's pixels in its colour and the rest faded."""
    out = (0.45 * image + 0.55 * 255).astype(np.uint8)
    for k in range(1, int(labels.max()) + 1):
        chosen = labels == k
        out[chosen] = (0.65 * image[chosen] + 0.35 * COLOURS[(k - 1) % len(COLOURS)]).astype(np.uint8)
    return out


def contact_sheet(images: Sequence[UInt8[np.ndarray, "h w 3"]], columns: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures in rows, each in the corner of a white cell as large as the largest."""
    height, width = (max(i.shape[k] for i in images) + 4 for k in (0, 1))
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for k, image in enumerate(images):
        v, u = k // columns * height, k % columns * width
        sheet[v : v + image.shape[0], u : u + image.shape[1]] = image
    return sheet
