"""A run that the page shows: the bar of `small_scene`, poked and filmed, its colours those of a direction."""

import torch
from small_scene import DAMPED, DX, POKE, bar, cameras, world

from physics3d.log import Log
from physics3d.scenes.base import Capture, Take
from physics3d.solver import motion_of
from physics3d.view.run import Run


def run(*, frames: int = 12, fps: float = 30.0, degree: int = 1, **changes) -> Run:
    """The bar on its fixed foot, pushed at its top, moved by its modes; a clip of grey pictures, each lighter than the
    last; every tenth Gaussian stands still."""
    gaussians, body = bar()
    torch.manual_seed(0)
    more = 0.3 * torch.randn(len(gaussians), (degree + 1) ** 2 - 1, 3)
    gaussians = changes.pop(
        "gaussians", type(gaussians)(**vars(gaussians) | {"sh": torch.cat([gaussians.sh, more], 1)})
    )
    of = changes.pop("world", world(DAMPED))
    moved = motion_of(of, body.position, body.volume, excitation=POKE, device="cpu", log=Log(None))
    parameters = of.estimate().parameters
    with torch.no_grad():
        trajectory = moved(parameters, frames=frames, frame_dt=1 / fps, log=Log(None))
    grey = torch.linspace(50, 200, frames).to(torch.uint8)
    clip = grey[:, None, None, None].expand(frames, 40, 48, 3).contiguous()
    take = Take(name="poke", role="evaluate", fps=fps, cameras=cameras(), videos=(clip,), excitation=POKE)
    capture = Capture(name="bar", images=(), cameras=(), names=(), gaussians=gaussians, takes=(take,))
    return Run(
        name="bar",
        world=of,
        capture=capture,
        gaussians=gaussians,
        body=body,
        parameters=parameters,
        trajectory=trajectory,
    )


__all__ = ["DX", "run"]
