"""What a body stands on or leans against: it bounds the body where no camera looks.

The surface of the static Gaussians around it, as cameras see them (`seen.py`), closed under the body by Poisson
reconstruction.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.filling.seen import seen
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.open3d_import import open3d

GROUND = 0.5  # how far around the body static Gaussians are looked at, of its size
LEAST_GROUND = 100  # of them
DOUBT = 0.5  # slope that the ground may have where nothing shows it
Depth = Callable[[np.ndarray], np.ndarray]  # of points [m, 3] [m] -> [m] [m]


@dataclass(frozen=True)
class Ground:
    """What the body stands on or leans against: a surface closed under the body."""

    behind: Depth  # how deep points lie, along the normal of the nearest triangle
    doubt: Depth  # by how much that may be wrong: a share of the way to where the ground is seen
    hidden: np.ndarray  # [k, 3] points of it that no camera sees [m]
    normal: np.ndarray  # [k, 3] there, out of the ground


def ground(
    gaussians: Gaussians,
    label: Int[Tensor, " n"],
    cameras: Sequence[Camera],
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    spacing: float,
    opacity: float,
    log: Log,
) -> Ground | None:
    """Of what is static, label 0 and above this `opacity`, around the box of a body [m]; None if there is too little.

    It is seen at half the resolution of the body, whose particles are `spacing` [m] apart.
    """
    reach = GROUND * float((upper - lower).max())
    box = dict(lower=lower - reach, upper=upper + reach)
    mean = gaussians.mean.double().cpu().numpy()
    around = ((mean > box["lower"]) & (mean < box["upper"])).all(1)
    static = mean[around & ((label == 0) & (gaussians.opacity > opacity)).cpu().numpy()]
    if len(static) < LEAST_GROUND:
        return None
    view = seen(gaussians, (label == 0).int(), cameras, **box, spacing=2 * spacing, log=log)
    point, normal, found = view.settled(static, 4 * spacing)
    found &= view.deep(point - 1.5 * view.truncation * normal)  # not a sheet with a view of its other side
    if found.sum() < LEAST_GROUND:
        return None
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(point[found]))
    cloud.normals = o3d.utility.Vector3dVector(normal[found])
    depth = int(np.clip(np.ceil(np.log2((upper - lower + 2 * reach).max() / (2 * spacing))), 6, 8))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    # the largest piece: the others are bubbles round strays
    of, _, area = (np.asarray(a) for a in mesh.cluster_connected_triangles())
    mesh.remove_triangles_by_mask(of != area.argmax())
    mesh.remove_unreferenced_vertices()
    mesh.compute_vertex_normals()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))

    def behind(x: np.ndarray) -> np.ndarray:
        nearest = scene.compute_closest_points(o3d.core.Tensor(x.astype(np.float32)), nthreads=1)
        return -((x - nearest["points"].numpy()) * nearest["primitive_normals"].numpy()).sum(1)

    known = cKDTree(point[found])
    doubt = lambda x: DOUBT * known.query(x)[0]
    vertex, outward = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    hidden = view.deep(vertex) & ((vertex > lower) & (vertex < upper)).all(1)
    return Ground(behind=behind, doubt=doubt, hidden=vertex[hidden], normal=outward[hidden])
