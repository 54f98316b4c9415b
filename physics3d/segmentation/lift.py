"""Masks -> one label per Gaussian: the label whose pixels it contributes most to, summed over views.

    A_k = sum over views and pixels of label k of (blending weight of the Gaussian),   label = argmax_k A_k

which minimises sum |rendered label - mask| in closed form, because rendering is linear in the labels (Shen et al. 2024,
"FlashSplat"). A Gaussian that shows nowhere takes the label of its neighbours.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import contribution, rasterize

NEGLIGIBLE = 0.3  # [px] summed over views
NEIGHBOURS = 8


def contributions(
    gaussians: Gaussians, cameras: Sequence[Camera], maps: Sequence[Int[Tensor, "h w"]], count: int
) -> Float[Tensor, "n count"]:
    """A [n, count] [px] for labels 0..count - 1, given a map of labels for every camera."""
    total = torch.zeros(len(gaussians), count)
    labels = torch.arange(count)[:, None, None]
    for camera, labelled in zip(cameras, maps, strict=True):
        masks = (labelled[None] == labels).to(gaussians.mean.dtype).to(gaussians.mean.device)
        total += contribution(gaussians, camera, masks).cpu()
    return total


def lift(mean: Float[Tensor, "n 3"], weights: Float[Tensor, "n count"]) -> Int[Tensor, " n"]:
    """Label int32 [n]. Raises ValueError if no Gaussian shows in any mask."""
    label = weights.argmax(1)
    shown = weights.sum(1) > NEGLIGIBLE
    if not bool(shown.any()):
        raise ValueError("no Gaussian contributes to any masked view; cameras and Gaussians do not belong together")
    position, known = mean.double().numpy(), torch.nonzero(shown).flatten()
    if not bool(shown.all()):
        k = min(NEIGHBOURS, len(known))
        _, near = cKDTree(position[known.numpy()]).query(position[(~shown).numpy()], k=list(range(1, k + 1)))
        votes = torch.nn.functional.one_hot(label[known][torch.from_numpy(near)], weights.shape[1]).sum(1)
        label[~shown] = votes.argmax(1)
    return label.to(torch.int32)


def shares(gaussians: Gaussians, belief: Float[Tensor, "n k"], camera: Camera) -> Float[np.ndarray, "k h w"]:
    """Share of each pixel (0..1) that belongs to each of k parts, when `belief` of each Gaussian does."""
    covariance, drawn = gaussians.covariance(), []
    for three in torch.nn.functional.pad(belief, (0, -belief.shape[1] % 3)).to(gaussians.mean).split(3, 1):
        with torch.no_grad():
            picture = rasterize(gaussians.mean, covariance, gaussians.opacity, three, camera, background=(0, 0, 0))
        drawn.append(picture.color.permute(2, 0, 1).cpu())
    return torch.cat(drawn)[: belief.shape[1]].numpy()


def one_hot(label: Int[Tensor, " n"], count: int) -> Float[Tensor, "n count"]:
    """1 where the label is 1..count."""
    return torch.nn.functional.one_hot(label.long(), 1 + count)[:, 1:].float()


def expected(
    mean: Float[Tensor, "n 3"], weights: Float[Tensor, "n count"], rooms: Bool[Tensor, "k n"]
) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k"]]:
    """(what the views so far say of the parts 1..k, what may be added): the second of Gaussians that none has shown.

    Those may be of the part nearest to them whose room holds them. A label is kept only in the part's room.
    """
    shown = weights.sum(1) > NEGLIGIBLE
    said = one_hot(lift(mean, weights), len(rooms)) * rooms.T * shown[:, None]
    position, nearest = mean.double().numpy(), torch.full(rooms.T.shape, torch.inf, dtype=torch.float64)
    for k, room in enumerate(rooms):
        of_part, open_ = said[:, k] > 0, room & ~shown
        if of_part.any() and open_.any():
            distance, _ = cKDTree(position[of_part.numpy()]).query(position[open_.numpy()])
            nearest[open_, k] = torch.from_numpy(distance)
    possible = torch.nn.functional.one_hot(nearest.argmin(1), len(rooms)) * torch.isfinite(nearest)
    return said, possible.float()


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
    h = max(gap * extent(mean[moving]), 2 * float(np.quantile(apart, 0.95)))
    voxels, voxel = np.unique(np.floor(position / h).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(voxels).query_pairs(1.1, p=np.inf, output_type="ndarray")
    links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(voxels),) * 2)
    _, cluster = sparse.csgraph.connected_components(links, directed=False)
    cluster = cluster[voxel.reshape(-1)]
    weight = np.bincount(cluster, weights=opacity[moving].double().numpy())
    found[moving] = torch.from_numpy((weight < share * weight.max())[cluster])
    return found


def touching(mean: Float[Tensor, "n 3"], opacity: Float[Tensor, " n"], label: Int[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Moving Gaussians within 2 % of the moving body's size of an opaque static one: there the body is attached."""
    moving, static = label > 0, (label == 0) & (opacity > 0.1)
    found = torch.zeros(len(mean), dtype=torch.bool)
    if bool(static.any()) and bool(moving.any()):
        reach = 0.02 * extent(mean[moving])
        distance, _ = cKDTree(mean[static].double().numpy()).query(mean[moving].double().numpy())
        found[moving] = torch.from_numpy(distance < reach)
    return found


def extent(point: Float[Tensor, "n 3"]) -> float:
    """Diagonal of the box that holds the middle 90 % along each axis [m]."""
    low, high = np.quantile(point.double().numpy(), (0.05, 0.95), axis=0)
    return float(np.linalg.norm(high - low))
