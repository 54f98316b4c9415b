"""Mesh collider: a closed triangle mesh that the body runs into, at rest or moving rigidly (a bowl, a foot, a spoon).

The mesh is placed at y = R0 (scale X), x = p(t) + R(t) y, where R0 turns by the vector `rotation`. While
start <= t < start + duration it moves with `velocity` and turns with `angular_velocity` w about `position`; before and
after that it stands still, and from `end` on it is gone:

    p(t) = position + s velocity,   R(t) = exp(s [w]x),   s = min(max(t - start, 0), duration)
    v_c(x) = (p(t + dt) - p(t))/dt + (R(t + dt) R(t)^T - I)/dt (x - p(t))

so that what moves along with it keeps its shape, whatever dt. Nodes in the mesh, phi(y) <= 0, obey the rules of
`half_space` with the normal n = grad phi/|grad phi| and the velocity v - v_c, and where these ask whether a particle
touches, it does with phi <= V_p^(1/3)/2. Where phi has no gradient (a middle surface) nodes stick.

The signed distance phi is sampled once, with half the grid spacing, by Open3D, and interpolated trilinearly; it rides
in `parameters`, the pose in `signals`. What is thinner than two cells may let material through. In a scene:

    boundaries:
      - _target_: physics3d.boundaries.mesh_collider.MeshCollider # a foot that steps onto the bread
        path: shared/foot.stl # closed; .obj, .ply or .stl
        scale: 0.001 # the file is in millimetres
        position: [0.0, 0.0, 0.3] # [m]
        velocity: [0.0, 0.0, -0.2] # [m/s]
        duration: 1.0 # [s]
        kind: separate
        friction: 0.4
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.boundaries import base
from physics3d.boundaries.half_space import Kind, coulomb
from physics3d.checks import Lasting, NotNegative, Positive
from physics3d.open3d_import import open3d
from physics3d.warp_types import matrix, vector, vector4

SUFFIXES = (".obj", ".ply", ".stl")
MOST_SAMPLES = 2**22
HEAD = 10  # parameters before the samples


@dataclass(frozen=True, kw_only=True)
class MeshCollider(base.AbstractBoundary):
    """Solid of a closed mesh: a file, or vertices with triangles. One that stands still costs samples only where it is
    in the simulated region."""

    path: str | None = None  # .obj, .ply or .stl
    vertices: Float[Tensor, "n 3"] | tuple[base.Vector, ...] | None = None  # where there is no file
    triangles: Int[Tensor, "m 3"] | tuple[tuple[int, int, int], ...] | None = None  # rows of `vertices`
    scale: Positive = 1.0  # of the mesh's coordinates to metres
    rotation: base.Vector = (0.0, 0.0, 0.0)  # about the mesh's origin: axis times angle [rad]
    position: base.Vector = (0.0, 0.0, 0.0)  # of the mesh's origin [m]
    velocity: base.Vector = (0.0, 0.0, 0.0)  # [m/s]
    angular_velocity: base.Vector = (0.0, 0.0, 0.0)  # about `position`, which travels along [rad/s]
    start: float = 0.0  # before the first frame: it is under way then [s]
    duration: Lasting = math.inf  # [s]
    end: Lasting = math.inf  # when it is gone [s]
    kind: Kind = "sticky"
    friction: NotNegative = 0.0  # Coulomb coefficient, for slip and separate

    def check(self) -> None:
        super().check()
        if self.path is None:
            for field in ("vertices", "triangles"):
                base.require(getattr(self, field) is not None, self, field, "vertices with triangles, or a path")
            self._mesh()
        else:
            base.require(self.vertices is None, self, "vertices", "none beside a path")
            base.require(self.triangles is None, self, "triangles", "none beside a path")
            base.require(Path(self.path).suffix.lower() in SUFFIXES, self, "path", f"a file of {SUFFIXES}")
            base.require(Path(self.path).is_file(), self, "path", "a file that exists")

    def parameters(self, setting: base.Setting) -> Float[Tensor, " k"]:
        """Corner of the samples (3) [m], 1/h [1/m], samples along each axis (3), friction, the largest phi of a node of
        the mesh and what is forgiven a particle [m]; then phi [m]."""
        vertices, triangles = self._mesh()
        placed = self.scale * vertices @ _turn(np.array(self.rotation)).T
        spacing = setting.dx / 2
        lower, upper = placed.min(0), placed.max(0)
        if not any((*self.velocity, *self.angular_velocity)):
            # no node is asked for that is farther outside than a few cells
            lower = np.maximum(lower, np.array(setting.lower) - self.position - 4 * setting.dx)
            upper = np.minimum(upper, np.array(setting.upper) - self.position + 4 * setting.dx)
            if (lower > upper).any():
                raise ValueError(f"{self._name()} is outside the region {setting.lower} .. {setting.upper} m; move it")
        count = np.ceil((upper - lower) / spacing).astype(int) + 5
        if math.prod(count.tolist()) > MOST_SAMPLES:
            across = " x ".join(map(str, count))
            raise ValueError(
                f"{self._name()} needs {across} samples of its distance, {spacing:g} m apart; take a smaller mesh, "
                "a smaller scale or a larger world.dx (or, if it stands still, a smaller region)"
            )
        corner = lower - 2 * spacing  # a particle touches from half its edge away
        samples = _distance(
            placed.tobytes(), triangles.tobytes(), tuple(corner.tolist()), tuple(count.tolist()), spacing
        )
        # what is on the surface belongs to the mesh whatever the rounding
        slack = 1e-3 * setting.dx
        reach = base.NEAREST * setting.dx if self.kind == "separate" else slack
        head = [*corner, 1 / spacing, *count, self.friction, reach, slack]
        return torch.cat([torch.tensor(head, dtype=torch.float64), samples.to(torch.float64)])

    def signals(self, t: float, dt: float) -> tuple[float, ...]:
        """p (3) [m], R (9), and of the velocity v_c: (p(t + dt) - p)/dt (3) [m/s], (R(t + dt) R^T - I)/dt (9) [1/s];
        1 while it is there"""
        axis = np.array(self.angular_velocity)
        now = min(max(t - self.start, 0.0), self.duration)
        share = base.overlap(self.start, self.duration, t, dt)
        if dt > 0:
            gradient = (_turn(share * dt * axis) - np.eye(3)) / dt
        else:
            share = float(self.start <= t < self.start + self.duration)
            gradient = share * _cross(axis)
        velocity = np.array(self.velocity)
        place = np.array(self.position) + now * velocity
        return (*place, *_turn(now * axis).flat, *(share * velocity), *gradient.flat, float(t < self.end))

    def behind(self, setting: base.Setting) -> Float[Tensor, " p"]:
        vertices, triangles = self._mesh()
        placed = self.scale * vertices @ _turn(np.array(self.rotation)).T
        pose = np.array(self.signals(0.0, 0.0))
        places = (setting.position.numpy() - pose[:3]) @ pose[3:12].reshape(3, 3)  # rows: R^T (x - p)
        return -torch.from_numpy(_signed_distance(placed, triangles, placed.mean(0), places)).double()

    def node(self, real: type) -> wp.Function:
        return _node(real, self.kind)

    def touch(self, real: type) -> wp.Function | None:
        return _touch(real) if self.kind == "separate" else None

    def _name(self) -> str:
        return f"MeshCollider {self.path or 'of vertices and triangles'}"

    def _mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """(vertices [n, 3] float64, triangles [m, 3] int32), closed."""
        if self.path is not None:
            return _read(self.path, Path(self.path).stat().st_mtime_ns)
        vertices, triangles = self._rows("vertices"), self._rows("triangles")
        known = bool(np.isin(triangles, range(len(vertices))).all())
        base.require(known, self, "triangles", f"whole numbers from 0 to {len(vertices) - 1}")
        return _closed(self._name(), vertices, triangles.astype(np.int32))

    def _rows(self, field: str) -> np.ndarray:
        try:
            rows = np.asarray(getattr(self, field), dtype=np.float64)
        except (TypeError, ValueError):
            rows = np.zeros(0)
        right = rows.ndim == 2 and len(rows) > 0 and rows.shape[1] == 3 and bool(np.isfinite(rows).all())
        base.require(right, self, field, "rows of three finite numbers")
        return rows


def _closed(name: str, vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh; raises ValueError unless it has an inside, which it has if no edge ends a surface."""
    _, place = np.unique(vertices, axis=0, return_inverse=True)  # .stl files repeat a vertex in every triangle
    corners = place.reshape(-1)[triangles]
    corners = corners[(corners != np.roll(corners, 1, 1)).all(1)]
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    shared = np.unique(edges, axis=0, return_counts=True)[1] if len(edges) else np.zeros(0)
    ends = int((shared % 2).sum())
    if ends or not len(shared):
        raise ValueError(
            f"{name} is not closed: {ends} of {len(shared)} edges belong to an odd number of triangles; take a mesh "
            "without holes (close it in Blender or MeshLab)"
        )
    return vertices, triangles


@functools.lru_cache(maxsize=8)
def _read(path: str, changed: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = open3d().io.read_triangle_mesh(path)
    vertices, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.triangles, dtype=np.int32)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise ValueError(f"MeshCollider.path is {path}, which holds no mesh of finite triangles; take another file")
    return _closed(f"MeshCollider {path}", vertices, triangles)


@functools.lru_cache(maxsize=4)
def _distance(
    vertices: bytes, triangles: bytes, corner: base.Vector, count: tuple[int, int, int], spacing: float
) -> Float[Tensor, " k"]:
    """Signed distance [m], below 0 inside, at count[0] x count[1] x count[2] places from the corner on."""
    axes = [np.arange(n, dtype=np.float32) * np.float32(spacing) for n in count]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points, faces = np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(triangles, np.int32).reshape(-1, 3)
    return torch.from_numpy(_signed_distance(points, faces, np.array(corner), places, relative=True))


def _signed_distance(
    vertices: np.ndarray, triangles: np.ndarray, origin: np.ndarray, places: np.ndarray, relative: bool = False
) -> np.ndarray:
    """Distance [m] of places [k, 3] from a closed mesh, below 0 inside; they count from the origin if `relative`."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    # float32 rays: small numbers keep their digits
    points = (vertices - origin).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(points), o3d.core.Tensor(triangles.astype(np.uint32)))
    local = np.ascontiguousarray(places if relative else places - origin, np.float32)
    # rays through edges may be counted twice: three samples outvote one
    distance = scene.compute_signed_distance(o3d.core.Tensor(local), nthreads=1, nsamples=3).numpy()
    return distance.copy()  # kept for long, and Open3D lets a process fail that ends while its own memory is in use


def _cross(w: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def _turn(w: np.ndarray) -> np.ndarray:
    """exp([w]x), by Rodrigues' formula."""
    angle = float(np.linalg.norm(w))
    if angle == 0.0:
        return np.eye(3)
    K = _cross(w / angle)
    return np.eye(3) + math.sin(angle) * K + 2 * math.sin(angle / 2) ** 2 * (K @ K)


@functools.cache
def _field(real: type) -> tuple[wp.Function, wp.Function]:
    """Warp functions matrix_at(clock, row, b), and field(x, q, a, clock, row, b): the gradient of phi and phi [m] at x;
    (0, 0, 0) and infinity away from the samples, and where the mesh is gone."""
    vec3, vec4, mat33 = vector(real), vector4(real), matrix(real)

    @wp.func
    def lookup(i: int, j: int, k: int, q: wp.array(dtype=real), a: int):
        return q[a + wp.static(HEAD) + (i * int(q[a + 5]) + j) * int(q[a + 6]) + k]

    @wp.func
    def blend(s: real, low: real, high: real):
        return low + s * (high - low)

    @wp.func
    def matrix_at(clock: wp.array2d(dtype=real), row: int, b: int):
        return mat33(
            clock[row, b], clock[row, b + 1], clock[row, b + 2],
            clock[row, b + 3], clock[row, b + 4], clock[row, b + 5],
            clock[row, b + 6], clock[row, b + 7], clock[row, b + 8],
        )  # fmt: skip

    @wp.func
    def field(x: vec3, q: wp.array(dtype=real), a: int, clock: wp.array2d(dtype=real), row: int, b: int):
        found = vec4(real(0.0), real(0.0), real(0.0), real(wp.inf))
        r = x - vec3(clock[row, b], clock[row, b + 1], clock[row, b + 2])
        R = matrix_at(clock, row, b + 3)
        c = q[a + 3] * (wp.transpose(R) * r - vec3(q[a], q[a + 1], q[a + 2]))  # place among the samples
        i, j, k = int(wp.floor(c[0])), int(wp.floor(c[1])), int(wp.floor(c[2]))
        if (
            clock[row, b + 24] > real(0.0)
            and i >= 0 and j >= 0 and k >= 0
            and i < int(q[a + 4]) - 1 and j < int(q[a + 5]) - 1 and k < int(q[a + 6]) - 1
        ):  # fmt: skip
            s = c - vec3(real(i), real(j), real(k))
            # the eight samples around, blended along z, then along y, then along x
            z00, z01 = lookup(i, j, k, q, a), lookup(i, j, k + 1, q, a)
            z10, z11 = lookup(i, j + 1, k, q, a), lookup(i, j + 1, k + 1, q, a)
            w00, w01 = lookup(i + 1, j, k, q, a), lookup(i + 1, j, k + 1, q, a)
            w10, w11 = lookup(i + 1, j + 1, k, q, a), lookup(i + 1, j + 1, k + 1, q, a)
            y0, y1 = blend(s[2], z00, z01), blend(s[2], z10, z11)
            u0, u1 = blend(s[2], w00, w01), blend(s[2], w10, w11)
            x0, x1 = blend(s[1], y0, y1), blend(s[1], u0, u1)
            along_z = blend(s[0], blend(s[1], z01 - z00, z11 - z10), blend(s[1], w01 - w00, w11 - w10))
            slope = R * (q[a + 3] * vec3(x1 - x0, blend(s[0], y1 - y0, u1 - u0), along_z))
            found = vec4(slope[0], slope[1], slope[2], blend(s[0], x0, x1))
        return found

    return matrix_at, field


@functools.cache
def _touch(real: type) -> wp.Function:
    vec3 = vector(real)
    _, field = _field(real)

    @wp.func(name=f"mesh_collider_touch_{real.__name__}")
    def touch(
        x: vec3,
        radius: real,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        return field(x, q, a, clock, row, b)[3] <= radius + q[a + 9]

    return touch


@functools.cache
def _node(real: type, kind: str) -> wp.Function:
    vec3 = vector(real)
    friction = coulomb(real)
    matrix_at, field = _field(real)
    sticky, separate = kind == "sticky", kind == "separate"

    @wp.func(name=f"mesh_collider_{kind}_{real.__name__}")
    def node(
        x: vec3,
        v: vec3,
        q: wp.array(dtype=real),
        a: int,
        clock: wp.array2d(dtype=real),
        row: int,
        b: int,
    ):
        result = v
        found = field(x, q, a, clock, row, b)
        if found[3] <= q[a + 8]:
            carried = vec3(clock[row, b + 12], clock[row, b + 13], clock[row, b + 14])
            r = x - vec3(clock[row, b], clock[row, b + 1], clock[row, b + 2])
            carried = carried + matrix_at(clock, row, b + 15) * r
            result = carried
            slope = vec3(found[0], found[1], found[2])
            steep = wp.length(slope)
            if wp.static(not sticky) and steep > real(0.1):
                n = slope / steep
                relative = v - carried
                vn = wp.dot(n, relative)
                result = carried + friction(relative - vn * n, wp.abs(vn), q[a + 7])
                if wp.static(separate) and vn >= real(0.0):
                    result = v
        return result

    return node
