"""Clusters of points: what hangs together in space, by distance or by voxels."""

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

CORNERS = 1.8  # between voxels that meet at least in a corner (1.73), and not those two apart (2)


def clusters(position: np.ndarray, gap: float) -> np.ndarray:
    """Number [n] of each point's connected piece; neighbours are nearer than `gap` [m], piece 0 has most points."""
    pairs = cKDTree(position).query_pairs(gap, output_type="ndarray")
    n = len(position)
    links = sparse.coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, piece = sparse.csgraph.connected_components(links, directed=False)
    rank = np.argsort(np.argsort(-np.bincount(piece), kind="stable"), kind="stable")
    return rank[piece]


def clusters_of_voxels(point: np.ndarray, size: float) -> np.ndarray:
    """Number [n] of each point's connected set of occupied voxels of that size [m], which may meet in corners only."""
    voxel, of = np.unique(np.floor(point / size).astype(np.int64), axis=0, return_inverse=True)
    return clusters(voxel.astype(float), CORNERS)[of.reshape(-1)]
