"""Where the surface of a body is, as the photographs' cameras see its Gaussians drawn: signed distances on a lattice.

The centres of fitted Gaussians lie inside the surface, by an amount that differs from fit to fit: what a fit gets right
is its pictures. A camera tells of a point x at depth z, with the pixel it falls on,

    outline    (1/2 - m) / |slope of m|, m the share of the pixel that is the body's: where m < 1/2, x is not the body's
               unless something static hides it
    depth      d - z where z < d + t: in front of what is seen there, or just behind it; d is where the pixel's ray
               meets the Gaussian at which half the light is gone, if that is the body's, less FRONT deviations along
               the ray: its centre may be as far beside the ray as it is broad

Outlines exclude: the distance is the largest but for a tenth of the cameras, so that a few mistaken masks carve
nothing. Depths are uncertain: the distance is their mean, cut off at the truncation t (Curless and Levoy 1996). The
larger of the two holds. What no camera sees keeps -t. Both are measured along rays, which meet the outside more
obliquely than the inside: before they are smoothed they are divided by their slope, for else the steeper side would
move the surface inwards, that of a stem 24 mm thick by 0.35 mm. In doubt is FRONT: by FRONT_DOUBT deviations, in the
mean over the cameras, and the same all over a body.
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
from physics3d.gaussians.splat import LOW_PASS
from physics3d.log import Log

MOST_VIEWS = 32
MOST_POINTS = 3_000_000  # of the lattice
PER_SPACING = 3  # points of the lattice
EDGE = 2.0  # [px] over which the share of an edge falls from 1 to 0: low pass, pixel and the Gaussians' own slope
LIMB = 2.0  # deviations by which the outlines of layers of Gaussians lie outside of their centres
# deviations by which their near side lies before them: 2 make balls of Gaussians at known depths as large as their
# pictures, 3 the stem of the reconstructed carnation as thick as it is
FRONT = 2.5
FRONT_DOUBT = 0.5  # of these
FACED = 1.0  # cameras that see a surface for it to be known where it is, in the mean over its neighbourhood
FAR = 1e6  # depth where nothing is seen [m]
LEAST_SLOPE = 0.33  # of distances that several cameras tell; what is flatter is cut off


@dataclass(frozen=True)
class Seen:
    """What cameras see of one body: distances on a lattice, interpolated between its points."""

    lower: np.ndarray  # first point of the lattice [3] [m]
    h: float  # distance of its points [m]
    distance: np.ndarray  # [i, j, k] signed, positive outside, cut off at +- truncation [m]
    outline: np.ndarray  # [i, j, k] the same, by outlines alone
    doubt: np.ndarray  # [i, j, k] standard deviation of `distance` near the surface [m]
    faced: np.ndarray  # [i, j, k] how many cameras see the body there: a surface that outlines alone bound is a guess
    unseen: np.ndarray  # [i, j, k] 1 where no camera looks: more than the truncation behind a surface; else 0
    truncation: float  # [m]

    def _at(self, field: np.ndarray, x: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(field, ((x - self.lower) / self.h).T, order=1, mode="nearest")

    def beside(self, x: np.ndarray) -> np.ndarray:
        """Bool [m]: points [m, 3] that the cameras see past the body."""
        return self._at(self.outline, x) > 0

    def deep(self, x: np.ndarray) -> np.ndarray:
        """Bool [m]: points [m, 3] behind a surface by more than the truncation, out of sight."""
        return self._at(self.unseen, x) > 0.5

    def doubt_at(self, x: np.ndarray) -> np.ndarray:
        """Standard deviation [m] of where the surface is, at points [m, 3] on it; infinite where no camera sees it."""
        return np.where(self._at(self.faced, x) >= FACED, self._at(self.doubt, x), np.inf)

    def distance_at(self, x: np.ndarray) -> np.ndarray:
        """Signed distance of points [m, 3] [m], positive outside, as cameras see it; -truncation where none does."""
        return self._at(self.distance, x)

    def settled(self, x: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points [m, 3] moved onto the surface, at most `reach` [m]; its outward normals there; which have found it."""
        slope = np.stack(np.gradient(self.distance, self.h), -1)
        gradient = lambda at: np.stack([self._at(slope[..., k], at) for k in range(3)], 1)
        moved = x.copy()
        for _ in range(8):
            g = gradient(moved)
            size = np.linalg.norm(g, axis=1, keepdims=True)
            step = -self._at(self.distance, moved)[:, None] / np.clip(size, LEAST_SLOPE, 1.0)
            moved = moved + np.clip(step, -self.h, self.h) * g / np.maximum(size, 1e-9)
        g = gradient(moved)
        size = np.linalg.norm(g, axis=1)
        found = (np.abs(self._at(self.distance, moved)) < 0.25 * self.h) & (np.linalg.norm(moved - x, axis=1) <= reach)
        return moved, g / np.maximum(size, 1e-9)[:, None], found & (size > 0.1)


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
    if h > 0.5 * spacing:
        log.info(
            f"surfaces are looked at every {1e3 * h:.2g} mm, coarser than the particles: the body is large for them"
        )
    t = max(0.75 * spacing, 2 * h)
    count = np.ceil((upper - lower) / h).astype(int) + 1
    x = torch.from_numpy(lower + h * np.indices(count).reshape(3, -1).T).float()
    covariance = gaussians.covariance()
    shown = (label > 0).to(gaussians.mean)[:, None].expand(-1, 3)
    floor = (1e-3 * spacing) ** 2 * torch.eye(3, dtype=torch.float64)  # discs of no thickness have an inverse too
    mean, shape = gaussians.mean.double().cpu(), covariance.double().cpu() + floor
    moving = label.cpu() > 0
    which = np.unique(np.linspace(0, len(cameras) - 1, min(MOST_VIEWS, len(cameras))).round().astype(int))
    mistaken = max(len(which) // 10, int(len(which) > 1))  # cameras that may be
    outline = torch.full((1 + mistaken, len(x)), -t)  # the largest
    total, looks = torch.zeros(len(x)), torch.zeros(len(x))
    deep, met = torch.zeros(len(x)), torch.zeros(len(x))  # deviations of the Gaussians along the rays
    for camera in log.progress([cameras[i] for i in which], "looking at surfaces"):
        camera = _as_fine_as(spacing / PER_SPACING, camera, x)
        with torch.no_grad():
            drawn = rasterize(
                gaussians.mean, covariance, gaussians.opacity, shown, camera, background=(0.0, 0.0, 0.0), median=True
            )
        at = drawn.at.long().cpu()  # type: ignore[union-attr]
        front, deviation = _front(at, mean, shape, camera)
        body = (at >= 0) & moving[at]
        shown_at, hidden_at = torch.where(body, front, -FAR), torch.where(body, FAR, front)
        uv, z = camera.project(x)
        within = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        pixel = 2 * uv / torch.tensor([camera.width, camera.height]) - 1
        share = _read(drawn.color[..., 0].cpu(), pixel, "bilinear")
        d, hidden = _read(shown_at, pixel, "nearest"), _read(hidden_at, pixel, "nearest")
        past = ((0.5 - share) * EDGE / (camera.fx * camera.fy) ** 0.5 * z).clamp(-t, t)
        past = torch.where(within & ((share >= 0.5) | (z < hidden - t)), past, -t)
        outline = torch.cat([outline, past[None]]).topk(len(outline), dim=0).values
        near = within & (z < d + t)
        total += torch.where(near, (d - z).clamp(max=t), 0)
        looks += near
        on = near & (_read(body.float(), pixel, "nearest") > 0.5)
        deep += torch.where(on, _read(deviation, pixel, "nearest"), 0)
        met += on
    unseen = looks <= min(1, mistaken)
    distance = torch.where(unseen, -t, total / looks.clamp_min(1))
    lattice = lambda values: values.reshape(*count).double().numpy()
    smooth = lambda values: ndimage.gaussian_filter(values, 0.7)
    faced = smooth(lattice(met))
    along = lattice(torch.maximum(distance, outline[-1]))
    return Seen(
        lower=lower,
        h=h,
        distance=smooth(_across(along, h, t)),
        doubt=FRONT_DOUBT * smooth(lattice(deep)) / faced.clip(1e-3) / smooth(_slope(along, h).clip(1)),
        faced=faced,
        outline=smooth(lattice(outline[-1])),
        unseen=lattice(unseen & (outline[-1] <= 0)),
        truncation=t,
    )


def _across(distance: Float[np.ndarray, "i j k"], h: float, truncation: float) -> Float[np.ndarray, "i j k"]:
    """Distances along rays -> to the surface, to first order: divided by their slope on a lattice of h [m]."""
    return np.clip(distance / np.maximum(_slope(distance, h), LEAST_SLOPE), -truncation, truncation)


def _slope(distance: Float[np.ndarray, "i j k"], h: float) -> Float[np.ndarray, "i j k"]:
    return np.linalg.norm(np.gradient(distance, h), axis=0)


def _front(
    at: Int[Tensor, "h w"], mean: Float[Tensor, "n 3"], shape: Float[Tensor, "n 3 3"], camera: Camera
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Depth [m] of the near side of the Gaussian `at` every pixel, where the pixel's ray meets it, FAR for -1; and its
    deviation along the ray [m], 0 for -1.

    A Gaussian as it is drawn, with the low pass, is densest on the ray o + s d at s = (d P (m - o))/(d P d): of a disc
    that is the place on it, however wide it is and wherever on it its centre lies.
    """
    chosen = at >= 0
    which = at[chosen]
    origin, direction = camera.rays(torch.float64)
    d, away = direction[chosen], mean[which] - origin
    depth = away @ camera.world_to_camera[2, :3].double()
    blur = LOW_PASS / (camera.fx * camera.fy) * depth**2
    drawn = torch.linalg.inv(shape[which] + blur[:, None, None] * torch.eye(3, dtype=torch.float64))
    towards = torch.einsum("ni,nij->nj", d, drawn)
    densest = (towards * away).sum(1) / (towards * d).sum(1)
    deviation = torch.einsum("ni,nij,nj->n", d, torch.linalg.inv(shape[which]), d).rsqrt()
    front, along = torch.full(at.shape, FAR), torch.zeros(at.shape)
    front[chosen], along[chosen] = (densest - FRONT * deviation).float(), deviation.float()
    return front, along


def _read(picture: Float[Tensor, "h w"], pixel: Float[Tensor, "m 2"], mode: str) -> Float[Tensor, " m"]:
    """Values of a picture at places in -1..1 of its width and height."""
    return torch.nn.functional.grid_sample(
        picture[None, None], pixel[None, :, None], mode=mode, padding_mode="border", align_corners=False
    )[0, 0, :, 0]


def _as_fine_as(size: float, camera: Camera, x: Float[Tensor, "m 3"]) -> Camera:
    """The camera with pixels of about `size` [m] at the points before it, but no more of them than it has."""
    _, z = camera.project(x[:: max(1, len(x) // 1000)])
    ahead = z[z > 0]
    return camera.scaled(min(1.0, float(ahead.median()) / (camera.fx * size))) if len(ahead) else camera
