"""Masks -> one label per Gaussian: the label whose pixels it contributes most to, summed over views.

    A_k = sum over views and pixels of label k of t (blending weight of the Gaussian),   label = argmax_k A_k

which minimises sum t |rendered label - mask| in closed form, because rendering is linear in the labels (Shen et al.
2024, "FlashSplat", with t = 1). Here t is small next to outlines, across which Gaussians show: else the rim of a body,
and what barely shows beside it, would take the wrong side. A Gaussian that shows nowhere takes its neighbours' label.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import contribution

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
