"""Surface Gaussians -> particles that also occupy the interior."""

from dataclasses import dataclass, field, replace
from typing import Literal

import torch

from physics3d.checks import Length, Share, require_fields
from physics3d.filling.fill import AbstractSolid, Body, Poisson, fill
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.scenes.base import Capture
from physics3d.segmentation import Segmentation

VISIBLE = 1 / 255  # opacity below which a Gaussian is never drawn


@dataclass(frozen=True, kw_only=True)
class Fill:
    spacing: Length  # distance between neighbouring particles [m], half a cell of the simulation grid
    solid: AbstractSolid = field(default_factory=Poisson)  # what counts as inside
    interior: bool = True  # False leaves a shell one to two particles thick
    opacity: Share = 0.1  # fainter Gaussians, if below half of their median too, ride along but become no particles
    sheet_thickness: Length | None = None  # of petals and leaves [m]; null: from the flatness of their Gaussians
    isolated: Literal["attach", "drop", "keep"] = "attach"  # what becomes of pieces more than a cell away from the rest
    drop_pieces_below: Share = 0.01  # isolated pieces with less than this share of the volume are dropped
    # auto: hold what touches static Gaussians, where the scene names no fixed region
    attach: Literal["auto", "none"] = "auto"

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "fill")

    def __call__(self, capture: Capture, gaussians: Gaussians, segmentation: Segmentation | None, *, log: Log) -> Body:
        """Without a segmentation everything visible moves. Raises ValueError if nothing does."""
        self.check()
        if segmentation is None:
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
            cameras=capture.cameras,
            log=log,
        )
        body = replace(body, parts=("body",) if segmentation is None else segmentation.parts)
        log.metric("particles", len(body.position))
        log.metric("particles_interior", int(body.interior.sum()))
        log.metric("volume", float(body.volume.double().sum()))
        log.info(f"{len(body.position)} particles, {float(body.volume.double().sum()):.4g} m^3")
        if log.folder is not None:
            log.image("slices", slices(gaussians, label, body))
        return body


def slices(gaussians: Gaussians, label: torch.Tensor, body: Body):
    """Figure: three cuts two spacings thick through the middle of the body; Gaussians under its particles."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 5))
    middle = (body.position.amin(0) + body.position.amax(0)) / 2
    mean = gaussians.mean[label > 0]
    for k, panel in enumerate(figure.subplots(1, 3)):
        a, b = [i for i in range(3) if i != k]
        near = (mean[:, k] - middle[k]).abs() < body.spacing
        panel.scatter(mean[near, a], mean[near, b], s=2, color="0.7", label="Gaussians")
        near = (body.position[:, k] - middle[k]).abs() < body.spacing
        held = body.attached if body.attached is not None else torch.zeros_like(body.interior)
        for chosen, name, colour in (
            (body.interior & ~held, "interior", "tab:orange"),
            (~body.interior & ~held, "surface", "tab:blue"),
            (held, "held: touches what is static", "tab:red"),
        ):
            at = body.position[near & chosen]
            if len(at) or chosen is not held:
                panel.scatter(at[:, a], at[:, b], s=8, color=colour, label=name)
        panel.set_aspect("equal")
        panel.set_xlim(body.position[:, a].min() - 2 * body.spacing, body.position[:, a].max() + 2 * body.spacing)
        panel.set_ylim(body.position[:, b].min() - 2 * body.spacing, body.position[:, b].max() + 2 * body.spacing)
        panel.set(title=f"{'xyz'[k]} = {middle[k]:.3f} m", xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
    figure.axes[0].legend(loc="upper left", fontsize=8)
    return figure
