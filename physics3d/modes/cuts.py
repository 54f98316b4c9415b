"""Where a body is held: the matter that is left, and pins on the interface to what is rigid.

What never moves is no part of the problem. A box cuts the pieces on its faces where the face is, not at the next node
or particle: half a cell of length is a tenth of the frequency of a short stem.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse

from physics3d.matter import Matter


@dataclass(frozen=True, kw_only=True)
class Pins:
    """Points of an interface to something rigid, and the area that each stands for."""

    position: Float[np.ndarray, "a 3"]  # [m]
    area: Float[np.ndarray, " a"]  # [m^2]
    piece: Int[np.ndarray, " a"]  # of which piece it is a part

    def __len__(self) -> int:
        return len(self.area)

    def and_more(self, other: "Pins") -> "Pins":
        """Both, on the pieces of the same body."""
        both = lambda name: np.concatenate([getattr(self, name), getattr(other, name)])
        return Pins(position=both("position"), area=both("area"), piece=both("piece"))

    def renumbered(self, keep: np.ndarray) -> "Pins":
        """Those on the pieces of a mask, numbered among these."""
        mine = keep[self.piece]
        return Pins(position=self.position[mine], area=self.area[mine], piece=(np.cumsum(keep) - 1)[self.piece[mine]])


def outside_box(matter: Matter, lower: tuple, upper: tuple) -> tuple[Matter, Pins, np.ndarray]:
    """The matter that a box does not hold, pins where the box cuts or touches it, and the mask of what is kept.

    A piece across a face of the box is cut there, as the cuboid it is along that axis: with a of half its extent,
    what is beyond the plane at z has the share (c + a - z)/(2 a), and S changes by the regression on z."""
    low, high = np.array(lower, float), np.array(upper, float)
    x, S, V = (t.numpy().copy() for t in (matter.position, matter.moment, matter.volume))
    half = np.sqrt(3 * np.maximum(np.diagonal(S, axis1=1, axis2=2), 1e-30))
    slack = 0.02 * matter.size
    meets = ((x + half > low - slack) & (x - half < high + slack)).all(1)
    # share of the piece beyond each of the six faces; the largest is the face it sticks out of
    beyond = np.concatenate([(low - (x - half)) / (2 * half), ((x + half) - high) / (2 * half)], 1).clip(0, 1)
    face = beyond.argmax(1)
    share = beyond[np.arange(len(x)), face]
    keep = ~meets | (share > 0.01)
    chosen = np.flatnonzero(meets & keep)
    axis, side = face[chosen] % 3, np.where(face[chosen] >= 3, 1.0, -1.0)
    plane = np.where(side > 0, high[axis], low[axis])
    c, a = x[chosen, axis], half[chosen, axis]
    reach = np.minimum(2 * a, side * (c + side * a - plane))  # what is left of its extent
    new_c, new_variance = c + side * (a - reach / 2), reach**2 / 12
    column = S[chosen, :, axis]  # [k, 3]
    variance = S[chosen, axis, axis]
    V[chosen] *= share[chosen]
    x[chosen] += column / variance[:, None] * (new_c - c)[:, None]
    factor = (new_variance - variance) / variance**2
    S[chosen] += factor[:, None, None] * column[:, :, None] * column[:, None, :]
    # four points on the plane, as wide as the piece is across the axis
    others = np.stack([(axis + 1) % 3, (axis + 2) % 3], 1)
    pin = np.repeat(x[chosen][:, None], 4, 1)
    rows = np.arange(len(chosen))
    pin[rows[:, None], np.arange(4), axis[:, None]] = plane[:, None]
    for k, signs in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        for j in range(2):
            pin[rows, k, others[:, j]] += signs[j] * np.sqrt(np.maximum(S[chosen, others[:, j], others[:, j]], 0))
    area = V[chosen] / np.maximum(reach, 1e-30) / 4
    number = np.cumsum(keep) - 1
    cut = replace(matter, position=torch.from_numpy(x), moment=torch.from_numpy(S), volume=torch.from_numpy(V)).select(
        keep
    )
    pins = Pins(position=pin.reshape(-1, 3), area=np.repeat(area, 4), piece=np.repeat(number[chosen], 4))
    # where the face runs between two pieces and cuts neither
    cut_already = np.zeros(len(keep), bool)
    cut_already[chosen] = True
    return cut, pins.and_more(_between(matter, keep, cut_already)), keep


def outside_particles(matter: Matter, held: np.ndarray) -> tuple[Matter, Pins, np.ndarray]:
    """The matter of the particles that are not in the mask `held` [p], pins where it touches the rest, and the
    mask of the pieces that are kept."""
    keep = ~held[matter.owner.numpy()]
    return matter.select(keep), _between(matter, keep, np.zeros(len(keep), bool)), keep


def _between(matter: Matter, keep: Bool[np.ndarray, " m"], pinned: Bool[np.ndarray, " m"]) -> Pins:
    """Four pins on each face that a piece which is kept, and not `pinned` yet, turns to one that is not kept. What
    would hang on nothing but an edge or a corner of what is not kept is pinned there."""
    links = matter.links.numpy()
    across = links[keep[links[:, 0]] != keep[links[:, 1]]]
    free = np.where(keep[across[:, 0]], across[:, 0], across[:, 1])
    fixed = across.sum(1) - free
    among, m = links[keep[links].all(1)], len(keep)
    cluster = sparse.csgraph.connected_components(
        sparse.coo_matrix((np.ones(len(among), bool), among.T), shape=(m, m)), directed=False
    )[1]
    holds = np.zeros(m, bool)  # clusters that are pinned
    holds[cluster[pinned & keep]] = True
    free, fixed = free[~pinned[free]], fixed[~pinned[free]]
    x, S = matter.position.numpy(), matter.moment.numpy()
    normal = x[free] - x[fixed]
    distance = np.linalg.norm(normal, axis=1)
    # not along diagonals, unless there is nothing else: a sliver that the sampling cut off would drift away
    edge = np.sqrt(12 * np.linalg.eigvalsh(S)[:, -1])
    near = distance < 1.25 * np.maximum(edge[free], edge[fixed])
    holds[cluster[free[near]]] = True
    near |= ~holds[cluster[free]]
    free, fixed, normal, distance = free[near], fixed[near], normal[near], distance[near]
    normal = normal / np.maximum(distance, 1e-30)[:, None]
    tangent = np.linalg.svd(normal[:, None])[2][:, 1:]  # [k, 2, 3]
    wide = np.sqrt(np.einsum("kti,kij,ktj->kt", tangent, S[free], tangent))
    signs = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)], float)
    half = np.sqrt(3 * np.einsum("ki,kij,kj->k", normal, S[free], normal))
    # on the face of what is free: in a gap before it, nothing would keep the splines from a kink
    face = x[free] - np.minimum(half, distance)[:, None] * normal
    pin = face[:, None] + np.einsum("st,kt,kti->ksi", signs, wide, tangent)
    area = matter.volume.numpy()[free] / (2 * half)
    number = np.cumsum(keep) - 1
    return Pins(position=pin.reshape(-1, 3), area=np.repeat(area / 4, 4), piece=np.repeat(number[free], 4))
