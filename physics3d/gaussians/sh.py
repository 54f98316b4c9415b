"""Real spherical harmonics up to degree 3: colour by viewing direction, in 3DGS's order and constants.

color(d) = max(1/2 + sum_k sh_k Y_k(d), 0),   d a unit vector from the camera to the Gaussian
"""

import torch
from jaxtyping import Float
from torch import Tensor

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def sh_basis(direction: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "n count"]:
    """The first `count` (1, 4, 9 or 16) harmonics at unit directions."""
    x, y, z = direction.unbind(-1)
    Y = [torch.full_like(x, C0)]
    if count > 1:
        Y += [-C1 * y, C1 * z, -C1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        Y += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if count > 9:
        Y += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(Y, -1)


def sh_color(sh: Float[Tensor, "n k 3"], direction: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colour seen along `direction` (camera to Gaussian, any length). Raises ValueError unless k is 1, 4, 9 or 16."""
    if sh.shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"sh has {sh.shape[1]} coefficients per channel; degrees 0 to 3 have 1, 4, 9 or 16")
    unit = torch.nn.functional.normalize(direction, dim=-1)
    return (0.5 + torch.einsum("nk,nkc->nc", sh_basis(unit, sh.shape[1]), sh)).clamp_min(0)
