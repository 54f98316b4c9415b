"""The rasteriser of gsplat (Ye et al. 2024) in the clothes of ours: CUDA only, where gsplat is installed.

gsplat has the same equations: low pass 0.3 px^2, near plane 0.01 m, alpha from 1/255 to 0.999, Jacobian held constant
outside a margin of 15 %. It stops before the Gaussian that takes the transmittance below 1e-4, we after it: 1e-4 of a
colour.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.rasterize import Rendered, check
from physics3d.gaussians.splat import LOW_PASS, NEAR


def rasterize_with_gsplat(
    mean: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    opacity: Float[Tensor, " n"],
    color: Float[Tensor, "n 3"],
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
    antialiased: bool = False,
    median: bool = False,
) -> Rendered:
    """Same arguments and result as `rasterize`. Raises ValueError without CUDA, without gsplat, or for `median`."""
    if median:
        raise ValueError("gsplat has no median depth of 3D Gaussians; draw with physics3d's rasterize")
    if not mean.is_cuda:
        raise ValueError(f"gsplat draws on CUDA only and the Gaussians are on {mean.device}; draw with rasterize")
    try:
        from gsplat import rasterization
    except ImportError as reason:
        raise ValueError("gsplat is not installed; pip install gsplat, or draw with rasterize") from reason
    check(mean, covariance, opacity, color)
    mean, covariance, opacity, color = (a.float() for a in (mean, covariance, opacity, color))
    K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], device=mean.device)
    picture, alpha, _ = rasterization(
        means=mean,
        quats=None,
        scales=None,
        covars=covariance,
        opacities=opacity,
        colors=color,
        viewmats=camera.world_to_camera.to(mean)[None],
        Ks=K[None],
        width=camera.width,
        height=camera.height,
        near_plane=NEAR,
        eps2d=LOW_PASS,
        backgrounds=torch.as_tensor(background).to(mean)[None],
        render_mode="RGB+ED",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return Rendered(color=picture[0, ..., :3], alpha=alpha[0, ..., 0], depth=picture[0, ..., 3])
