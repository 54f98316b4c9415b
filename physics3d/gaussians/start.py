"""Where a fit starts: one round Gaussian per point, of structure from motion, drawn at random, or of the background."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.photograph import Photograph
from physics3d.gaussians.rasterize import NEAR
from physics3d.gaussians.sh import C0


def from_points(points: Tensor, colors: Tensor, *, sh_degree: int) -> Gaussians:
    """One round Gaussian per point [m, 3], as wide as the mean distance to the three nearest others, opacity 0.1."""
    from scipy.spatial import cKDTree

    array = points.double().numpy()
    distance = cKDTree(array).query(array, k=min(4, len(array)))[0].reshape(len(array), -1)[:, 1:]
    width = torch.from_numpy(distance).mean(-1) if distance.size else torch.full((len(array),), 0.01)
    width = width.clamp(width.median() * 0.1, width.median() * 10).clamp_min(1e-6)
    sh = torch.zeros(len(points), (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colors.float() - 0.5) / C0
    return Gaussians(
        mean=points.float(),
        log_scale=torch.log(width).float()[:, None].repeat(1, 3),
        quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1),
        opacity_logit=torch.full((len(points),), math.log(0.1 / 0.9)),
        sh=sh,
    )


def random_points(photographs: list[Photograph], count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Up to `count` points [m, 3] [m] that most cameras see, inside every matte, and their mean colours [m, 3].

    Drawn around the point nearest to all optical axes, in a box that shrinks to what is seen in common. Raises
    ValueError if the cameras see nothing in common.
    """
    picks = torch.linspace(0, len(photographs) - 1, min(24, len(photographs))).round().long().tolist()
    views = [photographs[i] for i in picks]
    centres = torch.stack([p.camera.centre for p in views]).double()
    axes = torch.stack([p.camera.world_to_camera[2, :3] for p in views]).double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    middle = torch.linalg.lstsq(across.sum(0), (across @ centres[..., None]).sum(0)).solution[:, 0]
    reach = (centres - middle).norm(dim=-1).median()
    lower, upper = middle - reach, middle + reach
    points, colors = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3)
    for _ in range(40):
        tried = lower + (upper - lower) * torch.rand(50_000, 3, generator=generator, dtype=torch.float64)
        keep, color = _seen_in_common(tried, views)
        points, colors = torch.cat([points, tried[keep]]), torch.cat([colors, color[keep]])
        if len(points) >= count:
            break
        if len(points) >= 10:
            margin = 0.2 * (points.amax(0) - points.amin(0))
            lower = torch.maximum(lower, points.amin(0) - margin)
            upper = torch.minimum(upper, points.amax(0) + margin)
    if not len(points):
        raise ValueError("the cameras see no common space; check the poses, or give the capture points")
    return points[:count].float(), colors[:count]


def _seen_in_common(points: Float[Tensor, "m 3"], views: list[Photograph]) -> tuple[Tensor, Float[Tensor, "m 3"]]:
    """Which points six tenths of the views see, and none sees outside its matte; the mean colour they are seen in."""
    seen, inside = torch.zeros(len(points)), torch.ones(len(points), dtype=torch.bool)
    color = torch.zeros(len(points), 3)
    for p in views:
        uv, z = p.camera.project(points)
        u, v = uv.floor().long().unbind(-1)
        visible = (z > NEAR) & (u >= 0) & (u < p.camera.width) & (v >= 0) & (v < p.camera.height)
        u, v = u[visible], v[visible]
        seen[visible] += 1
        color[visible] += p.color[v, u]
        if p.alpha is not None:
            inside[visible] &= p.alpha[v, u] > 0.1
    return inside & (seen >= 0.6 * len(views)), color / seen.clamp_min(1)[:, None]


def background_points(
    photographs: list[Photograph], points: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Points [count, 3] [m] on rays through random pixels, as far as the farther half of `points`, with their colours.

    Structure from motion finds nothing on bare walls; without these, holes stay there.
    """
    found, colors = [], []
    for i, share in enumerate(torch.arange(count).chunk(min(count, len(photographs)))):
        photograph = photographs[(i * len(photographs)) // min(count, len(photographs))]
        uv, z = photograph.camera.project(points.double())
        w, h = photograph.camera.width, photograph.camera.height
        inside = (z > NEAR) & (uv >= 0).all(-1) & (uv[:, 0] < w) & (uv[:, 1] < h)
        if not inside.any():
            continue
        pixel = torch.randint(w * h, (len(share),), generator=generator)
        level = 0.5 + 0.5 * torch.rand(len(share), generator=generator, dtype=torch.float64)
        origin, direction = photograph.camera.rays(torch.float64)
        found.append(origin + torch.quantile(z[inside], level)[:, None] * direction.reshape(-1, 3)[pixel])
        colors.append(photograph.color.reshape(-1, 3)[pixel])
    return (torch.cat(found).float(), torch.cat(colors)) if found else (points[:0].float(), torch.zeros(0, 3))
