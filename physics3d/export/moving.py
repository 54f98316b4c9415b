"""A scene's Gaussians frame by frame, as a model each: what a program that knows nothing of particles can draw.

    Sigma = F_g Sigma_0 F_g^T = Q diag(s^2) Q^T,   q = quaternion(Q)

`gaussians/carry.py` gives means, covariances and rotations; here a covariance becomes axes and standard deviations
again, and the rotation goes into the spherical harmonics. Which axis of a Gaussian is called the first, and which way
it points, is free: of the 24 ways that keep Q a rotation, the one that turns least from the frame before is taken, and
the sign of q likewise, so that programs may interpolate between frames. What never moves stays as it was, bit by bit.

Gaussians of the inside (`gaussians/interior.py`) are there in every frame, with an opacity of almost nothing where the
body is closed, so that every frame holds the same Gaussians in the same order.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.export.turn import rotate_sh, to_matrix, to_quaternion
from physics3d.gaussians.carry import carry
from physics3d.gaussians.embedding import Embedding
from physics3d.gaussians.interior import OPACITY, Interior
from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.trajectory import Trajectory

UNSEEN = 1e-6  # opacity of what is not to be seen: a logit must be finite, and pictures have 256 levels
THINNEST = 1e-12  # smallest standard deviation [m]: rounding can make a flat Gaussian's variance negative


@dataclass(frozen=True, kw_only=True)
class Moving:
    """Raises ValueError if no Gaussian moves."""

    gaussians: Gaussians  # at rest, all of the scene
    embedding: Embedding
    trajectory: Trajectory
    interior: Interior | None = None  # Gaussians that show where the body opens

    def __post_init__(self) -> None:
        if len(self.embedding.which) == 0:
            raise ValueError("no Gaussian moves with the particles: there is nothing to export; check the segmentation")

    def __len__(self) -> int:
        """Of frames."""
        return len(self.trajectory.position)

    @property
    def count(self) -> int:
        """Of Gaussians in each frame."""
        return len(self.gaussians) + (0 if self.interior is None else len(self.interior.particle))

    @property
    def harmonics(self) -> int:
        """Coefficients per channel."""
        return self.gaussians.sh.shape[1]

    def frames(self) -> Iterator[Gaussians]:
        """Every frame in order, on the CPU."""
        axes = None
        for i in range(len(self)):
            frame, axes = self._frame(i, axes)
            yield frame

    def frame(self, i: int) -> Gaussians:
        """One frame; its axes are named after those at rest. Raises ValueError if there is no such frame."""
        if not 0 <= i < len(self):
            raise ValueError(f"there is no frame {i}; take one of 0 to {len(self) - 1}")
        return self._frame(i, None)[0]

    def _frame(self, i: int, before: Tensor | None) -> tuple[Gaussians, Float[Tensor, "g 4"]]:
        """The frame, and the quaternions of what moves in it."""
        g, which = self.gaussians, self.embedding.which
        X, x, F = self.trajectory.rest_position, self.trajectory.position[i], self.trajectory.deformation[i]
        mean, covariance, rotation = carry(g, self.embedding, X.double(), x.double(), F.double())
        rest = g.select(which)
        quaternion = torch.nn.functional.normalize(rest.quaternion.double(), dim=1) if before is None else before
        quaternion, deviation = _axes(covariance[which], quaternion)
        sh = g.sh if rotation is None else g.sh.index_copy(0, which, rotate_sh(rest.sh, rotation[which]))
        frame = replace(
            g,
            mean=g.mean.index_copy(0, which, mean[which].to(g.mean)),
            log_scale=g.log_scale.index_copy(0, which, deviation.log().to(g.log_scale)),
            quaternion=g.quaternion.index_copy(0, which, quaternion.to(g.quaternion)),
            sh=sh,
        )
        if self.interior is not None:
            frame = _joined(frame, self._inside(self.interior, X, x))
        return frame, quaternion

    def _inside(self, interior: Interior, X: Tensor, x: Tensor) -> Gaussians:
        """Where the particles are, as opaque as the body is open; round, and of the same colour from everywhere."""
        inner = interior.gaussians
        opacity = (OPACITY * interior.opened(X, x)).clamp_min(UNSEEN)
        sh = torch.nn.functional.pad(inner.sh, (0, 0, 0, self.harmonics - inner.sh.shape[1]))
        return replace(inner, mean=x[interior.particle].to(inner.mean), opacity_logit=opacity.logit(), sh=sh)


def _joined(a: Gaussians, b: Gaussians) -> Gaussians:
    return replace(a, **{name: torch.cat([getattr(a, name), getattr(b, name).to(getattr(a, name))]) for name in FIELDS})


def _axes(
    covariance: Float[Tensor, "g 3 3"], near: Float[Tensor, "g 4"]
) -> tuple[Float[Tensor, "g 4"], Float[Tensor, "g 3"]]:
    """Quaternions, as near to `near` as the freedom in naming axes allows, and standard deviations [m]."""
    variance, Q = torch.linalg.eigh(covariance)
    Q = Q * torch.det(Q).sign()[:, None, None]
    ways = _ways()
    R = to_matrix(near)
    # trace(R^T Q P) grows with the cosine of the angle between R and Q P
    best = torch.einsum("gji,gjk,wki->gw", R, Q, ways).argmax(1)
    q = to_quaternion(Q @ ways[best])
    q = q * torch.where((q * near).sum(1, keepdim=True) < 0, -1.0, 1.0)
    deviation = variance.clamp_min(THINNEST**2).sqrt()
    return q, torch.einsum("gk,gki->gi", deviation, ways[best].abs())


def _ways() -> Float[Tensor, "24 3 3"]:
    """The rotations that carry the axes onto each other."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            P = torch.diag(torch.tensor(signs, dtype=torch.float64))[:, list(order)]
            if torch.det(P) > 0:
                found.append(P)
    return torch.stack(found)
