"""A photograph as Gaussians are fitted to it: colours in 0..1, its camera, and its matte where it has one."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """What a model is fitted to: colours, their camera, and a matte where there is one."""

    camera: Camera
    color: Float[Tensor, "h w 3"]  # 0..1; where there is a matte, multiplied by it
    alpha: Float[Tensor, "h w"] | None  # matte, 0..1

    def on(self, background: Float[Tensor, " 3"]) -> Float[Tensor, "h w 3"]:
        return self.color if self.alpha is None else self.color + (1 - self.alpha)[..., None] * background

    def scaled(self, factor: float) -> "Photograph":
        """Fewer pixels, each the average of those it covers."""
        camera = self.camera.scaled(factor)
        size = (camera.height, camera.width)
        shrink = lambda maps: torch.nn.functional.interpolate(maps[None], size, mode="bilinear", antialias=True)[0]
        color = shrink(self.color.permute(2, 0, 1)).permute(1, 2, 0).contiguous()
        return Photograph(camera=camera, color=color, alpha=None if self.alpha is None else shrink(self.alpha[None])[0])

    def to(self, device: str) -> "Photograph":
        return replace(self, color=self.color.to(device), alpha=None if self.alpha is None else self.alpha.to(device))
