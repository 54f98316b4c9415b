"""What the page shows of a finished run."""

from dataclasses import dataclass

import torch

from physics3d.filling.body import Body
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.materials.base import Values
from physics3d.scenes.base import Capture, Take
from physics3d.trajectory import Trajectory
from physics3d.world import World


@dataclass(frozen=True, kw_only=True)
class Run:
    name: str  # of the scene, for a person
    world: World
    capture: Capture
    gaussians: Gaussians
    body: Body
    parameters: Values  # as learned, or as configured
    trajectory: Trajectory

    @property
    def values(self) -> Values:
        """The parameters with what a mixture has to know of the body."""
        return self.world.material.per_part(self.parameters, self.body.part, self.body.parts)

    @property
    def take(self) -> Take | None:
        """The recorded motion that the run is compared with, as the video is."""
        return self.capture.take("evaluate") or self.capture.take("learn")

    @property
    def camera(self) -> Camera | None:
        """That filmed it, or that of the first photograph; None: a trained model has none."""
        if self.take is not None:
            return self.take.cameras[(self.take.held_out_cameras or (0,))[0]]
        return self.capture.cameras[0] if self.capture.cameras else None

    @property
    def clip(self) -> torch.Tensor | None:
        """The recorded frames [t, h, w, 3] seen by that camera."""
        take = self.take
        return None if take is None else take.videos[(take.held_out_cameras or (0,))[0]]
