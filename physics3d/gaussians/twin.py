"""The rasteriser once more, as plainly as it can be said: every Gaussian meets every pixel, in any precision, no tiles.

The standard that `rasterize.py` is compared with, forward and backward. Memory grows as n h w: for small pictures only.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.rasterize import STANDARD, Rendered
from physics3d.gaussians.splat import ALPHA_MAX, LOW_PASS, MARGIN, NEAR, Numerics


def rasterize_plainly(
    mean: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    opacity: Float[Tensor, " n"],
    color: Float[Tensor, "n 3"],
    camera: Camera,
    *,
    background: Float[Tensor, " 3"],
    antialiased: bool = False,
    median: bool = False,
    numerics: Numerics = STANDARD,
) -> Rendered:
    """Same arguments and result as `rasterize`, differentiated by torch in the precision of `mean`."""
    M = camera.world_to_camera.to(mean)
    X = mean @ M[:3, :3].T + M[:3, 3]
    order = torch.argsort(X[:, 2], stable=True)
    order = order[(X[order, 2] > NEAR) & (opacity[order] >= numerics.cutoff)]
    X, covariance, opacity, color = X[order], covariance[order], opacity[order], color[order]

    x, y, z = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2], X[:, 2]
    w, h = camera.width, camera.height
    xj = x.clamp((-MARGIN * w - camera.cx) / camera.fx, ((1 + MARGIN) * w - camera.cx) / camera.fx)
    yj = y.clamp((-MARGIN * h - camera.cy) / camera.fy, ((1 + MARGIN) * h - camera.cy) / camera.fy)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    J = torch.stack([camera.fx * torch.stack([one, zero, -xj], -1), camera.fy * torch.stack([zero, one, -yj], -1)], 1)
    J = J / z[:, None, None] @ M[:3, :3]
    flat = J @ covariance @ J.mT
    flat = (flat + flat.mT) / 2
    wide = flat + LOW_PASS * torch.eye(2).to(mean)
    if antialiased:
        ratio = torch.linalg.det(flat) / torch.linalg.det(wide)
        opacity = opacity * torch.where(ratio > 0, ratio, 1).sqrt() * (ratio > 0)

    row, column = torch.meshgrid(torch.arange(h).to(mean) + 0.5, torch.arange(w).to(mean) + 0.5, indexing="ij")
    d = torch.stack(
        [column - (camera.fx * x + camera.cx)[:, None, None], row - (camera.fy * y + camera.cy)[:, None, None]], -1
    )
    e = 0.5 * torch.einsum("nhwi,nij,nhwj->nhw", d, torch.linalg.inv(wide), d)
    alpha = (opacity[:, None, None] * torch.exp(-e)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= numerics.cutoff, alpha, 0)
    clear = torch.cumprod(torch.cat([torch.ones(1, h, w).to(mean), 1 - alpha]), 0)
    drawn = clear[:-1] >= numerics.stop
    weight = torch.where(drawn, clear[:-1] * alpha, 0)
    end = torch.where(drawn, 1 - alpha, 1).prod(0)
    seen = weight.sum(0) > 0
    depth = torch.where(seen, torch.einsum("nhw,n->hw", weight, z) / torch.where(seen, 1 - end, 1), 0)
    here = (clear[:-1] >= 0.5) & (clear[1:] < 0.5)  # at most once along a ray
    middle = torch.einsum("nhw,n->hw", here.to(z), z) if median else None
    at = (here * (order + 1)[:, None, None]).sum(0).int() - 1 if median else None
    picture = torch.einsum("nhw,nc->hwc", weight, color) + end[..., None] * background.to(mean)
    return Rendered(color=picture, alpha=1 - end, depth=depth, median=middle, at=at)
