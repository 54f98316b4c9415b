"""The pose of a camera, refined by a picture that it took, against Gaussians that know the place.

    X_c = exp([w]) (M X - p) + p + d v      w [rad], v: a turn about p, and a shift; p lies d [m] ahead of the camera,
                                            in the middle of what is seen
    minimise over w, v   the mean over still pixels of  huber(g C(w, v) + b - I)

C is drawn, I the picture, both in 0..1. Gain g and offset b of each channel follow by least squares in every step: a
video's exposure and white balance are not those of the photographs. Turns about p hardly move the picture's middle, so
that turn and shift stay apart. From a quarter of the pixels along each side to all of them, by L-BFGS with the
renderer's gradient of the pose.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render

SCALES = (0.25, 0.5, 1.0)  # of the pixels along each side
STEPS = 15  # of L-BFGS at each scale
NOISE = 0.02  # residual above which the loss grows linearly: what is not in the model counts little
LEAST = 0.02  # share of the pixels that must stand still


@dataclass(frozen=True, kw_only=True)
class Registered:
    camera: Camera
    moved: float  # what the middle of the scene moved by in the picture [px]
    before: float  # rms residual over still pixels, 0..1, by the camera that was given
    after: float  # ... and by the one that was found


def register(
    gaussians: Gaussians,
    camera: Camera,
    picture: UInt8[Tensor, "h w 3"],
    still: Bool[Tensor, "h w"],
    *,
    background: tuple[float, float, float],
) -> Registered:
    """The camera whose render is nearest to the picture where it is `still`.

    Raises ValueError if too little stands still, or nothing is drawn there.
    """
    if tuple(picture.shape[:2]) != (camera.height, camera.width):
        raise ValueError(
            f"the picture has {picture.shape[1]} x {picture.shape[0]} px, its camera {camera.width} x {camera.height}; "
            "scale the camera"
        )
    if float(still.float().mean()) < LEAST:
        raise ValueError(
            f"only {100 * float(still.float().mean()):.1f} % of the picture stand still, at least {100 * LEAST:g} % "
            "are needed to refine its camera; step back when you film"
        )
    device = gaussians.mean.device
    picture, still = picture.to(device), still.to(device)
    with torch.no_grad():
        drawn = render(gaussians, camera, background=background)
    seen = still & (drawn.alpha > 0.5)
    if not bool(seen.any()):
        raise ValueError("nothing of the model is seen where the picture stands still; the camera looks elsewhere")
    d = float(drawn.depth[seen].median())
    before = _residual(gaussians, camera, picture, still, background)
    found = camera
    for scale in SCALES:
        found = _nearer(gaussians, found, picture, still, background, scale, d)
    after = _residual(gaussians, found, picture, still, background)
    if not after < before:
        return Registered(camera=camera, moved=0.0, before=before, after=before)
    middle = torch.tensor([[0.0, 0.0, d]], dtype=torch.float64) - camera.world_to_camera[:3, 3]
    middle = middle @ camera.world_to_camera[:3, :3]
    moved = float((found.project(middle)[0] - camera.project(middle)[0]).norm())
    return Registered(camera=found, moved=moved, before=before, after=after)


def _nearer(gaussians, camera: Camera, picture, still, background, scale: float, d: float) -> Camera:
    """One scale of the search."""
    small = camera.scaled(scale)
    target, weight = _reduced(picture, still, small)
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [xi], max_iter=STEPS, history_size=6, line_search_fn="strong_wolfe", tolerance_grad=1e-9, tolerance_change=1e-12
    )

    def loss() -> Tensor:
        optimizer.zero_grad()
        color = render(gaussians, _turned(small, xi, d), background=background).color
        value = (weight * _huber(_exposed(color, target, weight) - target)).sum() / weight.sum()
        value.backward()
        return value

    optimizer.step(loss)
    return replace(camera, world_to_camera=_turned(camera, xi.detach(), d).world_to_camera)


def _turned(camera: Camera, xi: Float[Tensor, "6"], d: float) -> Camera:
    w, v = xi[:3], xi[3:]
    zero = torch.zeros_like(w[0])
    skew = torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
    R = torch.linalg.matrix_exp(skew)
    p = torch.tensor([0.0, 0.0, d], dtype=xi.dtype)
    top = torch.cat([R, (p - R @ p + d * v)[:, None]], 1)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=xi.dtype)
    return replace(camera, world_to_camera=torch.cat([top, last]) @ camera.world_to_camera)


def _reduced(picture, still, camera: Camera) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """The picture in 0..1 and the weight of its pixels, at a camera's size; what moves spoils the pixels it reaches."""
    size = (camera.height, camera.width)
    shrunk = torch.nn.functional.interpolate(picture.permute(2, 0, 1)[None].float() / 255, size, mode="area")
    weight = torch.nn.functional.interpolate(still[None, None].float(), size, mode="area")
    return shrunk[0].permute(1, 2, 0), (weight[0, 0] > 0.999).float()[..., None]


def _exposed(color: Float[Tensor, "h w 3"], target, weight) -> Float[Tensor, "h w 3"]:
    """g C + b by weighted least squares per channel; g and b are constants of the gradient, as at their optimum."""
    with torch.no_grad():
        total = weight.sum()
        c, i = (weight * color).sum((0, 1)) / total, (weight * target).sum((0, 1)) / total
        variance = (weight * (color - c) ** 2).sum((0, 1))
        gain = (weight * (color - c) * (target - i)).sum((0, 1)) / variance.clamp_min(1e-12)
        offset = i - gain * c
    return gain * color + offset


def _huber(x: Tensor) -> Tensor:
    return torch.nn.functional.huber_loss(x, torch.zeros_like(x), reduction="none", delta=NOISE)


def _residual(gaussians, camera: Camera, picture, still, background) -> float:
    target, weight = _reduced(picture, still, camera)
    with torch.no_grad():
        color = render(gaussians, camera, background=background).color
        off = _exposed(color, target, weight) - target
    return float(((weight * off**2).sum() / (3 * weight.sum())).sqrt())
