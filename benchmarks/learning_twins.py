"""Bodies whose material is drawn, filmed from their own Gaussians: the problems of `learning.py` and their truth.

A run is a scene of `conf/scene`, a number of cameras and a seed; these draw, each of its own,

    s = 10^U(-1, 1)      stiffness: E = s E_0, branches likewise             q = e^U(-0.5, 0.5)  strength of the branch
    r = e^U(-0.7, 0.7)   relaxation time: tau = r tau_0/sqrt(s)              a, b = U(0.9, 1.15) width and height
    starts               E and branches 10 times too stiff or too soft, the relaxation time 5 times too long or short
    density              as given, wrong by e^N(0, 0.1)      noise of 2/255 on every pixel, then 8 bits

A body s times as stiff is pushed s a^3 times as hard for 1/sqrt(s) of the time and filmed at sqrt(s) times the rate,
so that every clip shows about as many swings. All but the cake move as finite elements have found
(`reference_motion.py`): their shape, q and r are those of the scene, and s is a change of units, in which that motion
stays exact. What no such motion is kept of is moved by the modes, of particles of the solids themselves, at 0.8 of the
spacing of those that filling puts into the Gaussians.

Where all that is assumed is told wrongly, the learner's lengths are e^N(0, 0.05) and its forces e^N(0, 0.1) times the
true ones: what it sees is the same, and E goes with force/length^2, the density with force/length^4.
"""

import math
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.cells import solid_cells
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.log import Log
from physics3d.scenes import carnation
from physics3d.scenes.base import Capture, Take
from physics3d.scenes.carnation import CarnationTwin
from physics3d.scenes.made import MadeTwin
from physics3d.scenes.reference_motion import Moved, path_of, recorded
from physics3d.scenes.studio import Mesh, ring, to_srgb
from physics3d.scenes.synthetic import within
from physics3d.solver import motion_of
from physics3d.world import World

DENSITY = 0.1  # deviation of the logarithm of the density as given
LENGTH, FORCE = 0.05, 0.1  # and of size and push, where they are told wrongly
NOISE = 2.0 / 255  # deviation of a pixel
SIDE = (80, 60)  # of the pictures [px]
SHOTS, RINGS = 24, (-12.0, 14.0, 44.0)  # photographs, on rings so high above the horizon [deg]
PHOTOGRAPH = (240, 180)  # their size [px]
EVERY = 2  # so many frames of the scene's takes are one
PARTICLES = 2500  # about so many are learned with, where the scene's own spacing would give more
# Gaussians, small enough for tangents to stay near a round surface: discs of a third as many stand out of that of the
# cord by so much that its volume is 8 % too large, the hat's by 4 %; of these by about 2 %
COUNT = 6000
FLAT = 0.02  # thickness of the discs, of their radius
BACKGROUND = (0.80, 0.83, 0.86)
LIGHT = np.array([-0.39, -0.52, 0.74])  # direction to it
FINER = 0.8  # spacing of the particles that move the truth, of those that learn
FINITE = "finite elements"


@dataclass(frozen=True, kw_only=True)
class Twin:
    """A drawn body, its truth, and what the learner is told."""

    world: World  # the truth: parameters, density, holds
    given: World  # what the learner is told, where it starts included
    capture: Capture  # films and Gaussians
    spacing: float  # of what is filled into the Gaussians [m]
    moved_by: str


def drawn(scene: str, source: CarnationTwin | MadeTwin, start: World, *, cameras: int, seed: int, log: Log) -> Twin:
    """`start`: the world of the scene as the pipeline would learn in it."""
    rng = np.random.default_rng((seed, cameras, zlib.crc32(scene.encode())))
    truth = source.world if isinstance(source, MadeTwin) else source.world()
    kept = recorded(path_of(scene), truth, source.pokes(), source.solids(), frames=source.frames, fps=source.fps)
    s, q, r = 10 ** rng.uniform(-1, 1), math.exp(rng.uniform(-0.5, 0.5)), math.exp(rng.uniform(-0.7, 0.7))
    a, b = rng.uniform(0.9, 1.15, 2)
    if kept is not None:
        q = r = a = b = 1.0
    size = np.array([a, a, b])
    faster = math.sqrt(s)
    values = scaled(truth.start, stiffness=s, branch=q, time=r / faster)
    hold = lambda world: tuple(stretched(one, size, force=1.0, time=1.0) for one in world.boundaries)
    world = replace(truth, start=values, boundaries=hold(truth), solver="modes")
    pokes = {
        role: tuple(stretched(one, size, force=s * a**3, time=1 / faster) for one in poke)
        for role, poke in source.pokes().items()
    }
    side, later = rng.choice([-1, 1], 2)
    guess = scaled(values, stiffness=10.0**side, branch=1.0, time=5.0**later)
    wrong = math.exp(DENSITY * rng.normal())
    given = replace(start, start=guess, boundaries=hold(start), density=wrong * truth.density)
    solids = [replace(mesh, vertices=(mesh.vertices * size).astype(np.float32)) for mesh in source.solids()]
    gaussians, volume = painted(solids, rng)
    spacing = max(start.dx / 2, (volume / PARTICLES) ** (1 / 3))
    given = replace(given, dx=2 * spacing)
    fps, frames = source.fps / EVERY * faster, 1 + (source.frames - 1) // EVERY
    if kept is None:
        moved = {role: by_modes(world, poke, solids, FINER * spacing, frames, fps, log) for role, poke in pokes.items()}
    else:
        moved = {
            role: replace(one, position=one.position[::EVERY], deformation=one.deformation[::EVERY])
            for role, one in kept[0].items()
        }
    takes = []
    for role, elevation, azimuths in (
        ("learn", 14.0, -84.0 + 360.0 * np.arange(cameras) / cameras),
        ("evaluate", 32.0, np.array([-40.0])),
    ):
        seen = lens(source, float(b), elevation, azimuths)
        videos = filmed(gaussians, moved[role], spacing, seen, rng)
        takes.append(Take(name=role, role=role, fps=fps, cameras=tuple(seen), videos=videos, excitation=pokes[role]))
    capture = Capture(
        name=scene, images=(), cameras=(), names=(), background=BACKGROUND, gaussians=gaussians,
        moves=torch.ones(len(gaussians), dtype=torch.bool), takes=tuple(takes), truth=values,
    )  # fmt: skip
    by = FINITE if kept is not None else "modes"
    return Twin(world=world, given=given, capture=capture, spacing=spacing, moved_by=by)


def scaled(start: dict[str, float], *, stiffness: float, branch: float, time: float) -> dict[str, float]:
    """Parameters with moduli, those of branches besides, and relaxation times multiplied."""
    factor = {"modulus": stiffness, "time": time}
    return {
        name: value * factor.get(name.rpartition("_")[2], 1.0) * (branch if name.startswith("branch") else 1.0)
        for name, value in start.items()
    }


def stretched(one: AbstractBoundary, size: np.ndarray, *, force: float, time: float) -> AbstractBoundary:
    """A hold or a push of a body that is `size` times as large along the axes."""
    place = lambda x: tuple(float(v) for v in np.array(x) * size)
    if isinstance(one, FixedRegion):
        return replace(one, lower=place(one.lower), upper=place(one.upper))
    if not isinstance(one, Impulse) or one.force is None:
        raise ValueError(f"{one} is neither a fixed region nor a push with a force; leave its scene out")
    corners = {name: place(value) for name in ("centre", "lower", "upper") if (value := getattr(one, name)) is not None}
    radius = None if one.radius is None else one.radius * float(size.mean())
    return replace(
        one, **corners, radius=radius, force=tuple(force * float(f) for f in one.force), duration=time * one.duration
    )


def by_modes(
    world: World,
    poke: tuple[AbstractBoundary, ...],
    solids: list[Mesh],
    spacing: float,
    frames: int,
    fps: float,
    log: Log,
) -> Moved:
    """Of particles `spacing` [m] apart in the solids themselves."""
    corners = np.concatenate([mesh.vertices for mesh in solids]).astype(float)
    position, volume, matter = solid_cells(lambda x: within(solids, x), corners, spacing)
    x, V = torch.from_numpy(position).float(), torch.from_numpy(volume).float()
    with torch.no_grad():
        motion = motion_of(world, x, V, excitation=poke, matter=matter, device="cpu", log=log)
        moved = motion(world.estimate().parameters, frames=frames, frame_dt=1 / fps, log=Log(None))
    return Moved(place=position, position=moved.position.numpy(), deformation=moved.deformation.numpy())


def painted(solids: list[Mesh], rng: np.random.Generator) -> tuple[Gaussians, float]:
    """(flat opaque Gaussians on the surface of the solids, their volume [m^3]); what is inside of another is none."""
    points, normals, colours = [], [], []
    area = [np.linalg.norm(_across(mesh), axis=1) / 2 for mesh in solids]
    volume = sum(
        abs(float(np.einsum("ni,ni->", mesh.vertices[mesh.faces[:, 0]], _across(mesh)))) / 6 for mesh in solids
    )
    total = sum(map(np.sum, area))
    for i, (mesh, size) in enumerate(zip(solids, area)):
        face = rng.choice(len(size), max(1, round(COUNT * size.sum() / total)), p=size / size.sum())
        u = np.sqrt(rng.random(len(face)))[:, None]
        v = rng.random(len(face))[:, None]
        share = np.concatenate([1 - u, u * (1 - v), u * v], 1)
        place = np.einsum("nk,nki->ni", share, mesh.vertices[mesh.faces[face]])
        others = [other for j, other in enumerate(solids) if j != i]
        free = ~within(others, place) if others else np.ones(len(place), bool)
        across = _across(mesh)[face]
        normals.append((across / np.linalg.norm(across, axis=1, keepdims=True))[free])
        points.append(place[free])
        colours.append(np.einsum("nk,nki->ni", share, mesh.albedo[mesh.faces[face]])[free])
    x, n, albedo = (np.concatenate(one) for one in (points, normals, colours))
    spots = 1 + 0.25 * np.sin(rng.uniform(60, 160, 3) * x + rng.uniform(0, 6, 3)).sum(1, keepdims=True) / 1.5
    colour = to_srgb(np.clip(albedo * spots * (0.55 + 0.45 * np.abs(n @ LIGHT))[:, None], 0.01, 1.0))
    n = np.where(n[:, 2:] < 0, -n, n)  # a disc has two sides
    turn = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], 0 * n[:, 0]], 1)
    radius = math.sqrt(total / COUNT / math.pi)
    half = np.log(np.tile([radius, radius, FLAT * radius], (len(x), 1)))
    found = Gaussians(
        mean=torch.from_numpy(x).float(), log_scale=torch.from_numpy(half).float(),
        quaternion=torch.from_numpy(turn / np.linalg.norm(turn, axis=1, keepdims=True)).float(),
        opacity_logit=torch.full((len(x),), 4.0),
        sh=torch.from_numpy((colour - 0.5) / 0.28209479177387814).float()[:, None],
    )  # fmt: skip
    return found, volume


def _across(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return np.cross(b - a, c - a)


def lens(source: CarnationTwin | MadeTwin, taller: float, elevation: float, azimuths: np.ndarray) -> list[Camera]:
    """Cameras of the scene's kind around the thing; the first one looks from the front."""
    made = isinstance(source, MadeTwin)
    target, distance, opening = (
        (source.target, source.distance, source.opening) if made
        else (carnation.TARGET, carnation.DISTANCE, carnation.OPENING)
    )  # fmt: skip
    at = (target[0], target[1], target[2] * taller)
    return ring(
        at, distance=distance, elevation=elevation, azimuths=azimuths, width=SIDE[0], height=SIDE[1], opening=opening
    )


def photographed(twin: Twin, source: CarnationTwin | MadeTwin, seed: int) -> Capture:
    """The same body without its shape: SHOTS noisy photographs of it at rest with mattes, and points of its surface."""
    rng = np.random.default_rng((seed, SHOTS))
    gaussians = twin.capture.gaussians
    assert gaussians is not None
    low, high = gaussians.mean.amin(0), gaussians.mean.amax(0)
    taller = float(high[2]) / max(float(mesh.vertices[:, 2].max()) for mesh in source.solids())
    each = SHOTS // len(RINGS)
    turned = 360.0 * np.arange(each) / each
    cameras = [
        camera.scaled(PHOTOGRAPH[0] / SIDE[0])
        for i, height in enumerate(RINGS)
        for camera in lens(source, taller, height, turned + 360.0 * i / SHOTS)
    ]
    images, alphas = [], []
    for camera in cameras:
        with torch.no_grad():
            drawn = render(gaussians, camera, background=torch.tensor(BACKGROUND))
        noisy = drawn.color.numpy() + NOISE * rng.standard_normal(drawn.color.shape)
        images.append(torch.from_numpy((255 * np.clip(noisy, 0, 1) + 0.5).astype(np.uint8)))
        alphas.append((255 * drawn.alpha.reshape(camera.height, camera.width) + 0.5).clamp(0, 255).to(torch.uint8))
    points = gaussians.mean + 1e-3 * float((high - low).norm()) * torch.from_numpy(
        rng.normal(size=gaussians.mean.shape)
    )
    found = replace(
        twin.capture, images=tuple(images), alphas=tuple(alphas), cameras=tuple(cameras),
        names=tuple(f"view_{i:03}" for i in range(len(cameras))), points=points.float(),
        point_colors=(0.5 + 0.28209479177387814 * gaussians.sh[:, 0]).clamp(0, 1), single_object=True,
        gaussians=None, moves=None,
    )  # fmt: skip
    found.check()
    return found


def filmed(
    gaussians: Gaussians, moved: Moved, spacing: float, cameras: list[Camera], rng: np.random.Generator
) -> tuple[Tensor, ...]:
    """Films, uint8 [t, h, w, 3], with noise, of Gaussians that ride on what moved."""
    X = torch.from_numpy(moved.place).float()
    carried = embed(gaussians.mean, torch.arange(len(gaussians)), X, spacing)
    films = []
    for camera in cameras:
        pictures = []
        for x, F in zip(moved.position, moved.deformation):
            state = (torch.from_numpy(x).float(), torch.from_numpy(F).float())
            with torch.no_grad():
                drawn = render_deformed(gaussians, carried, X, *state, camera, background=BACKGROUND).color.numpy()
            noisy = drawn + NOISE * rng.standard_normal(drawn.shape)
            pictures.append((255 * np.clip(noisy, 0, 1) + 0.5).astype(np.uint8))
        films.append(torch.from_numpy(np.stack(pictures)))
    return tuple(films)


def told_wrongly(twin: Twin, *, cameras: int, seed: int) -> Twin:
    """The same body and films for a learner whose ruler and whose spring balance are off."""
    rng = np.random.default_rng((seed, cameras, zlib.crc32(twin.capture.name.encode()), 1))
    longer, stronger = math.exp(LENGTH * rng.normal()), math.exp(FORCE * rng.normal())
    size = np.full(3, longer)
    told = lambda pushes, force: tuple(stretched(one, size, force=force, time=1.0) for one in pushes)
    there = lambda camera: replace(camera, world_to_camera=_moved_away(camera.world_to_camera, longer))
    gaussians = twin.capture.gaussians
    assert gaussians is not None
    gaussians = replace(gaussians, mean=longer * gaussians.mean, log_scale=gaussians.log_scale + math.log(longer))
    takes = tuple(
        replace(take, cameras=tuple(map(there, take.cameras)), excitation=told(take.excitation or (), stronger))
        for take in twin.capture.takes
    )
    given = replace(twin.given, boundaries=told(twin.given.boundaries, 1.0), dx=longer * twin.given.dx)
    capture = replace(twin.capture, gaussians=gaussians, takes=takes)
    return replace(twin, given=given, capture=capture, spacing=longer * twin.spacing)


def _moved_away(pose: Tensor, longer: float) -> Tensor:
    """A camera's [4, 4] in a world so many times as long."""
    return pose * torch.tensor([1.0, 1.0, 1.0, longer], dtype=pose.dtype)


def twin_source(built: Any, scene: str) -> CarnationTwin | MadeTwin:
    if not isinstance(built, CarnationTwin | MadeTwin):
        raise ValueError(f"scene {scene} is a {type(built).__name__}; take one with known material")
    return built
