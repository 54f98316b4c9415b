"""The body that the solver moves: particles with volume, and how the Gaussians ride on them."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.filling.doubt import Doubt
from physics3d.gaussians.embedding import Embedding
from physics3d.matter import Matter


@dataclass(frozen=True, kw_only=True)
class Body(AbstractArtifact):
    """p particles that fill the thing that moves, and the Gaussians that ride on them."""

    position: Float[Tensor, "p 3"]  # at rest [m]
    volume: Float[Tensor, " p"]  # [m^3]
    part: Int[Tensor, " p"]  # int32, 0-based index into the segmentation's parts
    interior: Bool[Tensor, " p"]  # put there by filling: farther than a spacing from every Gaussian
    spacing: float  # distance between neighbours [m]
    embedding: Embedding  # how the moving Gaussians ride on the particles
    attached: Bool[Tensor, " p"] | None = None  # beside something static, which holds them there; None: nothing is
    matter: Matter | None = None  # of which pieces the particles stand for; None: cubes around them
    doubt: Doubt | None = None  # where its surface is, as far as it is solid; None: no camera told
    parts: tuple[str, ...] = ()  # names of the segmentation's parts; empty: they have none

    @property
    def held(self) -> tuple[HeldParticles, ...]:
        """What holds the body where it is attached, besides what the scene's boundaries hold; empty: it is not."""
        if self.attached is None or not bool(self.attached.any()):
            return ()
        return (HeldParticles(position=self.position[self.attached]),)

    def check(self) -> None:
        p = len(self.position)
        if p == 0:
            raise ValueError("Body: no particle at all; lower fill.opacity or fill.spacing")
        if self.position.shape != (p, 3) or any(
            v is not None and len(v) != p for v in (self.volume, self.part, self.interior, self.attached)
        ):
            raise ValueError(
                f"Body: position {tuple(self.position.shape)}, volume, part, interior and attached must have {p} rows"
            )
        if self.parts and not 0 <= int(self.part.min()) <= int(self.part.max()) < len(self.parts):
            raise ValueError(
                f"Body.part lies in {int(self.part.min())}..{int(self.part.max())}, must be an index of {self.parts}"
            )
        require_finite("Body.position", self.position)
        require_finite("Body.volume", self.volume)
        if not bool((self.volume > 0).all()):
            raise ValueError(
                f"Body.volume: {int((self.volume <= 0).sum())} particles without volume; each must be > 0 m^3"
            )
        if self.matter is not None:
            self.matter.check()
        if self.doubt is not None:
            self.doubt.check()
        if not self.spacing > 0:
            raise ValueError(f"Body.spacing is {self.spacing:g} m, must be > 0")
