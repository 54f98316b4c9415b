"""Labels of Gaussians -> what they say of the pixels of another view: the share of each that belongs to a part.

What the views so far say of a Gaussian, and what may be added where they said little, are beliefs in 0..1; drawn, they
are shares of pixels.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import rasterize
from physics3d.segmentation.lift import NEGLIGIBLE, lift


def shares(gaussians: Gaussians, belief: Float[Tensor, "n k"], camera: Camera) -> Float[np.ndarray, "k h w"]:
    """Share of each pixel (0..1) that belongs to each of k parts, when `belief` of each Gaussian does."""
    covariance, drawn = gaussians.covariance(), []
    for three in torch.nn.functional.pad(belief, (0, -belief.shape[1] % 3)).to(gaussians.mean).split(3, 1):
        with torch.no_grad():
            picture = rasterize(
                gaussians.mean, covariance, gaussians.opacity, three, camera, background=(0.0, 0.0, 0.0)
            )
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
