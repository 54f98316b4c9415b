"""Which points lie inside the closed surface through oriented samples: `Poisson`, or `WindingNumber`.

Poisson reconstruction: Kazhdan, Hoppe (2013). Winding numbers: Barill et al. (2018). All lengths in metres.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from physics3d.checks import Share
from physics3d.filling.sheets import sample_area
from physics3d.filling.surface import Surface
from physics3d.open3d_import import open3d


class AbstractSolid:
    """Which points lie inside the closed surface through oriented samples. A frozen dataclass."""

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        """A function [m, 3] -> bool [m]."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Poisson(AbstractSolid):
    """Inside the screened Poisson surface of the samples that bound a volume. Closes missing caps."""

    enclosure: Share = 0.4  # least share of directions in which a point inside must meet the surface

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        chosen = ~surface.thin & ~surface.hidden
        if chosen.sum() < 50:
            return lambda x: np.zeros(len(x), bool)
        o3d = open3d()
        point = surface.point[chosen]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(point))
        cloud.normals = o3d.utility.Vector3dVector(surface.normal[chosen])
        # finest octree cell of about half a spacing, as dense as the samples are
        depth = int(np.clip(np.ceil(np.log2(1.1 * np.ptp(point, 0).max() / (0.5 * spacing))), 4, 9))
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        lower, upper = surface.point.min(0), surface.point.max(0)

        def inside(x: np.ndarray) -> np.ndarray:
            found = ((x >= lower) & (x <= upper)).all(1)
            at = np.flatnonzero(found)
            if len(at):
                occupied = scene.compute_occupancy(o3d.core.Tensor(x[at].astype(np.float32)), nthreads=1, nsamples=3)
                found[at] = (occupied.numpy() > 0.5) & (surface.enclosure.share(x[at]) >= self.enclosure)
            return found

        return inside


@dataclass(frozen=True, kw_only=True)
class WindingNumber(AbstractSolid):
    """w(q) = sum_i a_i n_i . (p_i - q) / (4 pi |p_i - q|^3) > 1/2 (Barill et al. 2018), summed directly.

    No mesh and no Open3D; gentle with gaps; cost = samples x points, a minute for large bodies at fine spacing.
    """

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        chosen = ~surface.thin & ~surface.hidden
        point, normal = surface.point[chosen], surface.normal[chosen]
        if len(point) < 50:
            return lambda x: np.zeros(len(x), bool)
        area = sample_area(point, normal, spacing, cKDTree(point))
        origin = point.mean(0)  # float32 is enough, and half the traffic, near the origin
        p = torch.from_numpy(point - origin).float()
        weighted = torch.from_numpy(normal * area[:, None] / (4 * np.pi)).float()
        through = (weighted * p).sum(1)

        def inside(x: np.ndarray) -> np.ndarray:
            found = np.zeros(len(x), bool)
            chunk = max(1, 1_000_000 // len(p))
            for start in range(0, len(x), chunk):
                q = torch.from_numpy(x[start : start + chunk] - origin).float()
                # a sample nearer than half a spacing is a disc, not a point
                r = torch.cdist(q, p).clamp(min=spacing / 2)
                found[start : start + chunk] = ((through - q @ weighted.T) / r**3).sum(1).numpy() > 0.5
            return found

        return inside
