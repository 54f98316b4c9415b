"""Gaussians and a camera -> a picture."""

from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import Rendered, rasterize
from physics3d.gaussians.sh import sh_color


def render(
    gaussians: Gaussians, camera: Camera, *, background: Float[Tensor, " 3"] | tuple[float, float, float]
) -> Rendered:
    """Draw the model as it is; differentiable in all its fields. Raises ValueError on non-finite numbers."""
    color = sh_color(gaussians.sh, gaussians.mean - camera.centre.to(gaussians.mean))
    return rasterize(gaussians.mean, gaussians.covariance(), gaussians.opacity, color, camera, background=background)
