"""Segmentation against labels that are known: a small carnation and a ball on the wood, prompted as a person would."""

import numpy as np
import pytest
from labelled_twins import agreement, ball, carnation

from physics3d.log import Log
from stages.segment import Segment

# IoU per pixel and per Gaussian. Here, with 10 views of 240 px, one pixel of outline is 3 % of the plant; with more and
# larger views 0.97 and 0.95 are reached (docs/results/segmentation.md). Of the stem, whose leaves are two pixels wide,
# a few per cent less is asked.
CASES = {
    "carnation": {"stem": (0.91, 0.90), "blossom": (0.965, 0.97), "pot": (0.965, 0.97)},
    "ball": {"ball": (0.96, 0.96)},
}


@pytest.mark.parametrize("name", CASES)
def test_known_labels_are_found(name):
    asked, size = CASES[name], dict(views=10, width=240, log=Log(None))
    twin = ball(**size) if name == "ball" else carnation(tuple(asked), **size)
    gaussians, truth = twin.gaussians(10_000, seed=0)
    found = Segment(prompts=twin.prompts(2, clicks=3), views=10)(twin.capture, gaussians, log=Log(None))
    maps = np.stack([twin.true_map(twin.capture.cameras[i]) for i in found.mask_views])
    for k, part in enumerate(found.parts, 1):
        pixel = agreement(found.masks.numpy() == k, maps == k)
        gaussian = agreement(found.label == k, truth == k, gaussians.opacity.numpy())
        assert pixel > asked[part][0] and gaussian > asked[part][1], f"{part}: {pixel:.3f} and {gaussian:.3f}"
