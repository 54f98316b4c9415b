"""What a body does besides when it swings widely: fields of the second order.

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
PART = 0.02  # of the matter, that takes part in them: a sliver that hangs on a petal's edge swings by itself
WIDE = 0.5  # gradient of the displacement in a wide swing, anywhere: half a right angle's turn would be 0.8
SMALL = 2e-3  # of a wide swing, at which the second order is read off: 4e-6 of the fourth, rounding 1e-10
STIFFER = 0.01  # of the energy of a wide swing: what a missing field may add to it
MOST = 10  # fields that are added


@dataclass(frozen=True, kw_only=True)
class Swings:
    """Modes of vibration at an amplitude at which all have one energy; none where the body takes part in none."""

    modes: np.ndarray  # [u, k], row 3 j + i: component i of function j [m]
    energy: float  # [J]


def swings(
    values: sparse.csr_matrix,
    gradient: sparse.csr_matrix,
    weight: Float[np.ndarray, " n"],
    shapes: Float[np.ndarray, "u m"],
    square: Float[np.ndarray, " m"],
) -> Swings:
    """The first of `shapes`, modes of vibration of unit mass without rigid ones, in which PART of the body takes part.
    `square`: their omega^2 [1/s^2]; `values` and `gradient` [1/m] of the functions at the points of `weight` [m^3]."""
    fields = shapes.reshape(values.shape[1], -1)
    there = ((values @ fields).reshape(len(weight), 3, -1) ** 2).sum(1)
    part = (weight @ there) ** 2 / (weight.sum() * np.maximum(weight @ there**2, 1e-300))
    which = np.flatnonzero(part > PART)[:MODES]
    if not which.size:  # loose bits alone swing: there is no mode of the body
        return Swings(modes=shapes[:, which], energy=0.0)
    modes = shapes[:, which] / np.sqrt(square[which])
    slopes = (gradient @ modes.reshape(values.shape[1], -1)).reshape(len(weight), 9, len(which))
    largest = float(np.linalg.norm(slopes, axis=1).max(initial=0.0))
    amplitude = WIDE / max(largest, 1e-300)  # times 1/omega: that of a mode [m kg^(1/2)]
    return Swings(modes=amplitude * modes, energy=amplitude**2 / 2)


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
