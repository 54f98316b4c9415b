"""A body as small pieces of matter, each known by its volume, its centroid and its second moment.

    V = int dX,   X_c = 1/V int X dX,   S = 1/V int (X - X_c) (X - X_c)^T dX        [m^3], [m], [m^2]

A piece is what one lattice cell holds of the body, or a particle: a cube of its volume, unless something better is
known. It is integrated as the cuboid of this volume, centroid and second moment, exactly to the fifth degree at 14
points (Irons 1971), so that a part thinner than a cell bends as it should. (Its midpoint alone would lose 1/n^2 of the
second moment of a section n pieces across; eight points do not see how a section one piece across can warp.) Two pieces
are linked where matter of one touches matter of the other: what lies across a gap is not.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite

REACH = 1.6  # of the edge of a cube: pieces whose centroids are nearer touch, where nothing better is known


@dataclass(frozen=True, kw_only=True)
class Matter(AbstractArtifact):
    """All pieces of a body; float64."""

    position: Float[Tensor, "m 3"]  # centroids at rest [m]
    volume: Float[Tensor, " m"]  # [m^3]
    moment: Float[Tensor, "m 3 3"]  # S [m^2]
    owner: Int[Tensor, " m"]  # the particle whose material it is made of
    links: Int[Tensor, "l 2"]  # pairs of pieces that touch

    def check(self) -> None:
        m = len(self.position)
        shapes = (self.position.shape, self.volume.shape, self.moment.shape, self.owner.shape)
        if shapes != ((m, 3), (m,), (m, 3, 3), (m,)) or self.links.shape[1:] != (2,):
            raise ValueError(f"Matter: position, volume, moment and owner have shapes {shapes}, links must be [l, 2]")
        for name in ("position", "volume", "moment"):
            require_finite(f"Matter.{name}", getattr(self, name))
        if not bool((self.volume > 0).all()):
            raise ValueError(f"Matter.volume: {int((self.volume <= 0).sum())} of {m} pieces have none; drop them")

    @property
    def size(self) -> float:
        """Edge of the cube that a typical piece is [m]: of the largest tenth, for those of a surface are cut."""
        return float(torch.quantile(self.volume, 0.9)) ** (1 / 3)

    def select(self, chosen: np.ndarray) -> "Matter":
        """The pieces of a mask [m], and the links among them."""
        number = np.cumsum(chosen) - 1
        links = self.links.numpy()
        links = number[links[chosen[links].all(1)]]
        kept = torch.from_numpy(np.flatnonzero(chosen))
        fields = {name: getattr(self, name)[kept] for name in ("position", "volume", "moment", "owner")}
        return Matter(**fields, links=torch.from_numpy(links))


def of_particles(position: Float[Tensor, "p 3"], volume: Float[Tensor, " p"]) -> Matter:
    """Every particle a cube of its volume, linked to those within REACH of its edge."""
    x, v = position.detach().cpu().double(), volume.detach().cpu().double()
    edge = float(torch.quantile(v, 0.9)) ** (1 / 3)
    pairs = cKDTree(x.numpy()).query_pairs(REACH * edge, output_type="ndarray")
    return Matter(
        position=x,
        volume=v,
        moment=(v ** (2 / 3) / 12)[:, None, None] * torch.eye(3, dtype=torch.float64),
        owner=torch.arange(len(x)),
        links=torch.from_numpy(pairs.astype(np.int64).reshape(-1, 2)),
    )


def of_samples(
    cell: Int[np.ndarray, "m 3"],
    offset: Float[np.ndarray, "s 3"],
    inside: np.ndarray,
    origin: np.ndarray,
    h: float,
    owner: Int[np.ndarray, " m"],
) -> Matter:
    """Pieces of lattice cells of edge h [m], from samples: cell i begins at origin + h cell_i; `inside` [m, s] says
    which of its samples, at `offset` in the unit cell, are matter. `offset` is a cubic arrangement of n^3, x
    slowest."""
    n = round(len(offset) ** (1 / 3))
    count = inside.sum(1)
    at = origin + h * (cell[:, None] + offset)
    centroid = np.einsum("cs,csi->ci", inside, at) / count[:, None]
    away = at - centroid[:, None]
    moment = np.einsum("cs,csi,csj->cij", inside, away, away) / count[:, None, None]
    moment += (h / n) ** 2 / 12 * np.eye(3)
    # neighbours share a face on which both have matter
    solid = inside.reshape(-1, n, n, n)
    size = cell.max(0, initial=0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key)
    links = []
    for axis, step in enumerate((size[1] * size[2], size[2], 1)):
        there = np.minimum(np.searchsorted(key[order], key + step), len(key) - 1)
        first = np.flatnonzero(key[order[there]] == key + step)
        second = order[there[first]]
        faces = np.take(solid[first], n - 1, axis + 1) & np.take(solid[second], 0, axis + 1)
        touch = faces.any((1, 2))
        links.append(np.stack([first[touch], second[touch]], 1))
    return Matter(
        position=torch.from_numpy(centroid),
        volume=torch.from_numpy(count / n**3 * h**3),
        moment=torch.from_numpy(moment),
        owner=torch.from_numpy(owner.astype(np.int64)),
        links=torch.from_numpy(np.concatenate(links).astype(np.int64)),
    )


def in_one_piece(matter: Matter) -> Matter:
    """With clusters that no link joins to the rest, but that are nearer than two edges of a piece, linked where they
    are nearest: slivers that the sampling cut off, particles that lie loosely. (Filling calls what is farther a piece
    of its own.)"""
    x = matter.position.numpy()
    while True:
        links, m = matter.links.numpy(), len(matter.position)
        graph = sparse.coo_matrix((np.ones(len(links), bool), links.T), shape=(m, m))
        count, cluster = sparse.csgraph.connected_components(graph, directed=False)
        if count == 1:
            return matter
        largest = np.bincount(cluster, weights=matter.volume.numpy()).argmax()
        main, rest = np.flatnonzero(cluster == largest), np.flatnonzero(cluster != largest)
        distance, near = cKDTree(x[main]).query(x[rest], distance_upper_bound=2 * matter.size)
        order = np.lexsort((distance, cluster[rest]))
        first = order[np.unique(cluster[rest][order], return_index=True)[1]]
        first = first[np.isfinite(distance[first])]
        if not len(first):
            return matter
        more = np.stack([rest[first], main[near[first]]], 1)
        matter = replace(matter, links=torch.from_numpy(np.concatenate([links, more])))


def points(matter: Matter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(X [n, 3] m, weight [n] m^3, piece [n]): 14 points of every piece."""
    value, axes = np.linalg.eigh(matter.moment.numpy())
    root = (axes * np.sqrt(np.maximum(value, 0))[:, None]) @ axes.transpose(0, 2, 1)
    corner = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(8, 3)
    place = np.concatenate([np.sqrt(19 / 30) * np.eye(3), -np.sqrt(19 / 30) * np.eye(3), np.sqrt(19 / 33) * corner])
    share = np.array([320 / 361] * 6 + [121 / 361] * 8) / 8
    # half an edge is sqrt(3) deviations
    X = matter.position.numpy()[:, None] + np.einsum("mij,kj->mki", root, np.sqrt(3) * place)
    weight = matter.volume.numpy()[:, None] * share
    return X.reshape(-1, 3), weight.reshape(-1), np.repeat(np.arange(len(X)), len(share))


def with_particles(
    matter: Matter, position: Float[np.ndarray, "n 3"], volume: Float[np.ndarray, " n"], moment: np.ndarray, first: int
) -> Matter:
    """`matter` and n more particles, numbered from `first` on, a piece each, linked by their distance."""
    edge = matter.size if len(matter.position) else float(np.quantile(volume, 0.9)) ** (1 / 3)
    old, m = matter.position.numpy(), len(matter.position)
    pairs = cKDTree(np.concatenate([old, position])).query_pairs(REACH * edge, output_type="ndarray")
    pairs = pairs[(pairs >= m).any(1)].astype(np.int64)
    more = (position, volume, moment, np.arange(first, first + len(position)), pairs)
    names = ("position", "volume", "moment", "owner", "links")
    return Matter(**{name: torch.cat([getattr(matter, name), torch.from_numpy(a)]) for name, a in zip(names, more)})


def of_owners(matter: Matter, keep: np.ndarray) -> Matter:
    """The pieces of the particles in a mask [p], numbered among these."""
    kept = matter.select(keep[matter.owner.numpy()])
    return replace(kept, owner=torch.from_numpy(np.cumsum(keep) - 1)[kept.owner])
