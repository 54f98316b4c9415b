"""Gaussians drawn where particles have carried them (`carry.py`), and what never moves drawn once (`Backdrop`)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.carry import carry
from physics3d.gaussians.embedding import Embedding
from physics3d.gaussians.interior import Interior
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import Rendered, rasterize, tiles_of, window
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import sh_color


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """What never moves, drawn once for one camera: a frame draws anew only the tiles that something moving touches."""

    still: Rendered
    camera: Camera

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        embedding: Embedding,
        camera: Camera,
        *,
        background: Float[Tensor, " 3"] | tuple[float, float, float],
    ) -> "Backdrop | None":
        """None where every Gaussian moves."""
        static = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.mean.device)
        static[embedding.which.to(static.device)] = False
        if not static.any():
            return None
        with torch.no_grad():
            return cls(still=render(gaussians.select(static), camera, background=background), camera=camera)


def render_deformed(
    gaussians: Gaussians,
    embedding: Embedding,
    X: Float[Tensor, "p 3"],
    x: Float[Tensor, "p 3"],
    F: Float[Tensor, "p 3 3"],
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
    interior: Interior | None = None,
    backdrop: Backdrop | None = None,
) -> Rendered:
    """Draw the Gaussians where the particles have carried them; differentiable in x, F and the model's appearance.

    Those of the `interior` are drawn where the body has opened. With a `backdrop` of the same camera the picture is the
    same, but only the tiles that a moving Gaussian touches are computed, and only what lies there has a gradient.
    """
    mean, covariance, rotation = carry(gaussians, embedding, X, x, F)
    direction = mean - camera.centre.to(mean)
    if rotation is not None:
        direction = torch.einsum("nji,nj->ni", rotation, torch.nn.functional.normalize(direction, dim=-1))
    color = sh_color(gaussians.sh, direction.to(gaussians.sh))
    drawn = mean, covariance, gaussians.opacity, color
    if interior is not None:
        inner = interior.drawn(X, x)
        if len(inner[0]):
            drawn = tuple(torch.cat([a, b.to(a)]) for a, b in zip(drawn, inner, strict=True))  # type: ignore[assignment]
    if backdrop is None:
        return rasterize(*drawn, camera, background=background)
    moving = torch.zeros(len(drawn[0]), dtype=torch.bool, device=mean.device)
    moving[embedding.which.to(mean.device)] = True
    moving[len(gaussians) :] = True
    tiles = tiles_of(drawn[0][moving], drawn[1][moving], drawn[2][moving], camera)
    part, place = rasterize(*drawn, camera, background=background, tiles=tiles), window(tiles)
    whole = {name: getattr(backdrop.still, name).clone() for name in ("color", "alpha", "depth")}
    for name, picture in whole.items():
        picture[place] = getattr(part, name)[place]
    return Rendered(**whole)
