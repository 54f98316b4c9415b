"""Particles + recorded motion -> a motion without physics: the peer of the simulator, for `make compare`
(`physics3d/learning/deformation_field.py`)."""

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Gt, Le

from physics3d.checks import Device, Seed, require_fields
from physics3d.filling.body import Body
from physics3d.gaussians.model import Gaussians
from physics3d.learning.chain import filmed
from physics3d.learning.deformation_field import fit_field
from physics3d.log import Log
from physics3d.priors.base import AbstractPrior
from physics3d.scenes.base import Capture
from physics3d.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Deform:
    """Fits a deformation field to all frames of the take with the role "learn"."""

    prior: AbstractPrior  # in whose code pictures are compared
    image_scale: Annotated[float, Gt(0), Le(16)] = 0.5  # pixels rendered per pixel of the take, along each side
    device: Device = "cpu"
    seed: Seed = 0

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "deform")

    def __call__(self, capture: Capture, gaussians: Gaussians, body: Body, *, log: Log) -> Trajectory:
        """Raises ValueError if there is no take to learn from, or all its cameras are held out."""
        self.check()
        take = capture.take("learn")
        if take is None:
            raise ValueError(
                f"capture {capture.name} has no take with role learn; a deformation field knows nothing but a recording"
            )
        indices = torch.arange(len(take.videos[0]))
        clips, draw = filmed(capture, gaussians, body, take, indices, image_scale=self.image_scale, device=self.device)
        log.info(f"a deformation field for {len(indices)} frames of take {take.name}, {len(clips)} camera(s)")
        return fit_field(clips, draw, body, prior=self.prior, fps=take.fps, seed=self.seed, log=log)
