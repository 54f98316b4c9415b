"""Masks -> one label per Gaussian: the label whose pixels it contributes most to, summed over views.

    A_k = sum over views and pixels of label k of t (blending weight of the Gaussian),   label = argmax_k A_k

which minimises sum t |rendered label - mask| in closed form, because rendering is linear in the labels (Shen et al.
2024, "FlashSplat", with t = 1). Here t is small next to outlines, across which Gaussians show: else the rim of a body,
and what barely shows beside it, would take the wrong side. A Gaussian that shows nowhere takes its neighbours' label.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import contribution, rasterize

NEGLIGIBLE = 0.03  # [px] summed over views, as pixels count
NEIGHBOURS = 8
BLUNT = 1  # [px] from an outline, within which Gaussians show on both of its sides
UNSURE = 0.1  # what a pixel counts there: enough for what is too thin to show elsewhere


def contributions(
    gaussians: Gaussians, cameras: Sequence[Camera], maps: Sequence[Int[Tensor, "h w"]], count: int
) -> Float[Tensor, "n count"]:
    """A [n, count] [px] for labels 0..count - 1, given a map of labels for every camera; pixels count by `trust`."""
    total = torch.zeros(len(gaussians), count)
    labels = torch.arange(count)[:, None, None]
    for camera, labelled in zip(cameras, maps, strict=True):
        masks = trust(labelled) * (labelled[None] == labels)
        masks = masks.to(gaussians.mean.dtype).to(gaussians.mean.device)
        total += contribution(gaussians, camera, masks).cpu()
    return total


def trust(labelled: Int[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """t of every pixel: 1 where all around it, as far as Gaussians are blunt, has one label."""
    across = 1 + 2 * BLUNT
    one = ndimage.minimum_filter(labelled.numpy(), across) == ndimage.maximum_filter(labelled.numpy(), across)
    return torch.from_numpy(np.where(one, 1.0, UNSURE))


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
    """(what the views so far say of the parts 1..k, what may be added): shares of a belief that add up to at most 1.

        said_ik = A_ik/(A_i + c),   possible_ik = c/(A_i + c) of the part nearest to it,   c = sum A_ik^2/(2 sum A_ik)

    so that what has shown half as much as Gaussians of parts usually do is half known. Neither reaches out of a room.
    """
    total, of_parts = weights.sum(1, keepdim=True), weights[:, 1:]
    usual = 0.5 * float((of_parts**2).sum() / of_parts.sum().clamp_min(1e-9))
    unknown = usual / (total + usual).clamp_min(1e-9)
    label = lift(mean, weights) * (total[:, 0] > NEGLIGIBLE)
    position, nearest = mean.double().numpy(), torch.full(rooms.T.shape, torch.inf, dtype=torch.float64)
    for k, room in enumerate(rooms):
        of_part = (label == k + 1) & room
        if of_part.any():
            distance, _ = cKDTree(position[of_part.numpy()]).query(position[room.numpy()])
            nearest[room, k] = torch.from_numpy(distance)
    possible = torch.nn.functional.one_hot(nearest.argmin(1), len(rooms)) * torch.isfinite(nearest)
    return rooms.T * of_parts / (total + usual).clamp_min(1e-9), possible * unknown


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
