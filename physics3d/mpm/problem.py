"""What one rollout is asked to do, checked and put in order: body, region, boundaries, frames."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from physics3d.artifact import require_finite
from physics3d.boundaries.base import AbstractBoundary, Setting, Vector
from physics3d.log import Log
from physics3d.world import World


@dataclass(frozen=True, kw_only=True)
class Problem:
    """All of it that carries no gradient. Arrays over particles are in the caller's order but for `order`."""

    world: World
    setting: Setting
    boundaries: tuple[AbstractBoundary, ...]  # of the world and of this rollout
    widths: tuple[int, ...]  # how many parameters each of them has
    order: Tensor  # [p] the caller's number of each particle of the solver
    frames: int
    frame_dt: float  # [s]
    device: str
    threads: int | None
    log: Log

    def corners(self) -> str:
        """The region, for a message."""
        corners = (self.setting.lower, self.setting.upper)
        return " .. ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in corners) + " m"


def check_inputs(
    position: Tensor,
    volume: Tensor,
    velocity: Tensor | None,
    boundaries: tuple[AbstractBoundary, ...],
    frames: int,
    frame_dt: float,
) -> None:
    """Raise ValueError naming what cannot be right, its value and the remedy."""
    n = len(position)
    if n == 0 or position.shape != (n, 3):
        raise ValueError(f"position has shape {tuple(position.shape)}; take [p, 3] with at least one particle")
    if volume.shape != (n,):
        raise ValueError(f"volume has shape {tuple(volume.shape)}; take one per particle, [{n}]")
    require_finite("position", position)
    require_finite("volume", volume)
    if not bool((volume > 0).all()):
        raise ValueError(
            f"volume of {int((volume <= 0).sum())} of {n} particles is not above 0 m^3; drop those particles"
        )
    if velocity is not None:
        require_finite("velocity", velocity)
        if velocity.shape not in ((3,), (n, 3)):
            raise ValueError(f"velocity has shape {tuple(velocity.shape)}; take [3] or [{n}, 3]")
    if frames < 1:
        raise ValueError(f"frames is {frames}; take at least 1 (frame 0 is the initial state)")
    if not (0 < frame_dt < math.inf):
        raise ValueError(f"frame_dt is {frame_dt} s; take a time above 0")
    for boundary in boundaries:
        boundary.check()


def region(world: World, position: Tensor, velocity: Tensor, duration: float) -> tuple[Vector, Vector]:
    """Corners of the simulated region. Automatic: the body's own extent around it, and the way it falls or flies in
    `duration` [s]. Raises ValueError if the body is not in the region that the world gives."""
    x = position.detach().double().cpu()
    low, high = x.amin(0), x.amax(0)
    if world.lower is not None and world.upper is not None:
        lower, upper = x.new_tensor(world.lower), x.new_tensor(world.upper)
        outside = int(((x < lower) | (x > upper)).any(1).sum())
        if outside:
            raise ValueError(
                f"{outside} of {len(x)} particles are outside the simulated region {world.lower} .. {world.upper} m at "
                "the start; enlarge world.lower and world.upper or move the body"
            )
        return tuple(lower.tolist()), tuple(upper.tolist())
    v = velocity.detach().double().cpu().reshape(-1, 3)
    half_g = 0.5 * x.new_tensor(world.gravity) * duration**2
    room = float((high - low).max()) + 4 * world.dx
    low = torch.minimum(low, low + v.amin(0) * duration + half_g) - room
    high = torch.maximum(high, high + v.amax(0) * duration + half_g) + room
    # nodes at whole multiples of dx, so that a floor at z = 0 lies on nodes
    return (
        tuple(((low / world.dx).floor() * world.dx).tolist()),
        tuple(((high / world.dx).ceil() * world.dx).tolist()),
    )


def sorted_by_cell(position: Tensor, dx: float) -> Tensor:
    """Permutation that puts particles of a cell, and then of a row and of a layer of cells, next to each other:
    neighbours in space are neighbours in memory."""
    cell = (position / dx).floor().long()
    cell = cell - cell.amin(0)
    size = cell.amax(0) + 1
    return torch.argsort((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], stable=True)
