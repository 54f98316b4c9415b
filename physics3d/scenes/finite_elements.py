"""How a twin moves by finite elements, so that no solver of the pipeline judges its own work.

Quadratic tetrahedra (ten nodes, four points of integration) on a mesh that fits the solids: fTetWild makes the mesh,
scikit-fem the basis. What is shared with the solvers is the constitutive function alone, asked at the points with
F = I + grad u; the discretisation is theirs.

    int rho N (a - b) dV + int grad N : P(F) dV = 0,    b = force / mass of the part that is pushed

in time by the implicit midpoint rule, x = (u_n + u_n+1)/2, and Broyden's method on the exact tangent of an earlier
state, factored again where that has become too slow. The mesh follows the faces of the boxes that hold the body, and
has nothing inside of them, so that they are where they are written.
"""

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.modes.stress import Points
from physics3d.modes.vibration import Factor, modes, stiffness
from physics3d.scenes.studio import Mesh
from physics3d.scenes.synthetic import within
from physics3d.world import World

SAME = 1e-7  # distance of vertices that are one [m]
TOLERANCE = 1e-5  # of the force out of balance, of the largest inertia of the motion
MOST_ITERATIONS = 60
SLOW = 20  # iterations after which a new tangent is factored


Still = Callable[[Float[np.ndarray, "n 3"]], np.ndarray]  # which of these places [m] are held: bool [n]


@dataclass(frozen=True)
class Body:
    """Tetrahedra of the part of a body that is not held: nodes of their own, `basis` is scikit-fem's."""

    basis: Any
    still: Still
    held: Int[np.ndarray, " h"]  # nodes
    gradient: sparse.csr_matrix  # [3 n, nodes] of the functions at the points [1/m]
    value: sparse.csr_matrix  # [n, nodes] of the functions at the points
    place: Float[np.ndarray, "n 3"]  # of the points [m]
    weight: Float[np.ndarray, " n"]  # of the points [m^3]

    @property
    def mass(self) -> sparse.csr_matrix:
        """[nodes, nodes], of a density of one [m^3]."""
        return (self.value.T @ sparse.diags(self.weight) @ self.value).tocsr()


def meshed(solids: Sequence[Mesh], world: World, edge: float) -> Body:
    """The part of the solids that is not held, in tetrahedra with edges of about `edge` [m].

    Raises ValueError where something else than regions that are held bounds the world, or it has gravity, and
    ImportError without pytetwild (`pip install pytetwild pyvista`)."""
    import pytetwild
    import pyvista
    from skfem import MeshTet

    boxes = _held(world)
    surfaces = [pyvista.make_tri_mesh(solid.vertices.astype(float), solid.faces) for solid in solids]
    surfaces = [s.clean(tolerance=SAME, absolute=True) for s in surfaces]  # rounding parts what meets on an axis
    # inside is to the mesher what faces go round outwards
    surfaces = [s if _volume(s) > 0 else s.flip_faces() for s in surfaces]
    around = np.array([s.bounds for s in surfaces]).reshape(-1, 3, 2)
    lower, upper = around[..., 0].min(0) - edge, around[..., 1].max(0) + edge
    for box in boxes:  # the mesher follows all faces that it is given
        near = np.clip(box, lower, upper)
        if (near[0] < near[1]).all():
            surfaces.append(pyvista.Cube(bounds=near.T.ravel()).triangulate().clean())
    corners = np.concatenate([np.asarray(s.points, float) for s in surfaces])
    first = np.cumsum([0] + [s.n_points for s in surfaces])
    faces = np.concatenate([s.regular_faces + i for s, i in zip(surfaces, first)]).astype(np.int32)
    across = float(np.linalg.norm(corners.max(0) - corners.min(0)))
    with tempfile.TemporaryDirectory() as notes, contextlib.chdir(notes):  # fTetWild leaves a file where it runs
        nodes, cells = pytetwild.tetrahedralize(corners, faces, edge_length_fac=edge / across, optimize=True)[:2]
    middle = nodes[cells].mean(1)
    cells = cells[within(list(solids), middle) & ~_inside(boxes, middle)]
    mesh = MeshTet(np.ascontiguousarray(nodes.T), np.ascontiguousarray(cells.T)).remove_unused_nodes()
    return on(mesh, lambda x: _inside(boxes, x, 0.02 * edge))  # the mesh follows their faces to a thousandth


def on(mesh: Any, still: Still) -> Body:
    """A body of scikit-fem's tetrahedra, held at those of its nodes that are `still`."""
    from skfem import Basis, ElementTetP2

    basis = Basis(mesh, ElementTetP2(), intorder=2)
    n = basis.dx.size
    local = [basis.basis[j][0] for j in range(basis.Nbfun)]  # value [cell, point], gradient [3, cell, point]
    column = np.stack([np.broadcast_to(dofs[:, None], basis.dx.shape) for dofs in basis.element_dofs])
    row = np.broadcast_to(np.arange(n).reshape(basis.dx.shape), column.shape)
    value = sparse.coo_matrix(
        (np.stack([np.broadcast_to(f.value, basis.dx.shape) for f in local]).ravel(), (row.ravel(), column.ravel())),
        shape=(n, basis.N),
    )
    slope = sparse.coo_matrix(
        (
            np.stack([np.broadcast_to(f.grad, (3, *basis.dx.shape)) for f in local], 1).ravel(),
            (np.stack([3 * row + a for a in range(3)]).ravel(), np.stack([column] * 3).ravel()),
        ),
        shape=(3 * n, basis.N),
    )
    nodes = basis.doflocs.T
    return Body(
        basis=basis,
        still=still,
        held=np.flatnonzero(still(nodes)),
        gradient=slope.tocsr(),
        value=value.tocsr(),
        place=np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1).reshape(-1, 3),
        weight=basis.dx.ravel(),
    )


def _volume(surface: Any) -> float:
    """Signed volume [m^3] of pyvista's closed triangles: negative where they go round inwards."""
    a, b, c = np.moveaxis(np.asarray(surface.points)[surface.regular_faces], 1, 0)
    return float((a * np.cross(b, c)).sum()) / 6


def _held(world: World) -> list[Float[np.ndarray, "2 3"]]:
    """The boxes [m] that hold the body still."""
    if any(world.gravity) or not all(isinstance(one, FixedRegion) for one in world.boundaries) or not world.boundaries:
        raise ValueError(
            f"source.world has boundaries {world.boundaries} and gravity {world.gravity}; finite elements are made for "
            "bodies without weight that a FixedRegion holds"
        )
    return [np.array([one.lower, one.upper], float) for one in world.boundaries if isinstance(one, FixedRegion)]


def _inside(boxes: Sequence[Float[np.ndarray, "2 3"]], x: Float[np.ndarray, "n 3"], more: float = 0.0) -> np.ndarray:
    """Bool [n]: places in any of the boxes, `more` [m] larger on all sides."""
    return np.any([((x >= lower - more) & (x <= upper + more)).all(1) for lower, upper in boxes], 0)


def frequencies(body: Body, world: World, count: int) -> list[float]:
    """The lowest frequencies [Hz] of the body with all branches stuck."""
    _, K, M = _linear(body, world)
    free = _free(body)
    found = modes(K[free][:, free].tocsr(), M[free][:, free].tocsr(), count, shift=1.0)[0]
    return [float(f) for f in np.sqrt(found) / (2 * np.pi)]


def swing(
    body: Body, world: World, excitation: tuple[AbstractBoundary, ...], *, frames: int, fps: float, steps: int, log
) -> Float[np.ndarray, "t nodes 3"]:
    """Displacement [m] of the nodes at the frames, from rest; `steps` time steps to a frame.

    Raises ValueError where the excitation is something else than one Impulse with a force on a ball or a box, and
    where Newton's method finds no step."""
    points, _, M = _linear(body, world)
    push, load = _load(body, world, excitation)
    free = _free(body)
    dt = 1 / (fps * steps)
    mass = M[free][:, free].tocsr()
    u, v = np.zeros(M.shape[0]), np.zeros(M.shape[0])
    films = [u.reshape(-1, 3).copy()]
    factor, after, scale = None, dt / 2, 0.0

    def out_of_balance(x: np.ndarray, signal: float, after: float) -> np.ndarray:
        P = points.stress((body.gradient @ x.reshape(-1, 3)).reshape(-1, 3, 3), after)
        inertia = M @ ((4 / dt**2) * (x - u) - (2 / dt) * v)
        return (inertia + (body.gradient.T @ P.reshape(-1, 3)).ravel() - signal * load)[free]

    for frame in log.progress(range(1, frames), "finite elements"):
        for k in range(steps):
            signal = push.signals(((frame - 1) * steps + k) * dt, dt)[0]
            x = u + 0.5 * dt * v
            rest = out_of_balance(x, signal, after)
            scale = max(scale, float(np.linalg.norm(signal * load)), float(np.linalg.norm(rest)))
            ways: list[np.ndarray] = []
            for iteration in range(MOST_ITERATIONS):
                if np.linalg.norm(rest) <= TOLERANCE * scale:
                    break
                if factor is None or (iteration and iteration % SLOW == 0):
                    D = points.tangent((body.gradient @ x.reshape(-1, 3)).reshape(-1, 3, 3), after)
                    K = stiffness(body.gradient, D)[free][:, free]
                    factor = Factor((K + (4 / dt**2) * mass).tocsr())
                    ways = []
                way = -factor(rest)
                for s, t in itertools.pairwise(ways):  # Broyden's good update
                    way += t * (s @ way) / (s @ s)
                if ways:
                    way /= 1 - (ways[-1] @ way) / (ways[-1] @ ways[-1])
                ways.append(way)
                x = x.copy()
                x[free] += way
                rest = out_of_balance(x, signal, after)
            else:
                raise ValueError(f"finite elements find no step in frame {frame}; take more steps to a frame")
            points.keep()
            u, v = 2 * x - u, (4 / dt) * (x - u) - v
            after = dt
        films.append(u.reshape(-1, 3).copy())
    return np.stack(films)


def carried(
    body: Body, films: Float[np.ndarray, "t nodes 3"], place: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "t p 3"], Float[np.ndarray, "t p 3 3"]]:
    """(position [m], F) of what is at `place` [m] at rest: that of its tetrahedron, at rest where it is held."""
    from scipy.spatial import cKDTree

    basis = body.basis
    mesh, element = basis.mesh, basis.elem
    middles = mesh.p[:, mesh.t].mean(1).T
    near = cKDTree(middles).query(place, k=min(24, len(middles)))[1]
    local = np.stack([mesh.mapping().invF(place.T[:, :, None], near[:, k])[:, :, 0] for k in range(near.shape[1])], 1)
    share = np.concatenate([local, 1 - local.sum(0, keepdims=True)])  # [4, k, p], all positive inside
    best = share.min(0).argmax(0)
    cell = near[np.arange(len(place)), best]
    X = local[:, best, np.arange(len(place))]
    stays = body.still(place)
    x = np.broadcast_to(place, (len(films), *place.shape)).copy()
    F = np.broadcast_to(np.eye(3), (len(films), len(place), 3, 3)).copy()
    slope = np.linalg.inv(np.moveaxis(mesh.mapping().DF(np.zeros((3, 1)), tind=cell)[..., 0], -1, 0))  # [p, a, i]
    for j in range(basis.Nbfun):
        value, gradient = element.lbasis(X, j)
        u = films[:, basis.element_dofs[j, cell]]
        x += np.where(stays[:, None], 0.0, value[:, None] * u)
        down = np.einsum("ap,pai->pi", gradient, slope)
        F += np.where(stays[:, None, None], 0.0, u[..., :, None] * down[:, None, :])
    return x, F


def _linear(body: Body, world: World) -> tuple[Points, sparse.csr_matrix, sparse.csr_matrix]:
    """(points at rest, K with all branches stuck, M) of the nodes, components of a node beside each other."""
    material = world.material
    values = {name: torch.tensor(float(value), dtype=torch.float64) for name, value in world.start.items()}
    one = material.coefficients(values).numpy()
    n = len(body.weight)
    points = Points(material, np.repeat(one.reshape(len(one), 1), n, 1), body.weight)
    tangent = points.tangent(np.zeros((n, 3, 3)), 1e-12)
    K = sparse.csr_matrix(stiffness(body.gradient, tangent))
    M = sparse.kron(world.density * body.mass, sparse.identity(3)).tocsr()
    return points, K, M


def _free(body: Body) -> Int[np.ndarray, " f"]:
    free = np.setdiff1d(np.arange(body.gradient.shape[1]), body.held)
    return (3 * free[:, None] + np.arange(3)).ravel()


def _load(body: Body, world: World, excitation: tuple[AbstractBoundary, ...]) -> tuple[Impulse, np.ndarray]:
    """(the push, its force on the nodes [N])."""
    push = excitation[0] if len(excitation) == 1 else None
    if not isinstance(push, Impulse) or push.nearest is not None or push.force is None:
        raise ValueError(
            f"the excitation is {excitation}; finite elements are made for one Impulse: a force on a ball or a box"
        )
    place, weight = torch.from_numpy(body.place), torch.from_numpy(body.weight)
    every = (float("-inf"),) * 3, (float("inf"),) * 3
    setting = Setting(
        position=place, mass=world.density * weight, volume=weight, lower=every[0], upper=every[1], dx=world.dx
    )
    inside = push.selection(setting).numpy()
    share = body.weight * inside / (body.weight * inside).sum()
    return push, np.outer(body.value.T @ share, np.asarray(push.force, float)).ravel()
