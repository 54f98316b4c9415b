"""Pictures for the person who checks a segmentation."""

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
