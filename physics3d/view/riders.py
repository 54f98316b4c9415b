"""Gaussians carried by particles, many times a second: `gaussians/carry.py` as one sparse product.

    F_g = sum_j w_j F_j,    x_g = sum_j w_j (x_j - 1/2 F_j X_j) + F_g (X_g - 1/2 sum_j w_j X_j)

is the rule of `carry.py`, its sum multiplied out: what depends on the motion is W [F | x - 1/2 F X], with the weights w
as the sparse matrix W. Components are kept apart ([3, 3, g]), for a product of 20 000 small matrices costs
more in calls than in arithmetic. The rotation R of F = R S is found by Newton's iteration R <- (R + R^-T)/2 (Higham
1986), which is enough for a viewing direction.
"""

import numpy as np
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from physics3d.gaussians.embedding import Embedding
from physics3d.gaussians.model import Gaussians

ITERATIONS = 8  # of Newton, at most: enough for a stretch of ten
EVEN = 1e-3  # of a rotation that changes less no colour does
FLAT = 1e-3  # volume ratio below which a Gaussian has no rotation of its own

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix, in the order of 3DGS


class Riders:
    """The Gaussians of an embedding and how they follow particles whose place at rest is X [p, 3] m."""

    def __init__(self, gaussians: Gaussians, embedding: Embedding, X: Float[Tensor, "p 3"]):
        mine = gaussians.select(embedding.which)
        self.X = X.double().numpy()
        g, k = embedding.neighbours.shape
        rows = (embedding.weights.double().numpy().ravel(), embedding.neighbours.numpy().ravel(), np.arange(g + 1) * k)
        self.weights = sparse.csr_matrix(rows, shape=(g, len(X)))
        lever = mine.mean.double().numpy() - 0.5 * (self.weights @ self.X)
        self._lever = lever.T.copy()  # [3, g]
        # Sigma = L L^T at rest
        root = mine.rotation() * mine.log_scale.exp()[:, None, :]
        self._root = root.permute(1, 2, 0).contiguous().double().numpy()  # [3, 3, g]
        self.turns = gaussians.sh.shape[1] > 1

    def carry(
        self, x: Float[Tensor, "p 3"], F: Float[Tensor, "p 3 3"]
    ) -> tuple[Float[np.ndarray, "g 3"], Float[np.ndarray, "g 6"], Float[np.ndarray, "3 3 g"] | None]:
        """Means [m], upper triangles of the covariances [m^2] and rotations, None where no colour needs them."""
        x_, F_ = x.double().numpy(), F.double().numpy()
        carried = np.empty((len(x_), 12))
        carried[:, :9] = F_.reshape(-1, 9)
        carried[:, 9:] = x_ - 0.5 * np.einsum("pij,pj->pi", F_, self.X)
        blended = np.ascontiguousarray((self.weights @ carried).T)  # [12, g]
        G, lever, L = blended[:9].reshape(3, 3, -1), self._lever, self._root
        mean = blended[9:] + np.stack([sum(G[i, j] * lever[j] for j in range(3)) for i in range(3)])
        M = [[sum(G[i, k] * L[k, j] for k in range(3)) for j in range(3)] for i in range(3)]
        upper = np.stack([sum(M[i][k] * M[j][k] for k in range(3)) for i, j in UPPER], 1)
        return mean.T, upper, rotation(G) if self.turns else None

    def blend(self, value: Float[np.ndarray, " p"]) -> Float[np.ndarray, " g"]:
        """A number per particle, at the Gaussians."""
        return self.weights @ value


def rotation(F: Float[np.ndarray, "3 3 g"]) -> Float[np.ndarray, "3 3 g"]:
    """R of F = R S; the identity where F turns inside out or has lost its volume."""
    cofactor, det = _cofactor(F)
    sound = det > FLAT
    R = np.where(sound, F, np.eye(3)[:, :, None])
    for _ in range(ITERATIONS):
        cofactor, det = _cofactor(R)
        new = 0.5 * (R + cofactor / det)  # R^-T is the matrix of cofactors over the determinant
        change = np.abs(new - R).max(initial=0)
        R = new
        if change < EVEN:
            break
    return R


def _cofactor(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    C = np.stack([np.cross(A[(i + 1) % 3], A[(i + 2) % 3], axis=0) for i in range(3)])
    return C, (A[0] * C[0]).sum(0)
