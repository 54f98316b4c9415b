"""Photographs as they are masked, with what the reconstruction shows there; some of them, spread out."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import Rendered
from physics3d.gaussians.render import render
from physics3d.scenes.base import Capture


@dataclass(frozen=True)
class View:
    """A photograph and what the reconstruction shows there, at the same size."""

    index: int  # in the capture
    name: str
    image: UInt8[np.ndarray, "h w 3"]
    camera: Camera
    rendered: Rendered

    def points(self, mask: Bool[np.ndarray, "h w"]) -> Float[Tensor, "m 3"]:
        """The visible surface [m] at the masked pixels where the reconstruction is opaque."""
        chosen = torch.from_numpy(mask) & (self.rendered.alpha > 0.5)
        origin, direction = self.camera.rays()
        return origin + self.rendered.depth[chosen][:, None] * direction[chosen]


def view_of(capture: Capture, gaussians: Gaussians, index: int, size: int) -> View:
    """Photograph `index` of the capture, its longer side reduced to `size` [px]."""
    import cv2

    image, camera = capture.images[index].numpy(), capture.cameras[index]
    if max(image.shape) > size:
        camera = camera.scaled(size / max(image.shape))
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    with torch.no_grad():
        rendered = render(gaussians, camera, background=capture.background)
    rendered = type(rendered)(color=rendered.color.cpu(), alpha=rendered.alpha.cpu(), depth=rendered.depth.cpu())
    return View(index, capture.names[index], image, camera, rendered)


def spread_out(cameras: tuple[Camera, ...], candidates: list[int], first: list[int], count: int) -> list[int]:
    """`first`, and of the candidates so many more that there are `count`: each the farthest from those before it."""
    centres = torch.stack([cameras[i].centre for i in candidates])
    chosen = first or [candidates[0]]
    distance = torch.full((len(candidates),), torch.inf, dtype=torch.float64)
    for i in chosen:
        distance = torch.minimum(distance, (centres - cameras[i].centre).norm(dim=1))
    while len(chosen) < min(count, len(candidates)):
        k = int(distance.argmax())
        chosen.append(candidates[k])
        distance = torch.minimum(distance, (centres - centres[k]).norm(dim=1))
        distance[k] = -1
    return chosen
