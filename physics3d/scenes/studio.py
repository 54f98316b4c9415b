"""A photographer's studio made by code: triangle meshes, ray traced, so that photographs can have known cameras.

Nothing here knows Gaussians: what is reconstructed from these pictures was not drawn with the same tool. Per pixel
2 x 2 rays; at each hit, in linear light,

    C = albedo * [ sun * visible * (max(0, n.l) + translucency max(0, -n.l))
                   + ambient(n) * (open + (1 - open) * BOUNCE * albedo) ]

where `open` is the share of the sky over a vertex, baked once with a few rays over the hemisphere, so that it is the
same from every side, and `visible` is one shadow ray towards a sun of about a degree.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.open3d_import import open3d

SUPERSAMPLES = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))  # positions in a pixel [px]
SUN_SPREAD = 0.012  # half the angle that the sun's four samples span [rad]
BOUNCE = 0.9  # brightness of what covers a vertex, taken to have its own colour, relative to the open sky
OFFSET = 2e-4  # shadow rays start this far off the surface [m]


@dataclass(frozen=True, kw_only=True)
class Mesh:
    vertices: Float32[np.ndarray, "v 3"]  # [m]
    faces: Int32[np.ndarray, "f 3"]
    albedo: Float32[np.ndarray, "v 3"]  # linear reflectance, 0..1
    translucency: float = 0.0  # share of the light on the far side that comes through
    moves: bool = False  # carried by the simulation
    anchor: tuple[float, float, float] | None = (
        None  # carried as one piece by what is near here [m]; None: each by its own
    )
    paint: Callable[[np.ndarray], np.ndarray] | None = (
        None  # positions [n, 3] -> factor [n, 3] on albedo; fixed meshes only
    )


@dataclass(frozen=True, kw_only=True)
class Light:
    to_sun: tuple[float, float, float] = (-0.45, -0.6, 0.85)  # direction, any length
    sun: tuple[float, float, float] = (1.55, 1.48, 1.36)  # irradiance / pi, linear
    sky: tuple[float, float, float] = (0.62, 0.66, 0.74)  # ambient from above
    ground: tuple[float, float, float] = (0.36, 0.33, 0.30)  # ambient from below
    backdrop: tuple[float, float, float] = (1.0, 1.0, 1.0)  # sRGB of rays that hit nothing


class Studio:
    """Meshes under one light. Ambient openness is baked when it is made (rays per vertex: `openness_rays`)."""

    def __init__(self, meshes: list[Mesh], light: Light, *, openness_rays: int, seed: int):
        self.light = light
        self.vertices = np.concatenate([m.vertices for m in meshes]).astype(np.float32)
        starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        self.faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts)]).astype(np.int32)
        self.albedo = np.concatenate([m.albedo for m in meshes]).astype(np.float32)
        self.translucency = np.concatenate([np.full(len(m.faces), m.translucency, np.float32) for m in meshes])
        self.moves = np.concatenate([np.full(len(m.vertices), m.moves) for m in meshes])
        self._anchors = np.concatenate(
            [m.vertices if m.anchor is None else np.broadcast_to(m.anchor, m.vertices.shape) for m in meshes]
        ).astype(np.float32)
        self.owner = np.concatenate([np.full(len(m.faces), i) for i, m in enumerate(meshes)])
        self.paints = {i: m.paint for i, m in enumerate(meshes) if m.paint is not None}
        sun = np.asarray(light.to_sun, np.float32)
        sun = sun / np.linalg.norm(sun)
        side = np.cross(sun, np.eye(3)[np.abs(sun).argmin()]).astype(np.float32)
        side /= np.linalg.norm(side)
        across = np.cross(sun, side)
        suns = [sun + SUN_SPREAD * (a * side + b * across) for a, b in ((-1, -0.4), (0.4, -1), (-0.4, 1), (1, 0.4))]
        self.suns = [s / np.linalg.norm(s) for s in suns]
        self.openness = self._bake(openness_rays, np.random.default_rng(seed))

    def anchors(self) -> Float32[np.ndarray, "m 3"]:
        """Where the particles that carry each moving vertex are looked for [m]."""
        return self._anchors[self.moves]

    def rest(self) -> Float32[np.ndarray, "m 3"]:
        """The vertices that the simulation carries [m]."""
        return self.vertices[self.moves]

    def pose(self, moved: Float32[np.ndarray, "m 3"] | None = None) -> "Pose":
        """Everything at rest, or with the moving vertices at `moved` [m], ready to be photographed."""
        vertices = self.vertices
        if moved is not None:
            vertices = vertices.copy()
            vertices[self.moves] = moved
        return Pose(self, vertices)

    def _bake(self, rays: int, rng: np.random.Generator) -> Float32[np.ndarray, " v"]:
        """Share of the hemisphere over each vertex, cosine weighted, that nothing covers; the better of two sides."""
        pose = Pose(self, self.vertices)
        open_sides = []
        for sign in (1.0, -1.0):
            n = sign * pose.normals
            free = np.zeros(len(n), np.float32)
            for _ in range(rays):
                d = rng.normal(size=n.shape).astype(np.float32)
                d = n + 0.98 * d / np.linalg.norm(d, axis=1, keepdims=True)  # cosine distributed about n
                d /= np.linalg.norm(d, axis=1, keepdims=True)
                free += ~pose.blocked(self.vertices + 5 * OFFSET * n, d, reach=0.12)
            open_sides.append(free / rays)
        openness = np.maximum(*open_sides)
        for _ in range(2):  # few rays are noisy: average with the neighbours over edges
            openness = 0.5 * (openness + _neighbour_mean(self.faces, openness))
        return openness


class Pose:
    """A studio at one instant: vertices, normals and the tree that rays are traced in."""

    def __init__(self, studio: Studio, vertices: Float32[np.ndarray, "v 3"]):
        o3d = open3d()
        self.studio, self.vertices = studio, vertices
        self.normals = vertex_normals(vertices, studio.faces)
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(studio.faces.astype(np.uint32)))
        self._tensor = o3d.core.Tensor

    def blocked(self, origin: np.ndarray, direction: np.ndarray, *, reach: float) -> np.ndarray:
        """Whether something lies between `origin` [n, 3] and origin + reach * direction (unit), `reach` in m."""
        rays = np.concatenate([origin, direction], 1).astype(np.float32)
        return self.scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=reach).numpy()

    def photograph(
        self, camera: Camera
    ) -> tuple[UInt8[Tensor, "h w 3"], UInt8[Tensor, "h w"], Float32[np.ndarray, "n 3"]]:
        """Image (sRGB), matte of whatever was hit, and the hits of one ray per pixel [m] (NaN: nothing was hit)."""
        h, w = camera.height, camera.width
        backdrop = to_linear(np.asarray(self.studio.light.backdrop, np.float32))
        total = np.zeros((h * w, 3), np.float32)
        cover = np.zeros(h * w, np.float32)
        first = np.full((h * w, 3), np.nan, np.float32)
        eye, through = camera.rays()
        rays = np.concatenate([np.broadcast_to(eye.numpy(), (h * w, 3)), through.reshape(-1, 3).numpy()], 1)
        right, down = camera.world_to_camera[:2, :3].float().numpy()
        origin = rays[:, :3]
        for i, (du, dv) in enumerate(SUPERSAMPLES):
            direction = rays[:, 3:] + ((du - 0.5) / camera.fx * right + (dv - 0.5) / camera.fy * down)
            answer = self.scene.cast_rays(self._tensor(np.concatenate([origin, direction], 1)))
            distance = answer["t_hit"].numpy()
            hit = np.isfinite(distance)
            point = origin[hit] + distance[hit, None] * direction[hit]
            colour = np.broadcast_to(backdrop, (h * w, 3)).copy()
            face = answer["primitive_ids"].numpy()[hit].astype(np.int64)
            colour[hit] = self._shade(
                point, direction[hit], face, answer["primitive_uvs"].numpy()[hit], self.studio.suns[i]
            )
            total += colour / len(SUPERSAMPLES)
            cover += hit / len(SUPERSAMPLES)
            if i == 0:
                first[hit] = point
        image = (to_srgb(total).reshape(h, w, 3) * 255 + 0.5).astype(np.uint8)
        matte = (cover.reshape(h, w) * 255 + 0.5).astype(np.uint8)
        return torch.from_numpy(image), torch.from_numpy(matte), first

    def _shade(self, point, direction, face, uv, sun) -> Float32[np.ndarray, "n 3"]:
        studio, light = self.studio, self.studio.light
        corner = studio.faces[face]
        u, v = uv[:, :1], uv[:, 1:]
        vertex = np.concatenate([self.normals, studio.albedo, studio.openness[:, None]], 1)
        smooth = (1 - u - v) * vertex[corner[:, 0]] + u * vertex[corner[:, 1]] + v * vertex[corner[:, 2]]
        normal, albedo, openness = smooth[:, :3], smooth[:, 3:6], smooth[:, 6]
        length = np.sqrt(np.einsum("ni,ni->n", normal, normal))
        towards = np.where(np.einsum("ni,ni->n", normal, direction) > 0, -1, 1)  # the camera
        normal *= (towards / np.maximum(length, 1e-9))[:, None].astype(np.float32)
        for owner, paint in studio.paints.items():
            which = studio.owner[face] == owner
            albedo[which] *= paint(point[which])
        facing = normal @ sun
        lit = np.where(facing > 0, facing, -facing * studio.translucency[face])
        # the ray starts on the lit side; a surface lit from behind does not shade itself
        start = point + OFFSET * np.sign(facing)[:, None] * normal
        lit *= ~self.blocked(start, np.broadcast_to(sun.astype(np.float32), start.shape), reach=3.0)
        above = 0.5 + 0.5 * normal[:, 2:]
        ambient = above * np.asarray(light.sky, np.float32) + (1 - above) * np.asarray(light.ground, np.float32)
        ambient *= openness[:, None] + (1 - openness[:, None]) * BOUNCE * albedo
        return albedo * (lit[:, None] * np.asarray(light.sun, np.float32) + ambient)


def photographs(
    pose: Pose, cameras: list[Camera], *, points: int, noise: float, seed: int, log
) -> tuple[list[Tensor], list[Tensor], Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Images and mattes of all cameras, and about `points` surface points with colours, as structure from motion gives.

    Points lie on what the cameras saw, with errors of `noise` [m] per axis.
    """
    rng = np.random.default_rng(seed)
    images, alphas, positions, colors = [], [], [], []
    for camera in log.progress(cameras, "photographing"):
        image, matte, hits = pose.photograph(camera)
        images.append(image)
        alphas.append(matte)
        seen = np.flatnonzero(np.isfinite(hits[:, 0]) & (matte.numpy().ravel() == 255))
        picks = rng.choice(seen, min(len(seen), -(-points // len(cameras))), replace=False)
        positions.append(hits[picks] + rng.normal(scale=noise, size=(len(picks), 3)).astype(np.float32))
        colors.append(image.reshape(-1, 3).numpy()[picks].astype(np.float32) / 255)
    return images, alphas, torch.from_numpy(np.concatenate(positions)), torch.from_numpy(np.concatenate(colors))


def ring(
    target: tuple[float, float, float],
    *,
    distance: float,
    elevation: float,
    azimuths: Float[np.ndarray, " n"] | Sequence[float],
    width: int,
    height: int,
    opening: float,
) -> list[Camera]:
    """Cameras at `distance` [m] from `target`; `elevation`, `azimuths` (0 is +x) and `opening` across in degrees."""
    focal = 0.5 * width / np.tan(0.5 * np.radians(opening))
    centre, cameras = torch.tensor(target, dtype=torch.float64), []
    e = np.radians(elevation)
    for azimuth in np.radians(azimuths):
        offset = distance * np.array([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)])
        cameras.append(
            Camera(
                width=width,
                height=height,
                fx=float(focal),
                fy=float(focal),
                cx=width / 2,
                cy=height / 2,
                world_to_camera=look_at(centre + torch.from_numpy(offset), centre),
            )
        )
    return cameras


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> Float32[np.ndarray, "v 3"]:
    """Area-weighted unit normals."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros((len(vertices), 3))
    for i in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, i], face[:, axis], len(vertices))
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)).astype(np.float32)


def surface_grid(
    position: Float[np.ndarray, "a b 3"], albedo: Float[np.ndarray, "*ab 3"], *, closed_b: bool = False, **kwargs
) -> Mesh:
    """Mesh of a parametrised surface; `closed_b` joins the last column to the first."""
    rows, columns = position.shape[:2]
    cells = np.meshgrid(np.arange(rows - 1), np.arange(columns if closed_b else columns - 1), indexing="ij")
    i, j = (c.reshape(-1) for c in cells)
    k = (j + 1) % columns
    p, q, r, s = i * columns + j, i * columns + k, (i + 1) * columns + k, (i + 1) * columns + j
    faces = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    return Mesh(
        vertices=position.reshape(-1, 3).astype(np.float32),
        faces=faces.astype(np.int32),
        albedo=np.broadcast_to(albedo, position.shape).reshape(-1, 3).astype(np.float32),
        **kwargs,
    )


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one; translucency and paint are those of the first."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return replace(
        meshes[0],
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + s for m, s in zip(meshes, starts)]).astype(np.int32),
        albedo=np.concatenate([m.albedo for m in meshes]),
    )


def smooth_noise(
    rng: np.random.Generator, rows: int, columns: int, *, cells: tuple[int, int] = (12, 24)
) -> Float[np.ndarray, "rows columns"]:
    """Mottling between -1 and 1 with about `cells` spots along each side; periodic over the columns."""
    coarse = 2 * rng.random(cells) - 1
    i, j = np.linspace(0, cells[0] - 1.001, rows), np.arange(columns) * cells[1] / columns
    i0, j0 = i.astype(int), j.astype(int)
    a, b = i - i0, j - j0
    a, b = (a * a * (3 - 2 * a))[:, None], (b * b * (3 - 2 * b))[None]
    j1 = (j0 + 1) % cells[1]
    upper = (1 - b) * coarse[i0][:, j0] + b * coarse[i0][:, j1]
    lower = (1 - b) * coarse[i0 + 1][:, j0] + b * coarse[i0 + 1][:, j1]
    return (1 - a) * upper + a * lower


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB 0..1 -> linear light (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, np.float32)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light -> sRGB 0..1, clipped."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _neighbour_mean(faces: np.ndarray, value: np.ndarray) -> np.ndarray:
    n = len(value)
    total, count = np.zeros(n), np.zeros(n)
    for i, j in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2)):
        total += np.bincount(faces[:, i], value[faces[:, j]], n)
        count += np.bincount(faces[:, i], minlength=n)
    return np.where(count > 0, total / np.maximum(count, 1), value).astype(np.float32)
