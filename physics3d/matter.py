"""A body as small pieces of matter, each known by its volume, its centroid and its second moment.

    V = int dX,   X_c = 1/V int X dX,   S = 1/V int (X - X_c) (X - X_c)^T dX        [m^3], [m], [m^2]

A piece is what one lattice cell, or an eighth of it, holds of the body, or a particle: a cube of its volume, unless
something better is known. It is integrated as the cuboid of this volume, centroid and second moment, exactly to the
fifth degree at 14 points (Irons 1971), so that a part thinner than a cell bends as it should. (Its midpoint alone would
lose 1/n^2 of the second moment of a section n pieces across; eight points, to the third degree, do not see how one
piece across can warp, and are enough where a particle has several pieces.) Two pieces are linked where matter of
one touches matter of the other: what lies across a gap is not.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
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

    @property
    def spacing(self) -> float:
        """The same of the particles [m], which may own several pieces."""
        owned = torch.zeros(int(self.owner.max()) + 1, dtype=self.volume.dtype).index_add_(0, self.owner, self.volume)
        return float(torch.quantile(owned[owned > 0], 0.9)) ** (1 / 3)

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
    which of its samples, at `offset` in the unit cell, are matter. `offset` has one in each of n^3 equal parts, x
    slowest. Cells without matter make no piece, and those in which matter lies to both sides of a gap make several."""
    some = inside.any(1)
    cell, inside, owner = cell[some], inside[some], owner[some]
    n = round(len(offset) ** (1 / 3))
    number = _lumps(cell, inside.reshape(-1, n, n, n))
    links = _touching(cell, number)
    number = number.reshape(len(cell), n**3)  # a sheet has no cell
    which, lump = np.nonzero(number >= 0)[0], number[number >= 0]
    _, first = np.unique(lump, return_index=True)
    at = which[first]  # the cell of every piece
    inside = number[at] == np.arange(len(at))[:, None]
    matter = inside.astype(float)
    count = matter.sum(1)
    mean = matter @ offset / count[:, None]
    square = (offset[:, :, None] * offset[:, None, :]).reshape(-1, 9)
    moment = (matter @ square / count[:, None]).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    # a lone sample is a cube of its part; of all together the cell is the cube
    short = np.eye(3) / 12 - np.cov(offset.T, bias=True)
    moment += (1 / n**2 / 12 / count)[:, None, None] * np.eye(3) * (count < n**3)[:, None, None]
    moment += (count / n**3)[:, None, None] * short
    moment, centroid = h**2 * moment, origin + h * (cell[at] + mean)
    return Matter(
        position=torch.from_numpy(centroid),
        volume=torch.from_numpy(count / n**3 * h**3),
        moment=torch.from_numpy(moment),
        owner=torch.from_numpy(owner[at].astype(np.int64)),
        links=torch.from_numpy(links),
    )


def _lumps(cell: Int[np.ndarray, "m 3"], inside: Bool[np.ndarray, "m n n n"]) -> Int[np.ndarray, "m n n n"]:
    """The number of the piece that every sample belongs to, -1 for none: what hangs together within a cell, and what
    does so by way of the cells around it. What is left apart lies to both sides of a gap."""
    near = np.zeros((3, 3, 3, 3), int)
    near[1] = 1  # neighbouring samples, none of them across the first axis
    number, count = ndimage.label(inside, near)
    number -= 1
    links = _touching(cell, number)
    graph = sparse.coo_matrix((np.ones(len(links), bool), links.T), shape=(count, count))
    graph = ((graph + graph.T).astype(bool) + sparse.identity(count, dtype=bool)).tocsr()
    around = (graph @ graph).astype(bool)
    around = (around @ around).astype(bool)  # four links: around an edge, or along a wall that a cell meets twice
    own = np.full(count, -1)
    at = np.nonzero(number >= 0)
    own[number[at]] = at[0]
    i, j = around.nonzero()
    same = own[i] == own[j]
    graph = sparse.coo_matrix((np.ones(same.sum(), bool), (i[same], j[same])), shape=(count, count))
    _, piece = sparse.csgraph.connected_components(graph, directed=False)
    return np.where(number >= 0, piece[number], -1)


def _touching(cell: Int[np.ndarray, "m 3"], number: Int[np.ndarray, "m n n n"]) -> Int[np.ndarray, "l 2"]:
    """Pairs of pieces of neighbouring cells that have samples to both sides of their face, beside each other: a sample
    touches those around its neighbour too, for a thin wall that runs askew is no row of gaps."""
    n = number.shape[1]
    size = cell.max(0, initial=0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key)
    links = [np.zeros((0, 2), np.int64)]
    for axis, step in enumerate((size[1] * size[2], size[2], 1)):
        there = np.minimum(np.searchsorted(key[order], key + step), len(key) - 1)
        first = np.flatnonzero(key[order[there]] == key + step)
        second = order[there[first]]
        mine, other = np.take(number[first], n - 1, axis + 1), np.take(number[second], 0, axis + 1)
        other = np.pad(other, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
        for i, j in np.ndindex(3, 3):
            pairs = np.stack([mine, other[:, i : i + n, j : j + n]], -1).reshape(-1, 2)
            links.append(np.unique(pairs[(pairs >= 0).all(1)], axis=0))
    return np.unique(np.concatenate(links), axis=0).astype(np.int64)


def in_one_piece(matter: Matter) -> Matter:
    """With clusters that no link joins to the rest, but that are nearer than two particles, linked where they
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
        distance, near = cKDTree(x[main]).query(x[rest], distance_upper_bound=2 * matter.spacing)
        order = np.lexsort((distance, cluster[rest]))
        first = order[np.unique(cluster[rest][order], return_index=True)[1]]
        first = first[np.isfinite(distance[first])]
        if not len(first):
            return matter
        more = np.stack([rest[first], main[near[first]]], 1)
        matter = replace(matter, links=torch.from_numpy(np.concatenate([links, more])))


def in_blocks(matter: Matter, edge: float) -> tuple[Matter, np.ndarray]:
    """(What of the body hangs together in every cube of a lattice of this edge [m], as one piece; its number [m] for
    every piece as it was). Volume, centroid and second moment are exact; the owner is that of the nearest piece."""
    x, V, S = (t.numpy() for t in (matter.position, matter.volume, matter.moment))
    links, m = matter.links.numpy(), len(x)
    cube = np.floor((x - x.min(0)) / edge + 1e-6).astype(np.int64)
    inner = (cube[links[:, 0]] == cube[links[:, 1]]).all(1)
    graph = sparse.coo_matrix((np.ones(inner.sum(), bool), links[inner].T), shape=(m, m))
    count, block = sparse.csgraph.connected_components(graph, directed=False)
    gather = sparse.csr_matrix((V, (block, np.arange(m))), shape=(count, m))
    volume = np.asarray(gather.sum(1)).reshape(-1)
    centroid = gather @ x / volume[:, None]
    away = x - centroid[block]
    moment = gather @ (S + away[:, :, None] * away[:, None, :]).reshape(m, 9) / volume[:, None]
    order = np.lexsort((np.linalg.norm(away, axis=1), block))
    nearest = order[np.unique(block[order], return_index=True)[1]]
    between = np.unique(np.sort(block[links[~inner]], 1), axis=0)
    blocks = Matter(
        position=torch.from_numpy(centroid),
        volume=torch.from_numpy(volume),
        moment=torch.from_numpy(moment.reshape(count, 3, 3)),
        owner=matter.owner[nearest],
        links=torch.from_numpy(between[between[:, 0] != between[:, 1]]),
    )
    return blocks, block


def points(matter: Matter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(X [n, 3] m, weight [n] m^3, piece [n]): 14 points of every piece, or 8 where particles have several pieces."""
    value, axes = np.linalg.eigh(matter.moment.numpy())
    root = (axes * np.sqrt(np.maximum(value, 0))[:, None]) @ axes.transpose(0, 2, 1)
    corner = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(8, 3)  # in deviations
    if matter.spacing > 1.5 * matter.size:
        place, share = corner, np.full(8, 1 / 8)
    else:
        half = np.sqrt(3) * np.sqrt(19 / 30) * np.eye(3)  # an edge is twice sqrt(3) deviations
        place = np.concatenate([half, -half, np.sqrt(3) * np.sqrt(19 / 33) * corner])
        share = np.array([320 / 361] * 6 + [121 / 361] * 8) / 8
    X = matter.position.numpy()[:, None] + np.einsum("mij,kj->mki", root, place)
    weight = matter.volume.numpy()[:, None] * share
    return X.reshape(-1, 3), weight.reshape(-1), np.repeat(np.arange(len(X)), len(share))


def with_pieces(
    matter: Matter,
    position: Float[np.ndarray, "n 3"],
    volume: Float[np.ndarray, " n"],
    moment: Float[np.ndarray, "n 3 3"],
    owner: Int[np.ndarray, " n"],
    *,
    reach: float,
) -> Matter:
    """`matter` and n more pieces, linked by their distance: to each other within `reach` [m], to what there is already
    within REACH of its particles."""
    old, m = matter.position.numpy(), len(matter.position)
    own = cKDTree(position)
    pairs = own.query_pairs(reach, output_type="ndarray") + m
    if m:
        beside = own.query_ball_tree(cKDTree(old), REACH * matter.spacing)
        to_old = [np.stack([np.full(len(near), m + i), near], 1) for i, near in enumerate(beside)]
        pairs = np.concatenate([pairs, *to_old])
    more = (position, volume, moment, owner.astype(np.int64), pairs.astype(np.int64).reshape(-1, 2))
    names = ("position", "volume", "moment", "owner", "links")
    return Matter(**{name: torch.cat([getattr(matter, name), torch.from_numpy(a)]) for name, a in zip(names, more)})


def of_owners(matter: Matter, keep: np.ndarray) -> Matter:
    """The pieces of the particles in a mask [p], numbered among these."""
    kept = matter.select(keep[matter.owner.numpy()])
    return replace(kept, owner=torch.from_numpy(np.cumsum(keep) - 1)[kept.owner])
