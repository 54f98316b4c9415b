"""Laws of motion that the solver without a grid must keep, and its time against that of the grid: rows of one table.

Each row is (what, measured, bar, unit); it holds where the measured number is at most the bar. Times are processor
time, kernels compiled before, in the same run.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from modes_bodies import bent_cantilever, swings, viscoelastic_bar

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.cells import solid_cells
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.scenes.carnation import CarnationTwin
from physics3d.scenes.flower import SOIL, blossom_centre
from physics3d.scenes.reference_motion import path_of, recorded
from physics3d.scenes.synthetic import Carrier
from physics3d.solver import Motion, motion_of
from physics3d.world import World

FPS, FRAMES = 30.0, 31  # one second
START = dict(
    youngs_modulus=1.5e5, poissons_ratio=0.3, branch_shear_modulus=3e4, branch_bulk_modulus=6.5e4,
    shear_relaxation_time=0.15, bulk_relaxation_time=0.15,
)  # fmt: skip
Row = tuple[str, float, float, str]


def bending() -> list[Row]:
    rows = []
    for load, tip in ((1.0, 17), (10.0, 80)):
        end, exact = bent_cantilever(load)
        off = float(np.linalg.norm(end - exact) / np.linalg.norm(exact - [1, 0]))
        rows.append((f"cantilever, its end at {tip} degrees, against the elastica", 100 * off, 2.0, "%"))
    return rows


def bar() -> list[Row]:
    return [("viscoelastic bar, whole curve", 100 * viscoelastic_bar()[0], 1.0, "%")]


def energy() -> list[Row]:
    found, swing = swings(periods=1000, steps=64)
    change = 100 * float(np.abs(found[1:] / found[1:].mean() - 1).max())
    return [(f"energy of a beam that swings by {100 * swing:.0f} % of its length, 1000 periods", change, 1.0, "%")]


def spread(rows: list[dict]) -> list[Row]:
    """Of the first two frequencies of the plant over the spacings of its filling, from the rows that measured them."""
    found = np.array([[float(f) for f in r["splines"].split()[:2]] for r in rows if r["body"].startswith("the twin")])
    if len(found) < 2:
        return []
    off = (found.max(0) / found.min(0) - 1).max()
    return [("first two frequencies of the plant over spacings of 4 to 8 mm, largest by smallest", 100 * off, 5.0, "%")]


def speed(inside: Callable[[np.ndarray], np.ndarray], vertices: np.ndarray) -> list[Row]:
    """The twin's plant, poked: a second of motion by either solver, its gradient, and a live step with its picture."""
    position, volume, matter = solid_cells(inside, vertices, 0.006)
    poke = Impulse(force=(-0.05, 0.06, 0.02), centre=blossom_centre(), radius=0.05, duration=0.1)
    motion, build = {}, 0.0
    for solver in ("grid", "modes"):
        world = World(
            material=Viscoelastic(), density=300.0, start=START, dx=0.012, gravity=(0.0, 0.0, 0.0), solver=solver,
            boundaries=(FixedRegion(lower=(-0.05, -0.05, 0.0), upper=(0.05, 0.05, SOIL)),),
        )  # fmt: skip
        x, V = torch.from_numpy(position).float(), torch.from_numpy(volume).float()
        begin = time.process_time()
        motion[solver] = motion_of(world, x, V, excitation=(poke,), matter=matter, device="cpu", log=Log(None))
        build = time.process_time() - begin
        second(motion[solver], 3, gradient=True)  # kernels are compiled
    rows: list[Row] = []
    for what, gradient in (("a second of motion", False), ("... and its gradient", True)):
        grid, modes = (second(motion[solver], FRAMES, gradient=gradient) for solver in ("grid", "modes"))
        name = f"{what} of the plant: {modes:.2f} s of computing, {grid:.1f} s on the grid of 12 mm; share"
        rows.append((name, modes / grid, 1 / 20, ""))
    rows.append((f"model of the plant ({len(x)} particles) built, once", build, math.inf, "s"))
    rows.append(("a live step with its picture, 20 000 Gaussians", live(motion["modes"], x), 1 / 15, "s"))
    return rows


@dataclass(frozen=True)
class Poked:
    """The twin's held-out poke by one solver."""

    solver: str  # modes | grid
    spacing: float  # of the filling [m]; cells of the grid are twice that
    seconds: float  # of computing, all included [s]
    error: float  # of the displacement over the clip, root mean square, of that of finite elements [1]


def poke(inside: Callable[[np.ndarray], np.ndarray], vertices: np.ndarray) -> list[Poked]:
    """Against its reference motion, which is that of finite elements: by the modes, and by the grid."""
    twin = CarnationTwin()
    kept = path_of("carnation")
    known = recorded(kept, twin.world(), twin.pokes(), twin.solids(), frames=twin.frames, fps=twin.fps)
    if known is None:
        raise SystemExit(f"error: {kept} is not that of the twin; make reference-motion")
    truth = known[0]["evaluate"]
    moves = truth.place[:, 2] > SOIL
    place, reference = truth.place[moves], truth.position[:, moves]
    size = np.sqrt(np.mean((reference - place) ** 2))
    found = []
    for solver, spacings in (("modes", (0.008, 0.006, 0.004)), ("grid", (0.008, 0.006, 0.005, 0.0035))):
        for spacing in spacings:
            position, volume, matter = solid_cells(inside, vertices, spacing)
            world = replace(twin.world(), dx=2 * spacing, solver=solver)
            x, V = torch.from_numpy(position).float(), torch.from_numpy(volume).float()
            begin = time.process_time()
            with torch.no_grad():
                motion = motion_of(
                    world, x, V, excitation=twin.pokes()["evaluate"], matter=matter, device="cpu", log=Log(None)
                )
                moved = motion(world.estimate().parameters, frames=twin.frames, frame_dt=1 / twin.fps, log=Log(None))
            seconds = time.process_time() - begin
            carrier = Carrier(place, place, position, spacing)
            there = [carrier(a.numpy(), F.numpy()) for a, F in zip(moved.position, moved.deformation)]
            off = float(np.sqrt(np.mean((np.stack(there) - reference) ** 2)) / size)
            found.append(Poked(solver, spacing, seconds, off))
            print(found[-1], flush=True)
    return found


def poked(found: list[Poked]) -> list[Row]:
    """Rows of the table; the bar is for the modes alone."""
    rows: list[Row] = []
    for one in found:
        how = "the modes" if one.solver == "modes" else f"the grid of {2e3 * one.spacing:g} mm"
        what = f"the twin's poke by {how}, filled at {1e3 * one.spacing:g} mm, against finite elements"
        bar = 5.0 if one.solver == "modes" else math.inf
        rows.append((f"{what} ({one.seconds:.1f} s)", 100 * one.error, bar, "%"))
    return rows


def second(motion: Motion, frames: int, *, gradient: bool) -> float:
    """Processor time [s] of that many frames."""
    parameters = {name: torch.tensor(value, requires_grad=gradient) for name, value in START.items()}
    begin = time.process_time()
    moved = motion(parameters, frames=frames, frame_dt=1 / FPS, log=Log(None))
    if gradient:
        moved.position[-1].sum().backward()
    return time.process_time() - begin


def live(motion: Motion, x: torch.Tensor) -> float:
    """Processor time [s] of a fifteenth of a second of motion and a picture of 320 x 320."""
    generator = torch.Generator().manual_seed(0)
    n = 20_000
    mean = x[torch.randint(len(x), (n,), generator=generator)] + 0.003 * torch.randn(n, 3, generator=generator)
    gaussians = Gaussians(
        mean=mean, log_scale=torch.full((n, 3), math.log(0.002)), quaternion=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.full((n,), 1.0), sh=torch.rand(n, 1, 3, generator=generator),
    )  # fmt: skip
    tied = embed(mean, torch.arange(n), x, 0.006)
    pose = look_at(torch.tensor([0.0, -0.6, 0.2]), torch.tensor([0.0, 0.0, 0.18]))
    camera = Camera(width=320, height=320, fx=400, fy=400, cx=160, cy=160, world_to_camera=pose)
    frames = 16  # one second, as a live poke would ask for it
    with torch.no_grad():
        for _ in range(2):  # the first compiles
            begin = time.process_time()
            moved = motion(START, frames=frames, frame_dt=1 / 15, log=Log(None))
            for k in range(1, frames):
                F = moved.deformation[k]
                render_deformed(gaussians, tied, x, moved.position[k], F, camera, background=(1.0, 1.0, 1.0))
            found = (time.process_time() - begin) / (frames - 1)
    return found
