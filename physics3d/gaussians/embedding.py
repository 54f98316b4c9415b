"""Which particles carry a Gaussian, and with which weights.

    sum_j w_j = 1,   sum_j w_j X_j = X_g where the particles allow it

The weights are those of moving least squares over the nearest particles: a bell exp(-|X_g - X_j|^2 / (2 spacing^2)),
made linear-exact, so that an F that changes linearly with the place is carried exactly. Particles of another part, or
beyond a gap, carry nothing.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite

NEIGHBOURS = 8
CANDIDATES = 20  # nearest particles among which those are sought
BEYOND = 1.5  # from the middle of its particles to a Gaussian, to where their slope is followed [spacings]
THIN = 0.01  # variance of the particles along an axis [spacings^2], below which there is no slope along it
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
        order = np.argsort(behind, axis=1, kind="stable")
        near, distance, behind = (np.take_along_axis(a, order, 1) for a in (near, distance, behind))
        chosen = _not_flat(X[at][near], distance, ~behind, spacing)
        near, distance, behind = (np.take_along_axis(a, chosen, 1) for a in (near, distance, behind))
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


def _not_flat(X: np.ndarray, distance: np.ndarray, reached: np.ndarray, spacing: float) -> np.ndarray:
    """[g, NEIGHBOURS] of the candidates [g, k], in order: the first, but for the last another one where the first lie
    in a plane and a candidate does not. The nearest of one beside a surface may be one layer."""
    count = min(NEIGHBOURS, X.shape[1])
    chosen = np.tile(np.arange(count), (len(X), 1))
    if X.shape[1] > count:
        first = slice(count)
        _, centre, _, spread, axes = _moments(X[:, first], distance[:, first], reached[:, first], spacing)
        off = np.abs(np.einsum("gki,gi->gk", X - centre[:, None], axes[:, :, 0]))
        other = reached & (off > 0.5 * spacing)
        other[:, first] = False
        swap = (spread[:, 0] < 2 * THIN * spacing**2) & other.any(1)
        chosen[swap, -1] = other[swap].argmax(1)
    return chosen


def _moments(X: np.ndarray, distance: np.ndarray, reached: np.ndarray, spacing: float) -> tuple[np.ndarray, ...]:
    """Bell [g, k], weighted mean of the particles [g, 3], offsets from it, their variances and axes in rising order."""
    exponent = np.where(reached, -0.5 * (distance / spacing) ** 2, -np.inf)
    w = np.exp(exponent - exponent.max(1, keepdims=True))
    w /= w.sum(1, keepdims=True)
    centre = np.einsum("gk,gki->gi", w, X)
    offset = X - centre[:, None]
    return w, centre, offset, *np.linalg.eigh(np.einsum("gk,gki,gkj->gij", w, offset, offset))


def _weights(point: np.ndarray, X: np.ndarray, distance: np.ndarray, reached: np.ndarray, spacing: float) -> np.ndarray:
    """[g, k] of Gaussians at `point` [g, 3] for the particles X [g, k, 3]: a bell, then as linear-exact as is sound.

    The correction is limited to `BEYOND` of the particles' middle, and absent across directions in which they do not
    spread (a sheet, a thread).
    """
    w, centre, offset, spread, axes = _moments(X, distance, reached, spacing)
    away = point - centre
    away *= np.minimum(1, BEYOND * spacing / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300))
    inverse = np.where(spread > THIN * spacing**2, 1 / np.maximum(spread, 1e-300), 0.0)
    slope = np.einsum("gia,ga,gja,gj->gi", axes, inverse, axes, away)
    return w * (1 + np.einsum("gki,gi->gk", offset, slope))
