"""How a body moved, frame by frame: what every solver returns."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite


@dataclass(frozen=True, kw_only=True)
class Trajectory(AbstractArtifact):
    """Where the particles were, frame by frame; frame 0 is the initial state."""

    rest_position: Float[Tensor, "p 3"]  # [m]
    position: Float[Tensor, "t p 3"]  # [m]
    deformation: Float[Tensor, "t p 3 3"]  # total F
    fps: float
    health: dict[str, list[float]]  # per frame, numbers for a person to look at
    substeps: int  # of the frame that had most
    substep_dt: float  # the shortest [s]

    def check(self) -> None:
        t, p = self.position.shape[:2]
        if self.rest_position.shape != (p, 3) or self.deformation.shape != (t, p, 3, 3):
            raise ValueError(
                f"trajectory: rest_position {tuple(self.rest_position.shape)}, position {tuple(self.position.shape)} "
                f"and deformation {tuple(self.deformation.shape)} disagree; expected [p, 3], [t, p, 3], [t, p, 3, 3]"
            )
        require_finite("trajectory.position", self.position)
        require_finite("trajectory.deformation", self.deformation)
