"""A camera that goes once around the body while it moves, for a talk.

The camera stays at one height and looks at the middle of what moves; its distance is such that all of the motion stays
in the picture from everywhere, with some margin. It goes counterclockwise seen from above and ends a step before it
began, so that the film can be played in a circle; the motion is played at its own speed, from the start again when it
ends.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.embedding import Embedding
from physics3d.gaussians.interior import Interior
from physics3d.gaussians.model import Gaussians
from physics3d.pictures import to_uint8
from physics3d.trajectory import Trajectory

FIELD = math.radians(30.0)  # angle that the smaller side of the picture covers: an 80 mm lens on 35 mm film
MARGIN = 1.15


@dataclass(frozen=True, kw_only=True)
class Turntable:
    """Raises ValueError if the film has no frame, or the camera would stand in the body's axis."""

    width: int  # of the film [px]
    height: int  # [px]
    frames: int
    elevation: float = math.radians(15.0)  # of the camera above the horizon, seen from the body
    start: float = 0.0  # azimuth at the first frame, from x to y

    def __post_init__(self) -> None:
        if self.frames < 1 or self.width < 2 or self.height < 2:
            raise ValueError(
                f"{self.frames} frames of {self.width} x {self.height} px make no film; take at least 1 frame, 2 x 2 px"
            )
        if not abs(self.elevation) < math.radians(85):
            raise ValueError(f"elevation is {math.degrees(self.elevation):g} degrees; take one between -85 and 85")

    def cameras(self, points: Float[Tensor, "m 3"]) -> list[Camera]:
        """One per frame, so that all of `points` [m] are in the picture."""
        lower, upper = points.double().amin(0), points.double().amax(0)
        centre = (lower + upper) / 2
        radius = float((points.double() - centre).norm(dim=1).max())
        focal = min(self.width, self.height) / 2 / math.tan(FIELD / 2)
        distance = MARGIN * radius / math.sin(FIELD / 2)
        made = []
        for i in range(self.frames):
            azimuth = self.start + 2 * math.pi * i / self.frames
            level = math.cos(self.elevation)
            away = (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(self.elevation))
            made.append(
                Camera(
                    width=self.width,
                    height=self.height,
                    fx=focal,
                    fy=focal,
                    cx=self.width / 2,
                    cy=self.height / 2,
                    world_to_camera=look_at(centre + distance * torch.tensor(away, dtype=torch.float64), centre),
                )
            )
        return made

    def __call__(
        self,
        gaussians: Gaussians,
        embedding: Embedding,
        trajectory: Trajectory,
        *,
        interior: Interior | None,
        background: tuple[float, float, float],
    ) -> Iterator[UInt8[Tensor, "h w 3"]]:
        """Pictures of the film, on the device of the Gaussians."""
        device = gaussians.mean.device
        X = trajectory.rest_position.to(device)
        for i, camera in enumerate(self.cameras(trajectory.position.flatten(0, 1))):
            moment = i % len(trajectory.position)
            x, F = trajectory.position[moment].to(device), trajectory.deformation[moment].to(device)
            with torch.no_grad():
                drawn = render_deformed(
                    gaussians, embedding, X, x, F, camera,
                    background=torch.tensor(background, device=device), interior=interior,
                )  # fmt: skip
            yield to_uint8(drawn.color)
