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


class Carried:
    """Points at rest at `points` [g, 3] m that ride on particles at rest at X [p, 3] m; in float32."""

    def __init__(self, embedding: Embedding, X: Float[Tensor, "p 3"], points: Float[Tensor, "g 3"]):
        self.X = X.float().numpy()
        g, k = embedding.neighbours.shape
        rows = (embedding.weights.float().numpy().ravel(), embedding.neighbours.numpy().ravel(), np.arange(g + 1) * k)
        self.weights = sparse.csr_matrix(rows, shape=(g, len(X)))
        self._lever = (points.float().numpy() - 0.5 * (self.weights @ self.X)).T.copy()  # [3, g]

    def __call__(
        self, x: Float[Tensor, "p 3"], F: Float[Tensor, "p 3 3"]
    ) -> tuple[Float[np.ndarray, "3 g"], Float[np.ndarray, "3 3 g"]]:
        """Places [m] and deformations."""
        x_, F_ = x.float().numpy(), F.float().numpy()
        carried = np.empty((len(x_), 12), np.float32)
        carried[:, :9] = F_.reshape(-1, 9)
        carried[:, 9:] = x_ - 0.5 * np.einsum("pij,pj->pi", F_, self.X)
        blended = np.ascontiguousarray((self.weights @ carried).T)  # [12, g]
        G = blended[:9].reshape(3, 3, -1)
        return blended[9:] + np.einsum("ijg,jg->ig", G, self._lever), G

    def blend(self, value: Float[np.ndarray, "p *k"]) -> Float[np.ndarray, "g *k"]:
        """Numbers of the particles, at the points."""
        return self.weights @ value


class Riders:
    """The Gaussians of an embedding and how they follow particles whose place at rest is X [p, 3] m; in float32."""

    def __init__(self, gaussians: Gaussians, embedding: Embedding, X: Float[Tensor, "p 3"]):
        mine = gaussians.select(embedding.which)
        self._carried = Carried(embedding, X, mine.mean)
        # Sigma = L L^T at rest
        root = mine.rotation() * mine.log_scale.exp()[:, None, :]
        self._root = root.permute(1, 2, 0).contiguous().float().numpy()  # [3, 3, g]
        self.turns = gaussians.sh.shape[1] > 1

    def carry(
        self, x: Float[Tensor, "p 3"], F: Float[Tensor, "p 3 3"]
    ) -> tuple[Float[np.ndarray, "g 3"], Float[np.ndarray, "g 6"], Float[np.ndarray, "3 3 g"] | None]:
        """Means [m], upper triangles of the covariances [m^2] and rotations, None where no colour needs them."""
        mean, G = self._carried(x, F)
        M = np.einsum("ikg,kjg->ijg", G, self._root)
        upper = np.stack([(M[i] * M[j]).sum(0) for i, j in UPPER], 1)
        return mean.T, upper, rotation(G) if self.turns else None

    def blend(self, value: Float[np.ndarray, " p"]) -> Float[np.ndarray, " g"]:
        """A number per particle, at the Gaussians."""
        return self._carried.blend(value)


def rotation(F: Float[np.ndarray, "3 3 g"]) -> Float[np.ndarray, "3 3 g"]:
    """R of F = R S; the identity where F turns inside out or has lost its volume."""
    sound = (F[0] * _cofactor(F)[0]).sum(0) > FLAT
    R = np.where(sound, F, np.eye(3, dtype=F.dtype)[:, :, None])
    for _ in range(ITERATIONS):
        cofactor = _cofactor(R)
        new = 0.5 * (R + cofactor / (R[0] * cofactor[0]).sum(0))  # R^-T: the cofactors over the determinant
        change = np.abs(new - R).max(initial=0)
        R = new
        if change < EVEN:
            break
    return R


def _cofactor(A: Float[np.ndarray, "3 3 g"]) -> Float[np.ndarray, "3 3 g"]:
    C = np.empty_like(A)
    for i in range(3):
        p, q = A[(i + 1) % 3], A[(i + 2) % 3]
        for j in range(3):
            C[i, j] = p[(j + 1) % 3] * q[(j + 2) % 3] - p[(j + 2) % 3] * q[(j + 1) % 3]
    return C
