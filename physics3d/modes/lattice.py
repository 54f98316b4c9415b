"""Displacement as quadratic B-splines on a lattice that knows nothing of the surface, but knows what hangs together.

    u(X) = sum_j N_j(X) q_j,     N_j a product of three quadratic B-splines of a lattice of spacing H     [m]

They are smooth (C1) and hold every quadratic field, so that one cell across bends without locking, in any direction;
the surface enters by the points of integration alone (`matter.py`). Of a spline whose support meets several bits of the
body that do not touch inside it, every bit gets a copy of its own: leaves side by side do not feel each other.
A finite cell method (Parvizian, Duester, Rank 2007) on B-splines, with the copies of Nesme et al. (2009) and of
XIGA (Noel et al. 2022).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

_NODES = np.indices((3, 3, 3)).reshape(3, -1).T  # of the splines that do not vanish in a cell


@dataclass(frozen=True, kw_only=True)
class Splines:
    """The functions of one body."""

    H: float  # spacing [m]
    origin: Float[np.ndarray, "3"]  # of the lattice [m]
    first: Int[np.ndarray, "3"]  # the lowest cell
    size: Int[np.ndarray, "3"]  # splines along each axis
    pieces: int
    key: Int[np.ndarray, " k"]  # spline * pieces + piece, where the support of the one meets the other; sorted
    label: Int[np.ndarray, " k"]  # which function that is
    count: int  # functions

    def at(
        self,
        X: Float[np.ndarray, "n 3"],
        piece: Int[np.ndarray, " n"],
        *,
        continued_from: Float[np.ndarray, "n 3"] | None = None,
    ) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """(N [n, count], gradient [3 n, count] in 1/m, row 3 i + a the derivative of point i along axis a).

        `continued_from` are places [m] in the matter: the quadratic of their cell is continued to X, which lies beside
        it, on a face or beyond. The cell of X itself may hold no matter; functions that end there would say anything.
        """
        spline, value, slope = _evaluate(X, self.H, self.origin, self.first, self.size, continued_from)
        key = spline * self.pieces + piece[:, None]
        place = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        known = self.key[place] == key
        column = self.label[place]
        row = np.arange(len(X))[:, None]
        values = sparse.csr_matrix(
            (np.where(known, value, 0.0).ravel(), (np.broadcast_to(row, key.shape).ravel(), column.ravel())),
            shape=(len(X), self.count),
        )
        rows = (3 * row + np.arange(3))[..., None]  # [n, 3, 1]
        slopes = np.where(known[:, None], slope.transpose(0, 2, 1), 0.0)
        columns = np.broadcast_to(column[:, None], slopes.shape)
        gradient = sparse.csr_matrix(
            (slopes.ravel(), (np.broadcast_to(rows, slopes.shape).ravel(), columns.ravel())),
            shape=(3 * len(X), self.count),
        )
        return values, gradient

    def affine(self) -> Float[np.ndarray, "count 4"]:
        """Coefficients of the fields 1, X, Y, Z: the centres of the splines."""
        spline = np.zeros(self.count, np.int64)
        spline[self.label] = self.key // self.pieces
        index = np.stack(np.unravel_index(spline, tuple(self.size)), 1) + self.first
        return np.concatenate([np.ones((self.count, 1)), self.origin + (index - 0.5) * self.H], 1)


def splines(
    X: Float[np.ndarray, "n 3"], piece: Int[np.ndarray, " n"], links: Int[np.ndarray, "l 2"], pieces: int, H: float
) -> Splines:
    """The splines whose support meets the points X [m], one copy per bit of linked pieces in it."""
    lower, upper = X.min(0), X.max(0)
    count = np.ceil((upper - lower) / H + 1e-9)
    origin = (lower + upper - count * H) / 2
    cell = np.floor((X - origin) / H).astype(np.int64)
    first, size = cell.min(0), cell.max(0) - cell.min(0) + 3
    spline, _, _ = _evaluate(X, H, origin, first, size)
    key = np.unique((spline * pieces + piece[:, None]).ravel())
    number = sparse.csr_matrix(
        (np.arange(1, len(key) + 1), (key % pieces, key // pieces)), shape=(pieces, int(size.prod()))
    )
    # two pieces that touch are one bit in every support that they share
    one, other = number[links[:, 0]], number[links[:, 1]]
    a, b = one.multiply(other > 0).tocsr(), other.multiply(one > 0).tocsr()
    a.sort_indices(), b.sort_indices()
    joined = sparse.coo_matrix((np.ones(a.nnz, bool), (a.data - 1, b.data - 1)), shape=(len(key), len(key)))
    copies, label = sparse.csgraph.connected_components(joined, directed=False)
    return Splines(
        H=H, origin=origin, first=first, size=size, pieces=pieces, key=key, label=label.astype(np.int64), count=copies
    )


def _evaluate(X, H, origin, first, size, inside=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(number of the spline [n, 27], value [n, 27], gradient [n, 27, 3] 1/m) of the splines around every point, or of
    the quadratics of the cell that `inside` [n, 3] lies in."""
    y = (X - origin) / H
    cell = np.floor(y if inside is None else (inside - origin) / H).astype(np.int64)
    f = y - cell
    value = np.stack([0.5 * (1 - f) ** 2, 0.5 + f * (1 - f), 0.5 * f**2], -1)  # [n, axis, 3]
    slope = np.stack([f - 1, 1 - 2 * f, f], -1) / H
    index = np.clip((cell - first)[:, None] + _NODES, 0, size - 1)
    number = (index[..., 0] * size[1] + index[..., 1]) * size[2] + index[..., 2]
    a, b, c = _NODES.T
    x, y, z = value[:, 0, a], value[:, 1, b], value[:, 2, c]
    gradient = np.stack([slope[:, 0, a] * y * z, x * slope[:, 1, b] * z, x * y * slope[:, 2, c]], -1)
    return number, x * y * z, gradient
