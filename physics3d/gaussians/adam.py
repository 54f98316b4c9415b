"""One step of Adam on every field of a model of Gaussians, whose count changes while it is fitted."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from physics3d.checks import Factor, NotNegative, require_fields
from physics3d.gaussians.model import FIELDS, Gaussians

Moments = dict[str, tuple[Tensor, Tensor]]  # per field of Gaussians; they follow splits and removals


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Step sizes of Adam at the start; they fall to `final` of it, exponentially."""

    mean: NotNegative = 1e-3  # times the extent of the scene
    log_scale: NotNegative = 8e-2
    quaternion: NotNegative = 2e-2
    opacity_logit: NotNegative = 5e-2
    sh: NotNegative = 1e-2  # degree 0; the higher ones learn 10 times slower
    exposure: NotNegative = 1e-2  # of a photograph, where exposures are learned
    final: Factor = 0.05

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "rates")


def stepped(model: Gaussians, moments: Moments, rates: Rates, extent: float, step: int, fall: float) -> Gaussians:
    """One step of Adam (0.9, 0.999) on every field; `moments` are kept beside the fields so that they follow splits."""
    new = {}
    with torch.no_grad():
        for name in FIELDS:
            value = getattr(model, name)
            m, v = moments.setdefault(name, (torch.zeros_like(value), torch.zeros_like(value)))
            m.lerp_(value.grad, 0.1)
            v.lerp_(value.grad.square(), 0.001)
            size = fall * getattr(rates, name) * math.sqrt(1 - 0.999 ** (step + 1)) / (1 - 0.9 ** (step + 1))
            change = m / (v.sqrt() + 1e-15) * size
            if name == "mean":
                change *= extent
            if name == "sh":
                change[:, 1:] *= 0.1
            new[name] = value - change
    return replace(model, **new)
