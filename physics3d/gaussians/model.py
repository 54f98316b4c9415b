"""The 3D Gaussian model (Kerbl et al. 2023): what is stored, and how it becomes means, covariances and opacities.

Sigma = R(q) diag(exp(2 log_scale)) R(q)^T [m^2],   opacity = sigmoid(opacity_logit)
"""

from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite


@dataclass(frozen=True, kw_only=True)
class Gaussians(AbstractArtifact):
    """A model of n 3D Gaussians, as it is stored and optimised. Lengths in metres."""

    mean: Float[Tensor, "n 3"]  # [m]
    log_scale: Float[Tensor, "n 3"]  # ln of the standard deviations [ln m]
    quaternion: Float[Tensor, "n 4"]  # w, x, y, z; need not be normalised
    opacity_logit: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]  # real spherical harmonics, k = (degree + 1)^2, 3DGS order and constants

    def __len__(self) -> int:
        return len(self.mean)

    def check(self) -> None:
        n = len(self.mean)
        if n == 0:
            raise ValueError("Gaussians: no Gaussian at all; the reconstruction or the file is empty")
        shapes = {"mean": (n, 3), "log_scale": (n, 3), "quaternion": (n, 4), "opacity_logit": (n,)}
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"Gaussians.{name} has shape {tuple(getattr(self, name).shape)}, expected {shape}")
        if self.sh.ndim != 3 or len(self.sh) != n or self.sh.shape[1] not in (1, 4, 9, 16) or self.sh.shape[2] != 3:
            raise ValueError(f"Gaussians.sh has shape {tuple(self.sh.shape)}, expected ({n}, 1|4|9|16, 3)")
        for name in (*shapes, "sh"):
            require_finite(f"Gaussians.{name}", getattr(self, name))

    @property
    def opacity(self) -> Float[Tensor, " n"]:
        return torch.sigmoid(self.opacity_logit)

    def rotation(self) -> Float[Tensor, "n 3 3"]:
        w, x, y, z = torch.nn.functional.normalize(self.quaternion, dim=-1).unbind(-1)
        rows = [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]  # fmt: skip
        return torch.stack(rows, -1).reshape(-1, 3, 3)

    def covariance(self) -> Float[Tensor, "n 3 3"]:
        """Sigma [m^2]."""
        a, b, c = (self.rotation() * torch.exp(self.log_scale)[:, None, :]).unbind(1)
        # row by row: a batch of 3 x 3 products takes three times as long on a CPU
        aa, ab, ac, bb, bc, cc = ((u * v).sum(-1) for u, v in ((a, a), (a, b), (a, c), (b, b), (b, c), (c, c)))
        return torch.stack([aa, ab, ac, ab, bb, bc, ac, bc, cc], -1).reshape(-1, 3, 3)

    def select(self, which: Tensor) -> Self:
        """The Gaussians of an index or boolean mask."""
        return replace(self, **{name: getattr(self, name)[which] for name in FIELDS})

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Self:
        return replace(self, **{name: getattr(self, name).to(device=device, dtype=dtype) for name in FIELDS})


FIELDS = ("mean", "log_scale", "quaternion", "opacity_logit", "sh")
