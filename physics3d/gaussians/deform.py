"""Gaussians carried by particles: the nearest particles extrapolate each its own motion, and these are blended.

    F_g = sum_j w_j F_j,   x_g = sum_j w_j (x_j + 1/2 (F_j + F_g) (X_g - X_j)),   Sigma = F_g Sigma_0 F_g^T
    sum_j w_j = 1,   sum_j w_j X_j = X_g where the particles allow it

F is the total deformation gradient, so plastic flow shows. The weights are those of moving least squares: a bell
exp(-|X_g - X_j|^2 / (2 spacing^2)), made linear-exact. The mean of both ends' F is the trapezoidal rule along the way
from X_j to X_g. An affine motion is carried exactly, a smooth one with an error of third order in the spacing (F_g of
second). Particles of another part, or beyond a gap, carry nothing. Spherical harmonics turn with the body: the viewing
direction is taken back by R^T, F = R S.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.interior import Interior
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import Rendered, rasterize, tiles_of, window
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import sh_color

NEIGHBOURS = 8
CANDIDATES = 20  # nearest particles among which those are sought
GAP = 1.75  # particles farther apart are not neighbours [spacings]; the diagonal of a cell of the lattice is 1.73


@dataclass(frozen=True, kw_only=True)
class Embedding(AbstractArtifact):
    """Which Gaussians move, and with which particles."""

    which: Int[Tensor, " g"]  # index into Gaussians
    neighbours: Int[Tensor, "g k"]  # index into the particles
    weights: Float[Tensor, "g k"]  # each row sums to 1; a few are below 0 where a Gaussian lies outside its particles

    def check(self) -> None:
        g = len(self.which)
        if self.neighbours.shape != self.weights.shape or self.neighbours.ndim != 2 or len(self.neighbours) != g:
            raise ValueError(
                f"Embedding: neighbours {tuple(self.neighbours.shape)} and weights {tuple(self.weights.shape)} "
                f"must both be ({g}, k); build it with embed()"
            )
        require_finite("Embedding.weights", self.weights)
        if g and ((self.weights.sum(-1) - 1).abs().max() > 1e-5 or self.neighbours.min() < 0 or self.which.min() < 0):
            raise ValueError("Embedding: weights must sum to 1 in every row and indices be >= 0; build it with embed()")


def embed(
    position_of_gaussians: Float[Tensor, "g 3"],
    which: Int[Tensor, " g"],
    particle_position: Float[Tensor, "p 3"],
    spacing: float,
    *,
    parts: tuple[Int[Tensor, " g"], Int[Tensor, " p"]] | None = None,
) -> Embedding:
    """Tie each Gaussian to its (at most 8) nearest particles in the rest state [m]; `spacing` of the particles [m].

    `parts` of the Gaussians and of the particles: a Gaussian is carried by its own part, if that has a particle.
    Raises ValueError if there is no particle, or spacing is not positive.
    """
    from scipy.spatial import cKDTree

    if len(particle_position) == 0:
        raise ValueError("embed: no particles to carry the Gaussians; fill the body first")
    if not spacing > 0:
        raise ValueError(f"embed: spacing is {spacing} m; it must be positive")
    if len(position_of_gaussians) != len(which):
        raise ValueError(f"embed: {len(position_of_gaussians)} positions for {len(which)} indices; must be equal")
    require_finite("embed: position_of_gaussians", position_of_gaussians)
    require_finite("embed: particle_position", particle_position)
    X, points = (a.detach().cpu().double().numpy() for a in (particle_position, position_of_gaussians))
    own, of = (p.cpu().numpy() for p in parts) if parts is not None else (np.zeros(len(points)), np.zeros(len(X)))
    neighbours = np.zeros((len(points), min(NEIGHBOURS, len(X))), np.int64)
    weights = np.zeros(neighbours.shape)
    for part in np.unique(own):
        here, at = np.flatnonzero(own == part), np.flatnonzero(of == part)
        if len(at) == 0:  # nothing of this part was filled
            at = np.arange(len(X))
        tree = cKDTree(X[at])
        k = min(CANDIDATES, len(at))
        distance, near = tree.query(points[here], k=list(range(1, k + 1)))
        linked = _two_steps(tree, GAP * spacing)
        # in the order of distance, those behind a gap last and without weight
        behind = ~np.asarray(linked[near[:, :1].repeat(k, 1).ravel(), near.ravel()], bool).reshape(near.shape)
        order = np.argsort(behind, axis=1, kind="stable")[:, :NEIGHBOURS]
        near, distance, behind = (np.take_along_axis(a, order, 1) for a in (near, distance, behind))
        neighbours[here, : near.shape[1]] = at[near]
        weights[here, : near.shape[1]] = _weights(points[here], X[at][near], distance, ~behind, spacing)
    return Embedding(
        which=which.long().cpu(), neighbours=torch.from_numpy(neighbours), weights=torch.from_numpy(weights)
    )


def _two_steps(tree, reach: float):
    """Sparse matrix: which particles are joined by at most two steps of `reach` [m]."""
    from scipy import sparse

    i, j = tree.query_pairs(reach, output_type="ndarray").T
    links = sparse.coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(tree.n, tree.n)).tocsr()
    links = ((links + links.T + sparse.identity(tree.n, np.int8, format="csr")) > 0).astype(np.int32)
    return (links @ links > 0).tocsr()


def _weights(point: np.ndarray, X: np.ndarray, distance: np.ndarray, reached: np.ndarray, spacing: float) -> np.ndarray:
    """[g, k] of Gaussians at `point` [g, 3] for the particles X [g, k, 3]: a bell, then as linear-exact as is sound.

    The correction is limited to one spacing beyond the particles, and absent across directions in which they do not
    spread (a sheet, a thread).
    """
    exponent = np.where(reached, -0.5 * (distance / spacing) ** 2, -np.inf)
    w = np.exp(exponent - exponent.max(1, keepdims=True))
    w /= w.sum(1, keepdims=True)
    centre = np.einsum("gk,gki->gi", w, X)
    offset = X - centre[:, None]
    spread, axes = np.linalg.eigh(np.einsum("gk,gki,gkj->gij", w, offset, offset))
    away = point - centre
    away *= np.minimum(1, spacing / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300))
    inverse = np.where(spread > 0.02 * spacing**2, 1 / np.maximum(spread, 1e-300), 0.0)
    slope = np.einsum("gia,ga,gja,gj->gi", axes, inverse, axes, away)
    return w * (1 + np.einsum("gki,gi->gk", offset, slope))


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


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """What never moves, drawn once for one camera: a frame draws anew only the tiles that something moving touches."""

    still: Rendered
    camera: Camera

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        embedding: Embedding,
        camera: Camera,
        *,
        background: Float[Tensor, " 3"] | tuple[float, float, float],
    ) -> "Backdrop | None":
        """None where every Gaussian moves."""
        static = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.mean.device)
        static[embedding.which.to(static.device)] = False
        if not static.any():
            return None
        with torch.no_grad():
            return cls(still=render(gaussians.select(static), camera, background=background), camera=camera)


def render_deformed(
    gaussians: Gaussians,
    embedding: Embedding,
    X: Float[Tensor, "p 3"],
    x: Float[Tensor, "p 3"],
    F: Float[Tensor, "p 3 3"],
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
    interior: Interior | None = None,
    backdrop: Backdrop | None = None,
) -> Rendered:
    """Draw the Gaussians where the particles have carried them; differentiable in x, F and the model's appearance.

    Those of the `interior` are drawn where the body has opened. With a `backdrop` of the same camera the picture is the
    same, but only the tiles that a moving Gaussian touches are computed, and only what lies there has a gradient.
    """
    mean, covariance, rotation = carry(gaussians, embedding, X, x, F)
    direction = mean - camera.centre.to(mean)
    if rotation is not None:
        direction = torch.einsum("nji,nj->ni", rotation, torch.nn.functional.normalize(direction, dim=-1))
    color = sh_color(gaussians.sh, direction.to(gaussians.sh))
    drawn = mean, covariance, gaussians.opacity, color
    if interior is not None:
        inner = interior.drawn(X, x)
        if len(inner[0]):
            drawn = tuple(torch.cat([a, b.to(a)]) for a, b in zip(drawn, inner, strict=True))  # type: ignore[assignment]
    if backdrop is None:
        return rasterize(*drawn, camera, background=background)
    moving = torch.zeros(len(drawn[0]), dtype=torch.bool, device=mean.device)
    moving[embedding.which.to(mean.device)] = True
    moving[len(gaussians) :] = True
    tiles = tiles_of(drawn[0][moving], drawn[1][moving], drawn[2][moving], camera)
    part, place = rasterize(*drawn, camera, background=background, tiles=tiles), window(tiles)
    whole = {name: getattr(backdrop.still, name).clone() for name in ("color", "alpha", "depth")}
    for name, picture in whole.items():
        picture[place] = getattr(part, name)[place]
    return Rendered(**whole)


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
