"""Filling with everything switched off that a test does not ask for."""

import torch

from physics3d.filling.fill import fill
from physics3d.filling.solids import Poisson
from physics3d.log import Log

SPACING = 0.006  # [m]
WITH = {
    "spacing": SPACING,
    "opacity": 0.1,
    "solid": Poisson(),
    "interior": True,
    "sheet_thickness": None,
    "isolated": "keep",
    "drop_pieces_below": 0.0,
    "attach": False,
    "cameras": (),
    "log": Log(None),
}


def filled(gaussians, **options):
    label = options.pop("label", torch.ones(len(gaussians), dtype=torch.int32))
    return fill(gaussians, label, **{**WITH, **options})
