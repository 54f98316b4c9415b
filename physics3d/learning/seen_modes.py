"""How the modes of a body look in a clip: the flow of the clip in terms of the basis of the solver without a grid.

Small displacements of a body are u(X) = sum_j s_j(X) q_j (`modes/model.py`); a camera sees the visible point X(x) of
pixel x move by

    u(t, x) = J(x) (q(t) - q(t_0)) [px],    J = d(projection)/dX at X(x), times s_j(X(x))

from the frame t_0 in which the body is where its Gaussians are. All that a fit needs of the clip are the sums over
pixels, weighted by how far the flow can be trusted (`motion/flow.py`),

    G(t) = sum_x w J^T J,     b(t) = sum_x w J^T u,     e(t) = sum_x w |u|^2
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from torch import Tensor

from physics3d.filling.body import Body
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import rasterize
from physics3d.motion.flow import flow_from, trust_from
from physics3d.motion.flow_about import REACH, flow_about

MOST_PIXELS = 6000  # that are looked at: flow is smooth over its patches
FADE = 4.0  # over which the motion fades out beyond the outline [px]


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What a camera sees of a body's basis of m amplitudes."""

    thing: Bool[np.ndarray, "h w"]  # pixels in which the moving body is seen
    pixel: Int[np.ndarray, "n 2"]  # row and column of those that are looked at
    jacobian: Float[np.ndarray, "n 2 m"]  # J [px per m]

    def displacement(self, q: Float[np.ndarray, " m"], *, fade: float = FADE) -> Float[np.ndarray, "h w 2"]:
        """What the amplitudes [m] move every pixel by [px]; beyond the outline that of the nearest pixel fades out,
        over `fade` [px]."""
        nearest, away = self._spread
        return (self.jacobian @ q).astype(np.float32)[nearest] * np.exp(-((away / fade) ** 2))

    @cached_property
    def gram(self) -> Float[np.ndarray, "m m"]:
        """Sum over the pixels that are looked at of J^T J [px^2 per m^2]."""
        return _gram(self.jacobian.reshape(-1, self.jacobian.shape[-1]))

    @cached_property
    def _spread(self) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w 1"]]:
        """(number of the pixel looked at that is nearest to each pixel, how far each is from the outline [px])."""
        number = np.full(self.thing.shape, -1)
        number[tuple(self.pixel.T)] = np.arange(len(self.pixel))
        nearest = ndimage.distance_transform_edt(number < 0, return_distances=False, return_indices=True)
        away = ndimage.distance_transform_edt(~self.thing)
        return number[tuple(nearest)], away[..., None].astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Observed:
    """The sums of a clip, frame by frame, in pixels."""

    gram: Float[np.ndarray, "t m m"]  # G
    right: Float[np.ndarray, "t m"]  # b
    square: Float[np.ndarray, " t"]  # e
    weight: Float[np.ndarray, " t"]  # sum_x w
    fps: float  # [1/s]

    def window(self, first: int, end: int) -> "Observed":
        """Frames first to end - 1."""
        part = {name: getattr(self, name)[first:end] for name in ("gram", "right", "square", "weight")}
        return Observed(**part, fps=self.fps)


def sight(gaussians: Gaussians, body: Body, camera: Camera, basis: Float[np.ndarray, "p r"]) -> Sight:
    """`basis`: values of the functions at the body's particles. Raises ValueError if the camera sees none of it."""
    moving = torch.zeros(len(gaussians))
    moving[body.embedding.which] = 1.0
    with torch.no_grad():
        drawn = rasterize(
            gaussians.mean,
            gaussians.covariance(),
            gaussians.opacity,
            moving[:, None].expand(-1, 3).contiguous(),
            camera,
            background=(0.0, 0.0, 0.0),
            median=True,
        )
    assert drawn.median is not None
    thing = ((drawn.color[..., 0] > 0.5) & (drawn.median > 0)).numpy()
    if not thing.any():
        raise ValueError("the camera of the take does not see the thing; check its mask and the camera's place")
    pixel = np.argwhere(thing)
    pixel = pixel[:: max(1, len(pixel) // MOST_PIXELS)]
    origin, ray = camera.rays(torch.float64)
    at = tuple(torch.from_numpy(pixel.T))
    point = origin + ray[at] * drawn.median[at].double()[:, None]
    tie = embed(point.float(), torch.arange(len(point)), body.position, body.spacing)
    values = np.einsum("nk,nkr->nr", tie.weights.numpy(), basis[tie.neighbours.numpy()])
    local = point @ camera.world_to_camera[:3, :3].double().T + camera.world_to_camera[:3, 3].double()
    x, y, z = local.T
    zero = torch.zeros_like(z)
    seen = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * x / z**2], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * y / z**2], -1),
        ],
        1,
    )
    slope = (seen @ camera.world_to_camera[:3, :3].double()).numpy()
    jacobian = np.einsum("nr,nci->ncri", values, slope).reshape(len(pixel), 2, -1)
    return Sight(thing=thing, pixel=pixel, jacobian=jacobian)


Look = tuple[Observed, Float[np.ndarray, "t h w 2"], Float[np.ndarray, "t n"]]


def observe(sight: Sight, frames: UInt8[Tensor, "t h w 3"], fps: float, *, reference: UInt8[Tensor, "h w 3"]) -> Look:
    """(the sums of the frames, the flow, the weight of the pixels of the sight) from the picture `reference`, in which
    the body is where its Gaussians are."""
    return _summed(sight, frames, fps, reference, flow_from(reference, frames))


def observe_again(
    sight: Sight,
    frames: UInt8[Tensor, "t h w 3"],
    fps: float,
    *,
    reference: UInt8[Tensor, "h w 3"],
    seen: Float[np.ndarray, "t h w 2"],
    places: Float[np.ndarray, "k m"],
) -> Look:
    """The same, once the first look, the flow `seen`, has told where the body is in the last k frames: flow that began
    from nothing loses a part of what moves wide and is thin. `places`: amplitudes since the picture [m]."""
    first = len(frames) - len(places)
    guess = np.stack([sight.displacement(q, fade=REACH) for q in places])
    u = np.concatenate([seen[:first], flow_about(guess, reference, frames[first:])])
    return _summed(sight, frames, fps, reference, u)


def _summed(
    sight: Sight,
    frames: UInt8[Tensor, "t h w 3"],
    fps: float,
    reference: UInt8[Tensor, "h w 3"],
    u: Float[np.ndarray, "t h w 2"],
) -> Look:
    weight = trust_from(reference, frames, u)
    i, j = sight.pixel.T
    W, U, J = weight[:, i, j].astype(float), u[:, i, j].astype(float), sight.jacobian
    flat = J.reshape(-1, J.shape[-1])
    observed = Observed(
        gram=np.stack([_gram(np.sqrt(np.repeat(w, 2))[:, None] * flat) for w in W]),
        right=(W[..., None] * U).reshape(len(U), -1) @ flat,
        square=(W[..., None] * U**2).sum((1, 2)),
        weight=W.sum(1),
        fps=fps,
    )
    return observed, u, W


def _gram(A: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "m m"]:
    """A^T A; NumPy sees that both are one matrix and computes half of it."""
    return A.T @ A
