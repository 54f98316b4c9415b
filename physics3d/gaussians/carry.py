"""Gaussians carried by particles: each extrapolates its own motion to the Gaussian, and these are blended.

    F_g = sum_j w_j F_j,   x_g = sum_j w_j (x_j + 1/2 (F_j + F_g) (X_g - X_j)),   Sigma = F_g Sigma_0 F_g^T

with the weights of `embedding.py`. F is the total deformation gradient, so plastic flow shows. The mean of both ends' F
is the trapezoidal rule along the way from X_j to X_g. An affine motion is carried exactly, a smooth one with an error
of third order in the spacing (F_g of second). Spherical harmonics turn with the body: the viewing direction is taken
back by R^T, F = R S.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.embedding import Embedding
from physics3d.gaussians.model import Gaussians


def carry(
    gaussians: Gaussians,
    embedding: Embedding,
    X: Float[Tensor, "p 3"],
    x: Float[Tensor, "p 3"],
    F: Float[Tensor, "p 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"], Float[Tensor, "n 3 3"] | None]:
    """Means [m], covariances [m^2] and rotations of all Gaussians when particles went from X to x [m] with total F.

    Differentiable in x and F, in the precision of x. Gaussians that are not embedded stay as they are. Rotations are
    None where nothing depends on the viewing direction.
    """
    which, near = embedding.which.to(x.device), embedding.neighbours.to(x.device)
    w = embedding.weights.to(x)
    mean, covariance = gaussians.mean.to(x), gaussians.covariance().to(x)
    F_near = F[near]
    F_g = torch.einsum("gk,gkij->gij", w, F_near)
    way = mean[which, None] - X.to(x)[near]
    moved = torch.einsum("gk,gki->gi", w, x[near] + 0.5 * torch.einsum("gkij,gkj->gki", F_near + F_g[:, None], way))
    rotation = None
    if gaussians.sh.shape[1] > 1:
        rotation = torch.eye(3).to(x).expand(len(mean), 3, 3).index_copy(0, which, _Rotation.apply(F_g))
    turned = F_g @ covariance[which] @ F_g.mT
    return mean.index_copy(0, which, moved), covariance.index_copy(0, which, turned), rotation


class _Rotation(torch.autograd.Function):
    """R of the polar decomposition F = R S, S = V diag(s) V^T, det R = 1.

    dR = R [omega], (tr(S) I - S) omega = axial(R^T dF - dF^T R): the adjoint divides by s_j + s_k only, so that F = I,
    where the derivative of an SVD is 0/0, is an ordinary point. s_j + s_k is held above 1e-6 (inverted, undecided).
    """

    @staticmethod
    def forward(ctx, F):
        U, s, Vt = torch.linalg.svd(F)
        sign = torch.det(U @ Vt)
        U = torch.cat([U[..., :2], U[..., 2:] * sign[:, None, None]], -1)
        s = torch.cat([s[:, :2], s[:, 2:] * sign[:, None]], -1)
        R = U @ Vt
        ctx.save_for_backward(R, s, Vt)
        return R

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, R_bar):
        R, s, Vt = ctx.saved_tensors
        M = R.mT @ R_bar
        u = torch.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], -1)
        y = torch.einsum("nij,nj->ni", Vt, u) / (s.sum(-1, keepdim=True) - s).clamp_min(1e-6)
        y = torch.einsum("nji,nj->ni", Vt, y)
        zero = torch.zeros_like(y[:, 0])
        cross = torch.stack([zero, -y[:, 2], y[:, 1], y[:, 2], zero, -y[:, 0], -y[:, 1], y[:, 0], zero], -1)
        return R @ cross.reshape(-1, 3, 3)
