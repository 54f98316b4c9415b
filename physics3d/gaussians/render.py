"""Gaussians and a camera -> a picture."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import Rendered, rasterize
from physics3d.gaussians.sh import sh_color


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
    antialiased: bool = False,
    median: bool = False,
    draw: Callable[..., Rendered] = rasterize,
) -> Rendered:
    """Draw the model as it is; differentiable in all its fields, the background and the camera's pose.

    `draw` is `rasterize`, `twin.rasterize_plainly` or `with_gsplat.rasterize_with_gsplat`; `median` asks for the median
    depth. Raises ValueError on non-finite numbers.
    """
    color = sh_color(gaussians.sh, gaussians.mean - camera.centre.to(gaussians.mean))
    arrays = (gaussians.mean, gaussians.covariance(), gaussians.opacity, color)
    return draw(*arrays, camera, background=background, antialiased=antialiased, median=median)
