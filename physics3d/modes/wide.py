"""What a body does besides when it swings widely: fields of the second order, and the work that integrates them.

    f(u) = K u + f2(u, u)/2 + ...,        f2 symmetric: f(u) + f(-u) = f2(u, u) + what is of the fourth order
    u(q) = sum_i q_i phi_i + 1/2 sum_ij q_i q_j psi_ij,        psi_ij = -K^-1 f2(phi_i, phi_j)

A strip that bends far shortens, a coil that swings out unwinds. The psi_ij say so; they are the modal derivatives of
Idelsohn and Cardona (1985) and of Barbic and James (2005). A basis that lacks them must stretch the body instead, and
is too stiff: by 1/8 psi_ij K psi_ij q^4, of what of psi_ij it does not hold. Where this is little, nothing is added.

All modes are looked at with the same energy, that at which the first of them turns by WIDE, so that those that are
stiff swing less.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import linalg, sparse

from physics3d.modes import vibration
from physics3d.modes.stress import Points

MODES = 6  # of vibration, the first
WIDE = 0.5  # gradient of the displacement in a wide swing: half a right angle's turn would be 0.8
MOSTLY = 0.99  # of the matter is moved by less than what is called the gradient of a mode: a corner may stick out
SMALL = 2e-3  # of a wide swing, at which the second order is read off: 4e-6 of the fourth, rounding 1e-10
STIFFER = 0.01  # of the energy of a wide swing: what a missing field may add to it
MOST = 10  # fields that are added
FLAT = 0.2  # det F of a pose, below which it is made smaller


@dataclass(frozen=True, kw_only=True)
class Swings:
    """Modes of vibration at an amplitude at which all have one energy."""

    modes: np.ndarray  # [u, k]
    energy: float  # [J]


def swings(
    gradient: sparse.csr_matrix | np.ndarray,
    weight: Float[np.ndarray, " n"],
    shapes: Float[np.ndarray, "u m"],
    square: Float[np.ndarray, " m"],
) -> Swings:
    """The first of `shapes`, modes of vibration of unit mass without rigid ones, and their omega^2 `square` [1/s^2]."""
    k = min(MODES, shapes.shape[1])
    modes = shapes[:, :k] / np.sqrt(square[:k])
    size = np.linalg.norm((gradient @ modes.reshape(-1, 3 * k)).reshape(len(weight), 9, k), axis=1)
    order = np.argsort(size, axis=0)
    below = np.cumsum(weight[order], axis=0) <= MOSTLY * weight.sum()
    largest = max(float(size[order[min(below[:, i].sum(), len(size) - 1), i], i]) for i in range(k))
    return Swings(modes=WIDE / largest * modes, energy=(WIDE / largest) ** 2 / 2)


def second_order(
    gradient: sparse.csr_matrix | np.ndarray, points: Points, modes: Float[np.ndarray, "u k"]
) -> Float[np.ndarray, "u p"]:
    """f2 of every pair i <= j of `modes`, as np.triu_indices lists them, all dash-pots stuck; `points` are at rest."""
    k = modes.shape[1]
    slopes = (gradient @ modes.reshape(-1, 3 * k)).reshape(points.n, 3, 3, k)

    def even(H: np.ndarray) -> np.ndarray:
        P = points.stress(SMALL * H, vibration.STUCK).copy()  # which the next call overwrites
        P += points.stress(-SMALL * H, vibration.STUCK)
        return (gradient.T @ P.reshape(-1, 3)).reshape(-1) / SMALL**2

    own = [even(slopes[..., i]) for i in range(k)]
    both = lambda i, j: (even(slopes[..., i] + slopes[..., j]) - own[i] - own[j]) / 2
    return np.stack([own[i] if i == j else both(i, j) for i, j in zip(*np.triu_indices(k), strict=True)], 1)


def missing(
    answers: Float[np.ndarray, "u p"],
    forces: Float[np.ndarray, "u p"],
    held: Float[np.ndarray, "p p"],
    energy: float,
) -> Float[np.ndarray, "u m"]:
    """Combinations of the psi_ij `answers` to the f2 `forces` that stiffen a wide swing of this `energy` [J] the most,
    where the basis holds of their products psi K psi only `held`."""
    # of u(q) for a unit vector q: of i != j, q_i q_j is a half at most, and there are two of them
    gram = -(forces.T @ answers + answers.T @ forces) / 8 - held / 4
    value, vector = linalg.eigh(gram)
    stiffer = value[::-1] / 2 / energy
    return answers @ vector[:, ::-1][:, : min(MOST, int((stiffer > STIFFER).sum()))]


def works(
    gradient: Float[np.ndarray, "rows r"],
    points: Points,
    seen: Swings,
    K: Float[np.ndarray, "u u"],
    count: int,
    seed: int = 0,
) -> Float[np.ndarray, "n count"]:
    """Work that the stress of wide swings does at every point of integration, on swings and on any states of the basis,
    in units in which all of these have the same energy. K is the stiffness of the basis."""
    rng = np.random.default_rng(seed)
    value, vector = linalg.eigh((K + K.T) / 2)
    root = vector / np.sqrt(np.maximum(value, 1e-10 * value.max()))  # states of unit energy
    psi = -root @ (root.T @ second_order(gradient, points, seen.modes))
    i, j = np.triu_indices(seen.modes.shape[1])
    unit = 1 / np.sqrt(2 * seen.energy)

    def slopes(states: np.ndarray) -> np.ndarray:  # [n, a, i, s]
        return (gradient @ states.reshape(-1, 3 * states.shape[1])).reshape(points.n, 3, 3, -1)

    def pose() -> np.ndarray:
        q: np.ndarray = rng.standard_normal(seen.modes.shape[1:])
        q = q / np.linalg.norm(q)
        while True:
            H = slopes((seen.modes @ q + psi @ (q[i] * q[j] / (1 + (i == j))))[:, None])[..., 0]
            if np.linalg.det(H + np.eye(3)).min() > FLAT:
                return H
            q = q / 2

    found: list[np.ndarray] = []
    while len(found) < count:
        P = unit * points.stress(pose(), vibration.STUCK)
        states = [one @ rng.standard_normal(one.shape[1]) for one in (unit * seen.modes, root, unit * seen.modes)]
        found += list(np.einsum("nai,nais->sn", P, slopes(np.stack(states, 1))))
    return np.stack(found[:count], 1)
