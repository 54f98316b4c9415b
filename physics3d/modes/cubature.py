"""A few points of integration with weights of their own, in place of all: what a basis of few smooth fields can tell
apart.

    minimise sum_z (sum_q f_q y_z(q) - a_z . b_z)^2 over factors f_q >= 0 of the weights,
    y_z(q) = e_q(a_z) : C e_q(b_z) w_q,   sum_q y_z(q) = a_z . b_z

with a_z, b_z random states of the basis in coordinates in which its stiffness is the identity: all of them have the
same energy, so that bending is integrated as well as stretching, which is a thousand times stiffer. A set of factors
that integrates enough random products integrates all. Factors that are not negative keep every energy an energy.
Non-negative least squares leaves at most as many points as there are products. An, Kim and James (2008), Farhat et al.
(2014).
"""

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg
from scipy.optimize import lsq_linear, nnls

CANDIDATES = 5  # per point that is asked for
WEIGHT = 10.0  # of the modes of vibration among the products


def chosen(
    gradient: Float[np.ndarray, "rows r"],
    tangent: Float[np.ndarray, "9 n 3 3"],
    K: Float[np.ndarray, "u u"],
    modes: Float[np.ndarray, "u m"],
    group: Int[np.ndarray, " n"],
    count: int,
    seed: int = 0,
) -> tuple[Int[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """(which of n points, the factors of their weights), at most about `count`; K is the stiffness with all points,
    `modes` of vibration, whose products are integrated with more weight than random ones.
    Points of different `group`, of other materials, are integrated each by their own."""
    rng = np.random.default_rng(seed)
    n, r = len(group), gradient.shape[1]
    if n <= 1.5 * count:
        return np.arange(n), np.ones(n)
    value, vector = linalg.eigh((K + K.T) / 2)
    root = vector / np.sqrt(np.maximum(value, 1e-10 * value.max()))  # states of unit energy [3r, 3r]
    pairs = np.stack(np.triu_indices(modes.shape[1]), 1)
    slopes, D = gradient.reshape(n, 3, r), tangent.reshape(3, 3, n, 3, 3)
    labels, size = np.unique(group, return_counts=True)
    found, factors = [], []
    for label, own_count in zip(labels, size, strict=True):
        own = np.flatnonzero(group == label)
        rows = max(100, round(count * own_count / n)) + len(pairs)
        if len(own) <= rows:
            found.append(own)
            factors.append(np.ones(len(own)))
            continue
        states = rng.standard_normal((2, rows, root.shape[1]))
        states[1, ::2] = states[0, ::2]
        a, b = (root @ s.T for s in states)
        a[:, : len(pairs)], b[:, : len(pairs)] = modes[:, pairs[:, 0]], modes[:, pairs[:, 1]]
        a, b = a.reshape(r, 3 * rows), b.reshape(r, 3 * rows)
        Y = np.empty((len(own), rows))
        for begin in range(0, len(own), 512):
            at = own[begin : begin + 512]
            Ha, Hb = ((slopes[at] @ s).reshape(len(at), 3, 3, rows) for s in (a, b))
            P = np.einsum("ainbk,nbkz->naiz", D[:, :, at], Hb, optimize=True)
            Y[begin : begin + 512] = np.einsum("naiz,naiz->nz", Ha, P)
        target = Y.sum(0)
        scale = 1 / np.sqrt((Y**2).sum(0) * len(own))
        scale[: len(pairs)] *= WEIGHT
        # candidates by the energy they hold: what bends at a narrow foot bends nowhere else
        share = np.linalg.norm(Y * scale, axis=1)
        take = rng.choice(
            len(own), min(CANDIDATES * rows, len(own)), replace=False, p=(share + share.mean()) / (2 * share.sum())
        )
        solution = _not_negative((Y[take] * scale).T, target * scale)
        kept = solution > 0
        found.append(own[take][kept])
        factors.append(solution[kept])
    return np.concatenate(found), np.concatenate(factors)


def _not_negative(A: Float[np.ndarray, "r c"], b: Float[np.ndarray, " r"]) -> Float[np.ndarray, " c"]:
    """Least squares with x >= 0: active sets (Lawson and Hanson 1974), and where they go round in circles, as they may
    when many columns are nearly the same, an interior method, whose smallest weights are none."""
    try:
        return nnls(A, b, maxiter=20 * len(b))[0]
    except RuntimeError:
        x = lsq_linear(A, b, bounds=(0, np.inf), tol=1e-10, max_iter=200).x
        return np.where(x > 1e-6 * x.max(), x, 0.0)
