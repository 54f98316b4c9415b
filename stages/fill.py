"""Surface Gaussians -> particles that also occupy the interior."""

from dataclasses import dataclass, field, replace
from typing import Literal

import torch

from physics3d.checks import Length, Share, require_fields
from physics3d.filling.body import Body
from physics3d.filling.fill import fill
from physics3d.filling.section import thinnest_section
from physics3d.filling.slices import slices
from physics3d.filling.solids import AbstractSolid, Poisson
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.splat import VISIBLE
from physics3d.log import Log
from physics3d.scenes.base import Capture
from physics3d.segmentation import Segmentation


@dataclass(frozen=True, kw_only=True)
class Fill:
    spacing: Length  # distance between neighbouring particles [m], half a cell of the simulation grid
    solid: AbstractSolid = field(default_factory=Poisson)  # what counts as inside
    interior: bool = True  # False leaves a shell one to two particles thick
    opacity: Share = 0.1  # fainter Gaussians, if below half of their median too, ride along but become no particles
    sheet_thickness: Length | None = None  # of petals and leaves [m]; null: from the flatness of their Gaussians
    isolated: Literal["attach", "drop", "keep"] = "attach"  # what becomes of pieces more than a cell away from the rest
    drop_pieces_below: Share = 0.01  # isolated pieces with less than this share of the volume are dropped
    attach: Literal["auto", "none"] = "auto"  # whether what touches static Gaussians is held there

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "fill")

    def __call__(self, capture: Capture, gaussians: Gaussians, segmentation: Segmentation | None, *, log: Log) -> Body:
        """Without a segmentation everything visible moves. Raises ValueError if nothing does."""
        self.check()
        if segmentation is None and capture.moves is not None:
            label = capture.moves.to(torch.int32)
        elif segmentation is None:
            label = (gaussians.opacity > VISIBLE).to(torch.int32)
        elif len(segmentation.label) != len(gaussians):
            raise ValueError(
                f"{len(segmentation.label)} labels for {len(gaussians)} Gaussians; segment the same reconstruction"
            )
        else:
            label = segmentation.label
        body = fill(
            gaussians,
            label,
            spacing=self.spacing,
            opacity=self.opacity,
            solid=self.solid,
            interior=self.interior,
            sheet_thickness=self.sheet_thickness,
            isolated=self.isolated,
            drop_pieces_below=self.drop_pieces_below,
            attach=self.attach == "auto",
            sure=capture.moves is not None,
            cameras=capture.cameras,
            log=log,
        )
        body = replace(body, parts=("body",) if segmentation is None else segmentation.parts)
        log.metric("particles", len(body.position))
        log.metric("particles_interior", int(body.interior.sum()))
        log.metric("volume", float(body.volume.double().sum()))
        log.info(f"{len(body.position)} particles, {float(body.volume.double().sum()):.4g} m^3")
        if body.attached is not None:
            position, volume = body.position.double().numpy(), body.volume.double().numpy()
            section = thinnest_section(position, volume, body.attached.numpy(), body.spacing)
            if section is not None:
                log.info(section.described())
        if log.folder is not None:
            log.image("slices", slices(gaussians, label, body))
        return body
