"""Labels of Gaussians in space: moving ones that lie apart from the rest, and those beside what is static."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.clusters import clusters_of_voxels


def islands(
    mean: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
    label: Int[Tensor, " n"],
    gap: float = 0.04,
    share: float = 0.05,
) -> Bool[Tensor, " n"]:
    """Moving Gaussians in clusters that hold less than `share` of the main one's opacity, and lie apart from it.

    Clusters are separated by `gap` times the (robust) size of what moves, or more where Gaussians are sparse.
    """
    moving = torch.nonzero(label > 0).flatten()
    found = torch.zeros(len(mean), dtype=torch.bool)
    if len(moving) < 2:
        return found
    position = mean[moving].double().numpy()
    apart = cKDTree(position).query(position, k=2)[0][:, 1]
    h = max(gap * middle_size(mean[moving]), 2 * float(np.quantile(apart, 0.95)))
    cluster = clusters_of_voxels(position, h)
    weight = np.bincount(cluster, weights=opacity[moving].double().numpy())
    found[moving] = torch.from_numpy((weight < share * weight.max())[cluster])
    return found


def beside_static(
    mean: Float[Tensor, "n 3"], opacity: Float[Tensor, " n"], label: Int[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Moving Gaussians within 2 % of the moving body's size of an opaque static one."""
    moving, static = label > 0, (label == 0) & (opacity > 0.1)
    found = torch.zeros(len(mean), dtype=torch.bool)
    if bool(static.any()) and bool(moving.any()):
        reach = 0.02 * middle_size(mean[moving])
        distance, _ = cKDTree(mean[static].double().numpy()).query(mean[moving].double().numpy())
        found[moving] = torch.from_numpy(distance < reach)
    return found


def middle_size(point: Float[Tensor, "n 3"]) -> float:
    """Diagonal of the box that holds the middle 90 % along each axis [m]."""
    low, high = np.quantile(point.double().numpy(), (0.05, 0.95), axis=0)
    return float(np.linalg.norm(high - low))
