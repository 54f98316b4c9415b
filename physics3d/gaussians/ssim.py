"""Structural similarity of two pictures (Wang et al. 2004), differentiable; 11 x 11 Gaussian window of 1.5 px.

SSIM = (2 mx my + c1)(2 sxy + c2) / ((mx^2 + my^2 + c1)(sx^2 + sy^2 + c2)),   c1 = 0.01^2, c2 = 0.03^2, colours in 0..1
"""

import torch
from jaxtyping import Float
from torch import Tensor

C1, C2 = 0.01**2, 0.03**2
RADIUS, WIDTH = 5, 1.5  # of the window [px]


def ssim(x: Float[Tensor, "h w c"], y: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean SSIM over the pixels whose window lies inside. Raises ValueError if the pictures are smaller than 11 px."""
    if x.shape != y.shape or min(x.shape[:2]) <= 2 * RADIUS:
        raise ValueError(
            f"ssim: pictures {tuple(x.shape)} and {tuple(y.shape)} must be equal and at least 11 px a side"
        )
    x, y = x.permute(2, 0, 1), y.permute(2, 0, 1)
    mx, xx, xy = _blur(torch.cat([x, x * x, x * y])).chunk(3)
    my, yy = _blur(torch.cat([y, y * y])).chunk(2)
    structure = (2 * (xy - mx * my) + C2) / (xx - mx * mx + yy - my * my + C2)
    return (structure * (2 * mx * my + C1) / (mx * mx + my * my + C1)).mean()


def _blur(maps: Float[Tensor, "c h w"]) -> Float[Tensor, "c h-10 w-10"]:
    offset = torch.arange(-RADIUS, RADIUS + 1).to(maps)
    window = torch.exp(-0.5 * (offset / WIDTH) ** 2)
    window = (window / window.sum()).expand(len(maps), 1, 1, -1)
    across = torch.nn.functional.conv2d(maps[None], window, groups=len(maps))
    return torch.nn.functional.conv2d(across, window.mT, groups=len(maps))[0]
