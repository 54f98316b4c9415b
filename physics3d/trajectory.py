"""How a body moved, frame by frame: what every solver returns."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite


class NotMoved(ValueError):
    """With the numbers that were given, the material's above all, no solver moves the body to the end. Who tries many
    goes on with others."""


@dataclass(frozen=True, kw_only=True)
class Trajectory(AbstractArtifact):
    """Where the particles were, frame by frame; frame 0 is the initial state."""

    rest_position: Float[Tensor, "p 3"]  # [m]
    position: Float[Tensor, "t p 3"]  # [m]
    velocity: Float[Tensor, "t p 3"]  # [m/s]; no gradient goes through it
    deformation: Float[Tensor, "t p 3 3"]  # total F
    fps: float
    health: dict[str, list[float]]  # per frame, numbers for a person to look at
    substeps: int  # of the frame that had most
    substep_dt: float  # the shortest [s]

    def check(self) -> None:
        t, p = self.position.shape[:2]
        shapes = [tuple(value.shape) for value in (self.rest_position, self.position, self.velocity, self.deformation)]
        if shapes != [(p, 3), (t, p, 3), (t, p, 3), (t, p, 3, 3)]:
            raise ValueError(
                "trajectory: rest_position {}, position {}, velocity {} and deformation {} disagree; expected [p, 3], "
                "[t, p, 3], [t, p, 3], [t, p, 3, 3]".format(*shapes)
            )
        require_finite("trajectory.position", self.position)
        require_finite("trajectory.velocity", self.velocity)
        require_finite("trajectory.deformation", self.deformation)
