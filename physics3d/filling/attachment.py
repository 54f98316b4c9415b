"""Where a body is attached: the particles beside Gaussians that do not move (a stem in its soil)."""

import math

import numpy as np
import torch
from scipy.spatial import Delaunay, cKDTree

from physics3d.clusters import clusters, clusters_of_voxels
from physics3d.filling.surface import over_discs
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log

CONTACT = (0.6, 1.0)  # particles nearer to a static Gaussian are held by it; at most, where none is so near [spacings]
FLAT = 1 / 3  # of its width: what is no thicker is one layer, the wall of a pot around its soil as well
SPECK = 0.05  # static clusters of less than this share are mistakes of the segmentation and hold nothing


def attached_particles(
    position: np.ndarray, spacing: float, static: Gaussians, log: Log, *, sure: bool = False
) -> np.ndarray:
    """Bool [p]: particles within CONTACT spacings of static Gaussians that are part of more than a speck, or of any
    where it is `sure` that they are static.

    A flat contact also holds what lies within its outline: of a stem in its soil only the rim touches what is seen.
    """
    attached = np.zeros(len(position), bool)
    if len(static):
        least, reach = (c * spacing for c in CONTACT)
        whole = np.ones(len(static), bool) if sure else not_specks(static.mean.double().numpy(), 4 * spacing)
        solid = static.select(torch.from_numpy(whole))
        point, _ = over_discs(solid, spacing / 2)
        near = ((point > position.min(0) - reach) & (point < position.max(0) + reach)).all(1)
        if near.any():
            distance, _ = cKDTree(point[near]).query(position)
            attached = distance < min(max(least, 1.3 * distance.min()), reach)
    if not attached.any():
        log.metric("attached", 0)
        log.info("nothing static touches the body: it is held by what scene.boundaries hold, if anything")
        return attached
    where = position[attached]
    patch = clusters(where, 3 * spacing)
    for k in range(int(patch.max()) + 1):
        attached |= within_outline(position, where[patch == k], spacing)
    log.metric("attached", int(attached.sum()))
    where = position[attached]
    patch = clusters(where, 3 * spacing)
    for k in range(min(int(patch.max()) + 1, 8)):
        at = ", ".join(f"{v:.3f}" for v in where[patch == k].mean(0))
        log.info(f"attached at ({at}) m: {int((patch == k).sum())} particles beside static Gaussians are held there")
    if patch.max() >= 8:
        log.info(f"and at {int(patch.max()) - 7} smaller places")
    return attached


def within_outline(position: np.ndarray, patch: np.ndarray, spacing: float) -> np.ndarray:
    """Bool [p]: inside the convex outline of a flat patch [k, 3], in its own layer; of no use where it is not flat.

    The layer is the slab whose second moment is the patch's: one particle of a hundred that touches the rim of a pot
    above the soil, or a leaf's tip that lies on it, does not raise what holds the stem."""
    if len(patch) < 4:
        return np.zeros(len(position), bool)
    centre = patch.mean(0)
    _, size, axes = np.linalg.svd(patch - centre, full_matrices=False)
    thin = size[2] <= max(spacing * np.sqrt(len(patch)), FLAT * size[1])
    if not thin or size[1] < 1e-3 * size[0]:
        return np.zeros(len(position), bool)
    local, all_of_them = (patch - centre) @ axes.T, (position - centre) @ axes.T
    inside = Delaunay(local[:, :2]).find_simplex(all_of_them[:, :2]) >= 0
    half = math.sqrt(3 * (local[:, 2] ** 2).mean()) + spacing / 4
    return inside & (np.abs(all_of_them[:, 2]) <= half)


def not_specks(point: np.ndarray, size: float) -> np.ndarray:
    """Bool [n]: points of clusters of voxels of that size [m] that hold at least the share SPECK of all points."""
    cluster = clusters_of_voxels(point, size)
    return (np.bincount(cluster) >= SPECK * len(point))[cluster]
