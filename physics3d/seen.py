"""Where the surface of a body is, as the photographs' cameras see its Gaussians drawn: signed distances on a lattice.

The centres of fitted Gaussians lie inside the surface, by an amount that differs from fit to fit: what a fit gets right
is its pictures. A camera tells of a point x at depth z, with the pixel it falls on,

    outline    (1/2 - m) / |slope of m|, m the share of the pixel that is the body's: where m < 1/2, x is not the body's
               unless something static hides it
    depth      d - z where m >= 1/2 and z < d + t: in front of what is seen there, or just behind it; d is the depth of
               the Gaussian at which half the light is gone, less twice its deviation along the ray

Outlines exclude: the distance is the second largest of all cameras, so that one mistaken mask carves nothing. Depths
are uncertain: the distance is their mean, cut off at the truncation t (Curless and Levoy 1996). The larger of the two
holds. What no camera sees keeps -t.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import rasterize
from physics3d.log import Log

MOST_VIEWS = 32
MOST_POINTS = 3_000_000  # of the lattice
PER_SPACING = 3  # points of the lattice
EDGE = 2.0  # [px] over which the share of an edge falls from 1 to 0: low pass, pixel and the Gaussians' own slope
LIMB = 2.0  # outlines lie that many standard deviations outside the centres: the layers along a grazing ray add up
FAR = 1e6  # depth where nothing is seen [m]


@dataclass(frozen=True)
class Seen:
    lower: np.ndarray  # first point of the lattice [3] [m]
    h: float  # distance of its points [m]
    distance: np.ndarray  # [i, j, k] signed, positive outside, cut off at +- truncation [m]
    outline: np.ndarray  # [i, j, k] the same, by outlines alone
    truncation: float  # [m]

    def _at(self, field: np.ndarray, x: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(field, ((x - self.lower) / self.h).T, order=1, mode="nearest")

    def beside(self, x: np.ndarray) -> np.ndarray:
        """Bool [m]: points [m, 3] that the cameras see past the body."""
        return self._at(self.outline, x) > 0

    def settled(self, x: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points [m, 3] moved onto the surface, at most `reach` [m]; its outward normals there; which have found it."""
        slope = np.stack(np.gradient(self.distance, self.h), -1)
        moved = x.copy()
        for _ in range(8):
            g = np.stack([self._at(slope[..., k], moved) for k in range(3)], 1)
            size = np.linalg.norm(g, axis=1, keepdims=True)
            normal = g / np.maximum(size, 1e-9)
            # distances of several cameras are not quite distances: their slope is between a third and one
            step = -self._at(self.distance, moved)[:, None] / np.clip(size, 0.33, 1.0)
            moved = moved + np.clip(step, -self.h, self.h) * normal
        found = (np.abs(self._at(self.distance, moved)) < 0.25 * self.h) & (np.linalg.norm(moved - x, axis=1) <= reach)
        return moved, normal, found


def seen(
    gaussians: Gaussians,
    label: Int[Tensor, " n"],
    cameras: Sequence[Camera],
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    spacing: float,
    log: Log,
) -> Seen:
    """What the cameras see, in the box `lower`..`upper` [m], of the Gaussians with label > 0 that are to be particles
    `spacing` [m] apart. At most MOST_VIEWS of the cameras are asked."""
    h = max(spacing / PER_SPACING, float(np.prod(upper - lower) / MOST_POINTS) ** (1 / 3))
    t = max(0.75 * spacing, 2 * h)
    count = np.ceil((upper - lower) / h).astype(int) + 1
    x = torch.from_numpy(lower + h * np.indices(count).reshape(3, -1).T).float()
    covariance, moves = gaussians.covariance(), (label > 0).to(gaussians.mean)
    shown = moves[:, None].expand(-1, 3)
    precision = torch.linalg.inv(covariance.double() + 1e-10 * torch.eye(3, dtype=torch.float64))
    outline, second = torch.full((len(x),), -t), torch.full((len(x),), -t)
    total, looks = torch.zeros(len(x)), torch.zeros(len(x))
    which = np.unique(np.linspace(0, len(cameras) - 1, min(MOST_VIEWS, len(cameras))).round().astype(int))
    for camera in log.progress([cameras[i] for i in which], "looking at the body"):
        camera = _as_fine_as(spacing / 3, camera, x)
        with torch.no_grad():
            drawn = rasterize(
                gaussians.mean, covariance, gaussians.opacity, shown, camera, background=(0.0, 0.0, 0.0), median=True
            )
        ray = gaussians.mean.double() - camera.centre
        ray = ray / (ray @ camera.world_to_camera[2, :3])[:, None]
        deviation = torch.einsum("ni,nij,nj->n", ray, precision, ray).rsqrt().float()  # of the depth [m]
        at, median = drawn.at.long().cpu(), drawn.median.cpu()  # type: ignore[union-attr]
        front = torch.where(at >= 0, median - LIMB * deviation[at], FAR)
        cover = torch.where((at >= 0) & (moves[at] == 0), front, FAR)  # what is static and may hide the body
        uv, z = camera.project(x)
        within = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        pixel = 2 * uv / torch.tensor([camera.width, camera.height]) - 1
        share = _read(drawn.color[..., 0].cpu(), pixel, "bilinear")
        d, hidden = _read(front, pixel, "nearest"), _read(cover, pixel, "nearest")
        past = ((0.5 - share) * EDGE / camera.fx * z).clamp(-t, t)
        past = torch.where(within & ((share >= 0.5) | (z < hidden - t)), past, -t)
        second = torch.maximum(second, torch.minimum(outline, past))
        outline = torch.maximum(outline, past)
        near = within & (share >= 0.5) & (z < d + t)
        total += torch.where(near, (d - z).clamp(max=t), 0)
        looks += near
    distance = torch.where(looks > 0, total / looks.clamp_min(1), -t)
    fields = [f.reshape(*count).double().numpy() for f in (torch.maximum(distance, second), second)]
    smooth = [ndimage.gaussian_filter(f, 0.7) for f in fields]
    return Seen(lower=lower, h=h, distance=smooth[0], outline=smooth[1], truncation=t)


def _read(picture: Float[Tensor, "h w"], pixel: Float[Tensor, "m 2"], mode: str) -> Float[Tensor, " m"]:
    """Values of a picture at places in -1..1 of its width and height."""
    return torch.nn.functional.grid_sample(
        picture[None, None], pixel[None, :, None], mode=mode, padding_mode="border", align_corners=False
    )[0, 0, :, 0]


def _as_fine_as(size: float, camera: Camera, x: Float[Tensor, "m 3"]) -> Camera:
    """The camera with pixels of about `size` [m] at the body, but no more of them than it has."""
    _, z = camera.project(x[:: max(1, len(x) // 100)])
    return camera.scaled(min(1.0, float(z.median()) / (camera.fx * size)))
