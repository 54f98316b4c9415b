"""Floaters: Gaussians that hang alone in the air, where few photographs contradict them.

A Gaussian floats if its mean distance to its nearest neighbours is more than `deviations` standard deviations above the
average of all (Open3D's statistical outlier removal, Rusu et al. 2008), and if no photograph needs it: the sum of its
blending weights is less than `DRAWN` pixel in each. A filled body would have a particle there. Large ones on plain
surfaces are far from their neighbours as well, but they are drawn.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import contribution
from physics3d.gaussians.splat import VISIBLE
from physics3d.open3d_import import open3d

NEIGHBOURS = 20
DRAWN = 1.0  # [px]


def lonely(mean: Float[Tensor, "n 3"], deviations: float) -> Bool[Tensor, " n"]:
    """Which points [m] are alone: their mean distance to their neighbours is `deviations` above the average of all."""
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mean.double().numpy()))
    _, kept = cloud.remove_statistical_outlier(min(NEIGHBOURS, len(mean) - 1), deviations)
    alone = torch.ones(len(mean), dtype=torch.bool)
    alone[torch.tensor(kept, dtype=torch.long)] = False
    return alone


def floaters(gaussians: Gaussians, cameras: list[Camera], *, deviations: float) -> Bool[Tensor, " n"]:
    """Which Gaussians float, as the cameras see them; those too faint to be drawn count as floating.

    Raises ValueError unless `deviations` > 0.
    """
    if not deviations > 0:
        raise ValueError(f"floaters: deviations is {deviations}; it must be positive, e.g. 2")
    drawn = torch.nonzero(gaussians.opacity.cpu() >= VISIBLE)[:, 0]
    alone = torch.ones(len(gaussians), dtype=torch.bool)
    if len(drawn) <= NEIGHBOURS:
        alone[drawn] = False
        return alone
    alone[drawn] = lonely(gaussians.mean.detach().cpu()[drawn], deviations)
    for camera in cameras if alone.any() else ():
        everywhere = torch.ones(1, camera.height, camera.width, device=gaussians.mean.device)
        alone &= contribution(gaussians, camera, everywhere)[:, 0].cpu() < DRAWN
    return alone
