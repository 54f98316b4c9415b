"""Gaussians turned as a rigid body: means, axes, and the colours that depend on the viewing direction.

    m -> R m,   Sigma -> R Sigma R^T,   color(d) -> color(R^T d)

In the harmonics of one degree, Y(R^T d) is again a combination of Y(d): its coefficients follow from the values at more
directions d_i than there are harmonics, without error but rounding:

    sh'_k = sum_l D_kl sh_l,   D = Y(d)^+ Y(R^T d)

Our renderer turns the direction instead (`gaussians/carry.py`); files can only hold coefficients.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.sh import sh_basis

DIRECTIONS = 32  # twice the harmonics of degree 3
CHUNK = 4096  # Gaussians at once: 16 MB of harmonics


def turned(gaussians: Gaussians, R: Float[Tensor, "3 3"]) -> Gaussians:
    """All of them, turned by R about the origin; in the precision of the Gaussians."""
    R = R.to(gaussians.mean)
    every = R.expand(len(gaussians), 3, 3)
    return replace(
        gaussians,
        mean=gaussians.mean @ R.T,
        quaternion=to_quaternion(R @ gaussians.rotation()).to(gaussians.quaternion),
        sh=rotate_sh(gaussians.sh, every),
    )


def rotate_sh(sh: Float[Tensor, "n k 3"], R: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients of d -> color(R^T d), one rotation each."""
    if sh.shape[1] == 1:
        return sh
    d = _directions().to(sh)
    inverse = torch.linalg.pinv(sh_basis(d, sh.shape[1]))  # [k, m]
    parts = []
    for some, R_some in zip(sh.split(CHUNK), R.to(sh).split(CHUNK)):
        looked = torch.einsum("nji,mj->nmi", R_some, d)  # R^T d
        Y = sh_basis(looked.flatten(0, 1), sh.shape[1]).unflatten(0, looked.shape[:2])
        parts.append(torch.einsum("km,nml,nlc->nkc", inverse, Y, some))
    return torch.cat(parts)


def to_quaternion(R: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """w, x, y, z of rotations, float64 on the CPU."""
    from scipy.spatial.transform import Rotation

    xyzw = torch.from_numpy(Rotation.from_matrix(R.detach().cpu().double().numpy()).as_quat())
    return xyzw[:, [3, 0, 1, 2]]


def to_matrix(quaternion: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotations of w, x, y, z, which need not be normalised; float64 on the CPU."""
    from scipy.spatial.transform import Rotation

    wxyz = quaternion.detach().cpu().double().numpy()
    return torch.from_numpy(Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix())


def _directions() -> Float[Tensor, "m 3"]:
    """Spread evenly over the sphere, on a spiral of the golden angle."""
    i = torch.arange(DIRECTIONS, dtype=torch.float64)
    z, phi = 1 - (2 * i + 1) / DIRECTIONS, i * torch.pi * (3 - 5**0.5)
    r = (1 - z * z).sqrt()
    return torch.stack([r * phi.cos(), r * phi.sin(), z], -1)
