"""Synthetic twins: the motion of meshes, computed by a simulation whose material is known, and filmed.

Solids are sampled with particles of their own, and vertices follow the particles by

    x(X) = sum_i w_i (x_i + F_i (X - X_i)),     w_i ~ exp(-|X - X_i|^2 / h^2) over the nearest,    sum_i w_i = 1

which is exact for affine motion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.gaussians.cameras import Camera
from physics3d.mpm.rollout import rollout
from physics3d.open3d_import import open3d
from physics3d.scenes.base import Capture, Footage, Outline, Take
from physics3d.scenes.photographs import held_out
from physics3d.scenes.reference_motion import Moved, path_of, recorded
from physics3d.scenes.studio import Mesh, Studio, photographs
from physics3d.world import World


def view_names(count: int) -> tuple[str, ...]:
    """Of the photographs of a twin."""
    return tuple(f"view_{i:03d}" for i in range(count))


def outlined(name: str, views: int, frames: int, fps: float, *, mattes: bool = False) -> Outline:
    """What a twin will be, before it is made."""
    takes = tuple(Footage(name=role, role=role, frames=frames, fps=fps) for role in ("learn", "evaluate"))
    return Outline(name=name, names=view_names(views), mattes=mattes, takes=takes)


def captured(
    *,
    name: str,
    world: World,
    pokes: Mapping[str, tuple[AbstractBoundary, ...]],
    matter: tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, " p"]],
    solids: Sequence[Mesh] = (),
    studio: Studio,
    cameras: list[Camera],
    witness: Camera,
    frames: int,
    fps: float,
    points: int,
    held_out_every: int,
    seed: int,
    device: str,
    note: str,
    log,
    single_object: bool = False,
    noise: float = 4e-4,
    motion: str = "",
) -> Capture:
    """A twin, photographed by `cameras` at rest and filmed by `witness` once for each role in `pokes`.

    `matter` is position [m] and volume [m^3] of the particles, by which the grid moves the body where no reference
    motion of these `solids` is kept under the name `motion`, or else `name` (`reference_motion.py`); there are `points`
    surface points, `noise` [m] off along each axis.
    """
    images, alphas, found, colors = photographs(studio.pose(), cameras, points=points, noise=noise, seed=seed, log=log)
    position, volume = matter
    kept = recorded(path_of(motion or name), world, pokes, solids, frames=frames, fps=fps)
    by = f"the grid, cells of {1e3 * world.dx:.3g} mm" if kept is None else kept[1]
    log.info(f"reference motion: {by}")
    takes = [
        film(
            role=role,
            world=world,
            excitation=excitation,
            position=position,
            volume=volume,
            known=None if kept is None else kept[0][role],
            studio=studio,
            cameras=[witness],
            frames=frames,
            fps=fps,
            device=device,
            log=log,
        )
        for role, excitation in pokes.items()
    ]
    capture = Capture(
        name=name,
        images=tuple(images),
        cameras=tuple(cameras),
        names=view_names(len(cameras)),
        held_out=held_out(len(images), held_out_every),
        alphas=tuple(alphas) if single_object else (),
        background=studio.light.backdrop,
        points=found,
        point_colors=colors,
        takes=tuple(takes),
        single_object=single_object,
        floor=0.0,
        truth=world.start,
        truth_source=f"set in the code that made this twin; its motion by {by}",
        note=note,
    )
    capture.check()
    return capture


def film(
    *,
    role: str,
    world: World,
    excitation: tuple[AbstractBoundary, ...],
    position: Float32[np.ndarray, "p 3"],
    volume: Float32[np.ndarray, " p"],
    known: Moved | None,
    studio: Studio,
    cameras: list[Camera],
    frames: int,
    fps: float,
    device: str,
    log,
) -> Take:
    """Photograph the meshes as they follow the motion that is `known`, or else that of the particles, simulated with
    the parameters `world.start`."""
    moved = known or _by_grid(world, excitation, position, volume, frames=frames, fps=fps, device=device, log=log)
    carrier = Carrier(studio.rest(), studio.anchors(), moved.place, world.dx)
    videos: list[list[Tensor]] = [[] for _ in cameras]
    furthest = 0.0
    for t in log.progress(range(frames), f"filming the take to {role}"):
        vertices = carrier(moved.position[t], moved.deformation[t])
        furthest = max(furthest, float(np.linalg.norm(vertices - studio.rest(), axis=1).max()))
        pose = studio.pose(vertices)
        for camera, video in zip(cameras, videos):
            video.append(pose.photograph(camera)[0])
    log.info(f"take to {role}: moves by up to {1e3 * furthest:.0f} mm")
    return Take(
        name=role,
        role=role,
        fps=fps,
        cameras=tuple(cameras),
        videos=tuple(torch.stack(v) for v in videos),
        excitation=excitation,
    )


def _by_grid(
    world: World,
    excitation: tuple[AbstractBoundary, ...],
    position: Float32[np.ndarray, "p 3"],
    volume: Float32[np.ndarray, " p"],
    *,
    frames: int,
    fps: float,
    device: str,
    log,
) -> Moved:
    trajectory = rollout(
        world,
        world.estimate().parameters,
        torch.from_numpy(position),
        torch.from_numpy(volume),
        excitation=excitation,
        frames=frames,
        frame_dt=1 / fps,
        device=device,
        log=log,
    )
    trajectory.check()
    log.info(
        f"{len(position)} particles, {1e6 * volume.sum():.0f} cm^3, cells of {1e3 * world.dx:.3g} mm, substeps of "
        f"{trajectory.substep_dt:.2g} s"
    )
    x, F = (a.cpu().numpy() for a in (trajectory.position, trajectory.deformation))
    return Moved(place=position, position=x, deformation=F)


def particles(
    solids: list[Mesh], spacing: float, seed: int
) -> tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, " p"]]:
    """Material points of closed meshes: position [m], volume [m^3].

    One jittered point per cube of side `spacing` [m] inside, counted once where meshes overlap.
    """
    rng = np.random.default_rng(seed)
    lower, upper = (f([f(m.vertices, 0) for m in solids], 0) for f in (np.min, np.max))
    axes = [np.arange(a - spacing * rng.random(), b + spacing, spacing) for a, b in zip(lower, upper)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    lattice = (lattice + 0.7 * spacing * (rng.random(lattice.shape) - 0.5)).astype(np.float32)
    inside = within(solids, lattice)
    return lattice[inside], np.full(inside.sum(), spacing**3, np.float32)


def within(solids: list[Mesh], points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points [m] are inside of one of the closed meshes."""
    o3d = open3d()
    points = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
    inside = np.zeros(len(points), bool)
    for mesh in solids:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
        inside |= scene.compute_occupancy(points, nsamples=3).numpy() > 0.5
    return inside


@dataclass(frozen=True)
class Carrier:
    """Which particles carry which vertices, fixed in the rest state."""

    rest: Float[np.ndarray, "v 3"]
    anchors: Float[np.ndarray, "v 3"]  # the nearest particles are sought from here
    particles: Float[np.ndarray, "p 3"]
    reach: float  # h of the weights [m]
    neighbours: np.ndarray = field(init=False)  # [v, k]
    weights: np.ndarray = field(init=False)  # [v, k]

    def __post_init__(self):
        from scipy.spatial import cKDTree

        distance, index = cKDTree(self.particles).query(self.anchors, k=min(12, len(self.particles)))
        distance, index = distance.reshape(len(self.rest), -1), index.reshape(len(self.rest), -1)
        # relative to the nearest, so that a vertex far outside keeps its weights
        weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / self.reach**2)
        object.__setattr__(self, "neighbours", index)
        object.__setattr__(self, "weights", weight / weight.sum(1, keepdims=True))

    def __call__(self, x: Float[np.ndarray, "p 3"], F: Float[np.ndarray, "p 3 3"]) -> Float32[np.ndarray, "v 3"]:
        """Vertices when the particles are at `x` with total deformation `F`."""
        offset = self.rest[:, None] - self.particles[self.neighbours]
        moved = x[self.neighbours] + np.einsum("vkij,vkj->vki", F[self.neighbours], offset)
        return (self.weights[..., None] * moved).sum(1).astype(np.float32)
