"""Space that an object may take, by the view in which it was prompted: what is farther behind is never part of it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.segmentation.pixels import depth_in, eroded, size_of
from physics3d.segmentation.prompts import Prompt, within_any
from physics3d.segmentation.views import View


@dataclass(frozen=True)
class Room:
    """Space that the object may take: a box along the axes of a view that shows it, as deep as it is wide or high."""

    world_to_camera: Float[Tensor, "4 4"]
    lower: Float[Tensor, " 3"]  # in the camera's axes [m]
    upper: Float[Tensor, " 3"]
    boxes: tuple[Prompt, ...]  # with corners in space: where there are any, it is also in one of them

    @classmethod
    def around(cls, view: View, mask: Bool[np.ndarray, "h w"], prompts: tuple[Prompt, ...] = ()) -> "Room":
        """From the masked surface, with a margin of an eighth.

        Raises ValueError if the reconstruction shows next to nothing there.
        """
        boxes = tuple(p for p in prompts if p.lower is not None)
        silhouette, visible = (p[within_any(boxes, p)] for p in (view.points(mask), view.points(eroded(mask, 2))))
        if len(visible) < 10:
            raise ValueError(
                f"the mask in view {view.name} covers only {len(visible)} opaque pixels of the reconstruction"
                f"{' in the box in space' if boxes else ''}; "
                "choose a view in which the object is large, or reconstruct longer"
            )
        M = view.camera.world_to_camera.to(visible)
        local = lambda point: (point @ M[:3, :3].T + M[:3, 3]).numpy()
        low, high = np.quantile(local(silhouette), (0.005, 0.995), axis=0)
        size = (high - low)[:2].max()
        low[2] = np.quantile(local(visible)[:, 2], 0.02)  # outlines, whose depths mix, say nothing of this
        high[2] = low[2] + size
        low[2] -= 0.4 * size  # thin things that reach towards the camera are too few to show in that
        low, high = (torch.from_numpy(v).to(visible) for v in (low - size / 8, high + size / 8))
        return cls(M, low, high, boxes)

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """[m], in the world."""
        return (0.5 * (self.lower + self.upper) - self.world_to_camera[:3, 3]) @ self.world_to_camera[:3, :3]

    def whole_in(self, camera: Camera) -> bool:
        """Does the camera see most of it: the ball in it that touches the nearest pair of its sides?"""
        uv, depth = camera.project(self.centre[None])
        radius = 0.5 * float((self.upper - self.lower).min())
        reach = radius * min(camera.fx, camera.fy) / float(depth.clamp_min(1e-9))
        u, v = uv[0].tolist()
        return float(depth) > radius and reach <= min(u, v, camera.width - u, camera.height - v)

    def holds(self, point: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        M = self.world_to_camera.to(point)
        local = point @ M[:3, :3].T + M[:3, 3]
        inside = ((local >= self.lower.to(point)) & (local <= self.upper.to(point))).all(1)
        return inside & within_any(self.boxes, point)

    def excludes(self, view: View) -> Bool[np.ndarray, "h w"]:
        """Pixels whose surface is outside."""
        outside = np.zeros(view.image.shape[:2], bool)
        point = view.points(~outside)
        outside[(view.rendered.alpha > 0.5).numpy()] = (~self.holds(point)).numpy()
        return outside


def clearly_outside(room: Room, view: View, guess: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels well inside the area that shows what is outside the room: where thin things end, depth is a mix.

    Where the reconstruction has gaps no pixel may be well inside; then the room only binds Gaussians.
    """
    return depth_in(room.excludes(view)) > 0.06 * size_of(guess)
