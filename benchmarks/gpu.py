"""Simulator and renderer on a GPU: right or not, and how fast, in under eight minutes.

    make bench-gpu [ARGS="device=cuda seed=0"]   ->   docs/results/gpu.md, .csv, .png

It needs torch, Warp, numpy, scipy, matplotlib, jaxtyping and annotated-types: no network, Prefect, Open3D, MLflow or
ffmpeg, and no `make setup` where a Python has these (`make bench-gpu PYTHON=python3`). `device=cpu size=tiny
out=<folder>` runs all of it small, to test the script. It ends with an error if the device does not agree with the CPU,
or if rows of the table contradict each other (`slopes.py`): then nothing is written.

Agreement is that of the same motion, picture and gradient computed on the device and on the CPU, in double precision
where there is a choice; the solver without a grid computes on the CPU whatever the device is, and has to hand over the
same. A body is a jittered cube, 8 particles per cell, in a little motion, float32. A cost is the median slope of time
over several lengths of a run, with half the distance of the quartiles as its spread. Share of bandwidth: the bytes that
the kernels of a substep have to read and write, each array once per kernel, over the time, over what a copy of a large
array reaches on the same device. `launched one by one` is the same run without a graph. Memory is the most that the
device has lent while the run lasted, less what it had lent before.

`carnation`: the meshes of the carnation as Gaussians, drawn from all around, are fitted with the numbers of the default
profile, and one step of learning moves its stem and blossom by the grid for fifteen frames, draws them and goes back.
`lego` are the photographs of NeRF-synthetic's lego, if `data=<folder>` holds lego/transforms_train.json.
"""

import csv
import math
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from machine import machine
from slopes import Row, contradictions, slope

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.gaussians.adam import Rates
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.densification.adaptive import Adaptive
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.fit import fit
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.photograph import Photograph
from physics3d.gaussians.rasterize import rasterize
from physics3d.gaussians.render import render
from physics3d.gaussians.start import from_points
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm import arrays
from physics3d.mpm.rollout import rollout
from physics3d.scenes.carnation import photographers
from physics3d.scenes.flower import SOIL, blossom_centre, plant, stem_curve
from physics3d.solver import motion_of
from physics3d.world import World

MATERIALS = {"fixed corotated": Viscoelastic(branches=0), "viscoelastic, one branch": Viscoelastic(branches=1)}
SIMPLER = (("fixed corotated", "viscoelastic, one branch"),)
START = {
    "youngs_modulus": 1e5, "poissons_ratio": 0.3, "branch_shear_modulus": 2e4, "branch_bulk_modulus": 4e4,
    "shear_relaxation_time": 0.1, "bulk_relaxation_time": 0.1,
}  # fmt: skip
PER_SUBSTEP = "ns per particle and substep"
COLUMNS = ("what", "kind", "size", "value", "spread", "unit")


@dataclass(frozen=True)
class Amount:
    """How much is computed."""

    particles: tuple[int, ...]
    lengths: tuple[int, ...]  # substeps
    rounds: int
    pictures: tuple[tuple[int, int], ...]  # Gaussians, side [px]
    copied: tuple[int, ...]  # [byte]
    iterations: int  # of the carnation's fit; the lego has four times as many
    carnation_gaussians: int
    frames: int  # of a step of learning
    views: int  # of the carnation


SIZES = {
    "full": Amount(
        particles=(10_000, 100_000, 1_000_000), lengths=(64, 128, 192, 256), rounds=3,
        pictures=((20_000, 320), (50_000, 400), (500_000, 800)), copied=(1 << 28, 1 << 29, 1 << 30), iterations=1000,
        carnation_gaussians=12_000, frames=15, views=40,
    ),
    "tiny": Amount(
        particles=(216, 512), lengths=(4, 8, 12), rounds=2, pictures=((300, 48),), copied=(1 << 20, 1 << 21),
        iterations=4, carnation_gaussians=600, frames=2, views=3,
    ),
}  # fmt: skip


def main(words: list[str]) -> None:
    options = dict(device="cuda", seed="0", size="full", data="", out=str(ROOT / "docs" / "results"))
    unknown = [word for word in words if word.partition("=")[0] not in options]
    if unknown:
        sys.exit(f"error: {unknown[0]} is not an option; take {', '.join(f'{key}=' for key in options)}")
    options |= dict(word.split("=", 1) for word in words)
    device, seed, amount = options["device"], int(options["seed"]), SIZES[options["size"]]
    if device.startswith("cuda") and not torch.cuda.is_available():
        sys.exit("error: torch finds no GPU; take one, or device=cpu size=tiny out=<folder> to try the script")
    begun, rows = time.monotonic(), []
    for more in measured(device, seed, amount, options["data"]):
        rows.append(more)
        print(f"{time.monotonic() - begun:6.1f} s  {line(more)}", flush=True)
    finish(rows, machine(device), seed, time.monotonic() - begun, Path(options["out"]))


def measured(device: str, seed: int, amount: Amount, data: str) -> Iterator[Row]:
    yield from agreement(device)
    bandwidth = copying(device, amount)
    yield bandwidth
    for count in amount.particles:
        for name in MATERIALS:
            for found in simulation(name, count, device, seed, amount):
                yield found
                if (found["kind"], found["unit"]) == ("forward", PER_SUBSTEP):
                    yield share(found, bandwidth)
    yield from graphs(device, seed, amount)
    yield from memory(device, seed, amount.particles[-1])
    for count, side in amount.pictures:
        yield from rendering(count, side, device, seed)
    yield from carnation(device, seed, amount)
    if data:
        yield lego(Path(data), device, seed, amount)


def finish(rows: list[Row], where: str, seed: int, seconds: float, out: Path) -> None:
    """Write the page, or end with an error if the rows cannot all be true."""
    wrong = disagreements(rows) + contradictions(rows, simpler=SIMPLER)
    if wrong:
        sys.exit("error: nothing is written, for rows contradict the CPU or each other:\n" + "\n".join(wrong))
    write(rows, where, seed, seconds, out)


def row(what: str, kind: str, size: int | str, value: float, unit: str, spread: float = 0.0) -> Row:
    return dict(what=what, kind=kind, size=size, value=value, spread=spread, unit=unit)


def line(r: Row) -> str:
    spread = f" +- {r['spread']:.2g}" if r["spread"] else ""
    return f"{r['what']}, {r['kind']}, {r['size']}: {r['value']:.4g}{spread} {r['unit']}"


# --------------------------------------------------------------------------------------------------------- right or not


def agreement(device: str) -> list[Row]:
    """Relative difference between the device and the CPU, each beside what rounding allows."""
    found = []
    for name, material in MATERIALS.items():
        found.append(differs(f"grid, {name}", lambda on, m=material: swing(m, "explicit", on), device, 1e-8))
    found.append(differs("grid, implicit", lambda on: swing(NeoHookean(), "implicit", on), device, 1e-6))
    found.append(differs("without a grid", lambda on: by_modes(on), device, 1e-12))
    # float32: pixels of order 50 are exact to 4e-6, sums of thousands of terms to 1e-4 of the largest
    found.append(differs("renderer", lambda on: drawing(on), device, 1e-3))
    return found


def differs(what: str, compute: Callable[[str], list[torch.Tensor]], device: str, allowed: float) -> Row:
    """The greatest difference of one of the results, of its own greatest number; `spread` is what is allowed."""
    most = 0.0
    for here, there in zip(compute("cpu"), compute(device), strict=True):
        here, there = here.detach().double(), there.detach().cpu().double()
        most = max(most, float((here - there).abs().max() / here.abs().max()))
    return row(what, "device against CPU", "", most, "relative difference", allowed)


def disagreements(rows: list[Row]) -> list[str]:
    return [
        f"{r['what']}: the device differs from the CPU by {r['value']:.2g}, {r['spread']:.0e} is allowed"
        for r in rows
        if r["unit"] == "relative difference" and not r["value"] <= r["spread"]
    ]


def beam() -> tuple[torch.Tensor, torch.Tensor]:
    """Position [m] and volume [m^3] of 8 x 3 x 3 cells of 0.1 m."""
    axes = [(torch.arange(2 * n, dtype=torch.float64) + 0.5) * 0.05 for n in (8, 3, 3)]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return position, torch.full((len(position),), 0.05**3, dtype=torch.float64)


CLAMP = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.1, 1.0, 1.0))
POKE = Impulse(force=(0.0, 3.0, -4.0), centre=(0.75, 0.15, 0.15), radius=0.12, start=0.0, duration=0.05)


def of_the_beam(material, **more) -> World:
    return World(
        material=material, density=1000.0, start={k: START[k] for k in material.parameters}, dx=0.1,
        gravity=(0.0, 0.0, 0.0), boundaries=(CLAMP,), lower=(-1.0, -1.0, -1.0), upper=(2.0, 1.0, 1.0), **more,
    )  # fmt: skip


def swing(material, scheme: str, device: str) -> list[torch.Tensor]:
    """Where a poked beam is after three frames, and gradients of that by its parameters, in double precision."""
    world = of_the_beam(material, scheme=scheme, precision="float64")
    parameters = {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in world.start.items()}
    motion = rollout(
        world, parameters, *beam(), excitation=(POKE,), frames=3, frame_dt=0.02, device=device, log=Log(None)
    )
    moved = motion.position - motion.rest_position
    gradients = torch.autograd.grad(moved[-1].square().sum(), list(parameters.values()))
    return [moved, *gradients]


def by_modes(device: str) -> list[torch.Tensor]:
    world = of_the_beam(Viscoelastic(), solver="modes")
    motion = motion_of(world, *beam(), excitation=(POKE,), device=device, log=Log(None))
    return [motion(world.estimate().parameters, frames=4, frame_dt=0.02, log=Log(None)).position]


def drawing(device: str) -> list[torch.Tensor]:
    """A picture, and gradients of a function of it."""
    inputs, camera = ball_of_gaussians(400, 64, 0, device)
    image = rasterize(*inputs, camera, background=torch.ones(3, device=device)).color
    weight = torch.linspace(0, 1, image.numel(), device=device).reshape(image.shape)
    return [image, *torch.autograd.grad((weight * image).sum(), inputs)]


# ---------------------------------------------------------------------------------------------------------- how fast


def synchronise(device: str) -> None:
    if device.startswith("cuda"):
        wp.synchronize_device(device)
        torch.cuda.synchronize(device)


def timed(work: Callable[[], object], device: str) -> float:
    synchronise(device)
    start = time.perf_counter()
    work()
    synchronise(device)
    return time.perf_counter() - start


def copying(device: str, amount: Amount) -> Row:
    """Bytes read and written per second by a copy."""
    a = torch.zeros(max(amount.copied) // 4, device=device)
    b = torch.empty_like(a)

    def run(size: int) -> tuple[float, int]:
        return timed(lambda: [b[: size // 4].copy_(a[: size // 4]) for _ in range(8)], device), 16 * size

    run(max(amount.copied))
    seconds, spread = slope(run, amount.copied, 5)
    return row("copy", "read and written", max(amount.copied), 1e-9 / seconds, "GB/s", 1e-9 * spread / seconds**2)


def cube(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """(position [m], volume [m^3], dx [m]) of about `count` particles in a cube of 1 m."""
    side = round(count ** (1 / 3))
    lattice = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = (lattice + 0.5 + 0.2 * torch.rand(len(lattice), 3, generator=torch.Generator().manual_seed(seed))) / side
    return position, torch.full((len(position),), 1.0 / side**3), 2.0 / side


def run_of(name: str, count: int, device: str, seed: int, *, backward: bool) -> Callable[[int], tuple[float, int]]:
    """length [substeps] -> (seconds, substeps taken) of a rollout of one frame."""
    position, volume, dx = cube(count, seed)
    world = World(
        material=MATERIALS[name], density=1000.0, start={k: START[k] for k in MATERIALS[name].parameters}, dx=dx,
        gravity=(0.0, 0.0, 0.0), scheme="explicit",
    )  # fmt: skip
    parameters = {k: torch.tensor(v, requires_grad=True) for k, v in world.start.items()}
    velocity = torch.stack([0.1 * position[:, 1], -0.1 * position[:, 0], 0 * position[:, 0]], -1)

    def run(length: int) -> tuple[float, int]:
        options = dict(velocity=velocity, frames=2, frame_dt=length * 0.5 * dx / 20, device=device, log=Log(None))
        taken = []

        def work() -> None:
            with torch.set_grad_enabled(backward):
                motion = rollout(world, parameters, position, volume, **options)
            if backward:
                motion.position.square().sum().backward()
            taken.append(motion.substeps)

        seconds = timed(work, device)
        return seconds, taken[0]

    return run


def simulation(name: str, count: int, device: str, seed: int, amount: Amount) -> list[Row]:
    rows, n = [], len(cube(count, seed)[0])
    for kind, backward in (("forward", False), ("forward + adjoint", True)):
        run = run_of(name, count, device, seed, backward=backward)
        run(amount.lengths[0])
        seconds, spread = slope(run, amount.lengths, amount.rounds)
        rows.append(row(name, kind, n, 1e9 * seconds / n, PER_SUBSTEP, 1e9 * spread / n))
        if not backward:
            per_second = row(name, "forward", n, n / seconds, "particle-substeps per second", n * spread / seconds**2)
            rows.append(per_second)
    return rows


def bytes_moved(name: str) -> float:
    """Per particle and substep in float32: what the separate kernels have to read and write, each array once."""
    material = MATERIALS[name]
    start = {k: torch.tensor(START[k], dtype=torch.float64) for k in material.parameters}
    coefficients, memory = len(material.coefficients(start)), material.memory_rows
    scatter = 3 + 3 + 9 + 9 + 3 + 3 + 2  # u, v, L, tau, cell, offset, mass and volume
    gather = 3 + 3 + 3 + 12  # u, cell, offset; v and L
    advance = 3 + 12 + 9 + coefficients + memory + 3 + 9 + 9 + memory  # u, v, L, H, material; u, H, tau
    nodes = (4 + 4 + 8 + 7 + 3) / 8  # cleared, added to, summed up, updated, read; eight particles per node
    return 4 * (scatter + gather + advance + nodes)


def share(r: Row, copied: Row) -> Row:
    """Of the bandwidth, by a forward row."""
    found = bytes_moved(r["what"]) / r["value"] / copied["value"]
    spread = abs(found) * (r["spread"] / abs(r["value"]) + copied["spread"] / copied["value"])
    return row(r["what"], "share of the bandwidth of a copy", r["size"], found, "share", spread)


def graphs(device: str, seed: int, amount: Amount) -> list[Row]:
    """The smallest body as graphs, as everywhere on a GPU, and launched one kernel after the other."""
    whole, rows, name = arrays.Arrays.__init__, [], "fixed corotated"
    for kind, recorded in (("as a graph", True), ("launched one by one", False)):
        # what no user chooses: on a GPU it is always the graph
        arrays.Arrays.__init__ = lambda self, recorded=recorded, **given: whole(
            self, **(given | dict(recorded=recorded, fast=False, threads=1))
        )
        try:
            run = run_of(name, amount.particles[0], device, seed, backward=False)
            run(amount.lengths[0])
            seconds, spread = slope(run, amount.lengths, amount.rounds)
        finally:
            arrays.Arrays.__init__ = whole
        rows.append(row(name, kind, amount.particles[0], 1e6 * seconds, "us per substep", 1e6 * spread))
    return rows


def memory(device: str, seed: int, count: int) -> list[Row]:
    rows = []
    for kind, backward in (("forward", False), ("forward + adjoint", True)):
        run, n = run_of("fixed corotated", count, device, seed, backward=backward), len(cube(count, seed)[0])
        rows.append(row("memory", kind, n, most_lent(lambda run=run: run(64), device) / n, "bytes per particle"))
    return rows


def most_lent(work: Callable[[], object], device: str) -> float:
    """Bytes that the device lends in the midst of the work beyond those before; of the process on a CPU."""
    seen, done = [], threading.Event()

    def lent() -> int:
        if device.startswith("cuda"):
            free, all_of_it = torch.cuda.mem_get_info(device)
            return all_of_it - free
        try:
            return int(Path("/proc/self/statm").read_text().split()[1]) * 4096
        except OSError:
            return 0

    def look() -> None:
        while not done.wait(0.005):
            seen.append(lent())

    if device.startswith("cuda"):
        torch.cuda.empty_cache()
    before, watcher = lent(), threading.Thread(target=look)
    watcher.start()
    try:
        work()
    finally:
        done.set()
        watcher.join()
    return max(1, max(seen, default=before) - before)


def ball_of_gaussians(count: int, side: int, seed: int, device: str) -> tuple[list[torch.Tensor], Camera]:
    """Gaussians in a ball, a few pixels wide each, and a camera."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.randn(count, 3, generator=generator) * 0.3
    scale = 0.012 * (20_000 / count) ** (1 / 3) * (1 + torch.rand(count, 3, generator=generator))
    opacity, color = torch.rand(count, generator=generator), torch.rand(count, 3, generator=generator)
    inputs = [v.to(device).requires_grad_() for v in (mean, torch.diag_embed(scale.square()), opacity, color)]
    pose = look_at(torch.tensor([0.0, -3.0, 0.5]), torch.zeros(3))
    return inputs, Camera(width=side, height=side, fx=side, fy=side, cx=side / 2, cy=side / 2, world_to_camera=pose)


def rendering(count: int, side: int, device: str, seed: int) -> list[Row]:
    inputs, camera = ball_of_gaussians(count, side, seed, device)
    background, rows = torch.ones(3, device=device), []
    for kind, backward in (("forward", False), ("forward + adjoint", True)):

        def pictures(number: int, backward: bool = backward) -> tuple[float, int]:
            def work() -> None:
                for _ in range(number):
                    with torch.set_grad_enabled(backward):
                        image = rasterize(*inputs, camera, background=background).color
                    if backward:
                        image.square().sum().backward()

            return timed(work, device), number

        pictures(1)
        seconds, spread = slope(pictures, (1, 3, 5), 5)
        rows.append(row(f"render {side} x {side}", kind, count, 1e3 * seconds, "ms per picture", 1e3 * spread))
    return rows


# ------------------------------------------------------------------------------------------------ carnation and lego


def carnation(device: str, seed: int, amount: Amount) -> list[Row]:
    truth = flower(seed, device)
    cameras = photographers(amount.views, 320, 240)
    background = torch.tensor([0.7, 0.75, 0.8], device=device)
    with torch.no_grad():
        drawn = [render(truth, camera, background=background) for camera in cameras]
    photographs = [Photograph(camera=c, color=d.color, alpha=None) for c, d in zip(cameras, drawn)]
    points = truth.mean[:: max(1, len(truth) // 5000)].cpu()
    start = from_points(points, torch.full((len(points), 3), 0.5), sh_degree=1)
    found: list[Gaussians] = []
    seconds = timed(lambda: found.append(fitted(start, photographs, background, amount, 1, seed)), device)
    with torch.no_grad():
        error = [
            float((render(found[0], p.camera, background=background).color - p.color).square().mean())
            for p in photographs
        ]
    rows = [row("carnation", "reconstruct", len(found[0]), seconds, "s")]
    rows.append(row("carnation", "reconstruct", len(found[0]), -10 * math.log10(statistics.mean(error)), "dB"))
    return rows + learning(found[0], cameras[0], background, amount.frames, device)


def fitted(start, photographs, background, amount: Amount, times: int, seed: int) -> Gaussians:
    iterations = times * amount.iterations
    return fit(
        start, photographs, [], background=background, iterations=iterations,
        max_gaussians=amount.carnation_gaussians * (1 if times == 1 else 3), densification=Adaptive(), ssim_weight=0.2,
        rates=Rates(), exposure=False, check_every=max(1, iterations // 4), patience=4, seed=seed, log=Log(None),
        preview=lambda model, step: None,
    )  # fmt: skip


def flower(seed: int, device: str) -> Gaussians:
    """The carnation's meshes: a flat Gaussian on each of their faces."""
    corners, colors = [], []
    for mesh in plant(seed)[0]:
        corners.append(mesh.vertices[mesh.faces])
        colors.append(mesh.albedo[mesh.faces].mean(1))
    face, color = torch.from_numpy(np.concatenate(corners)), torch.from_numpy(np.concatenate(colors))
    points = from_points(face.mean(1).double(), color.clamp(0, 1), sh_degree=1)
    width = (face - face.mean(1, keepdim=True)).norm(dim=-1).amax(1).clamp(min=1e-5)
    return replace(
        points, log_scale=torch.log(0.5 * width)[:, None].repeat(1, 3), opacity_logit=torch.full((len(face),), 3.0)
    ).to(device)


def learning(gaussians: Gaussians, camera: Camera, background: torch.Tensor, frames: int, device: str) -> list[Row]:
    """Seconds of one step of learning by the grid, the second one: kernels are there."""
    spacing = 0.006
    position = stem_and_blossom(spacing)
    volume = torch.full((len(position),), spacing**3, dtype=torch.float64)
    world = World(
        material=Viscoelastic(), density=300.0, start=START, dx=2 * spacing, gravity=(0.0, 0.0, 0.0), solver="grid",
        boundaries=(FixedRegion(lower=(-0.1, -0.1, -0.1), upper=(0.1, 0.1, SOIL)),),
    )  # fmt: skip
    push = Impulse(force=(0.09, 0.02, 0.0), centre=blossom_centre(), radius=0.05, start=0.0, duration=0.1)
    which = torch.arange(len(gaussians))
    embedding = embed(gaussians.mean.double().cpu(), which, position, spacing)
    X = position.to(device, torch.float32)

    def step() -> None:
        parameters = {k: torch.tensor(v, requires_grad=True) for k, v in world.start.items()}
        motion = rollout(
            world, parameters, position, volume, excitation=(push,), frames=frames, frame_dt=1 / 30, device=device,
            log=Log(None),
        )  # fmt: skip
        loss = torch.zeros((), device=device)
        for t in range(frames):
            x, F = motion.position[t], motion.deformation[t]
            drawn = render_deformed(gaussians, embedding, X, x, F, camera.scaled(0.5), background=background)
            loss = loss + drawn.color.square().mean()
        loss.backward()

    step()
    return [row("carnation", "a step of learning by the grid", len(position), timed(step, device), "s")]


def stem_and_blossom(spacing: float) -> torch.Tensor:
    """Particles [p, 3] m within 1.1 cm of the stem, or 4.5 cm of the blossom's middle."""
    curve = torch.from_numpy(np.asarray(stem_curve(np.linspace(0, 1, 60))[0]))
    centre = torch.tensor(blossom_centre(), dtype=torch.float64)
    lower, upper = curve.amin(0) - 0.08, torch.maximum(curve.amax(0), centre) + 0.08
    axes = [torch.arange(float(a), float(b), spacing, dtype=torch.float64) for a, b in zip(lower, upper)]
    lattice = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    near = (torch.cdist(lattice, curve).amin(1) < 0.011) | ((lattice - centre).norm(dim=1) < 0.045)
    return lattice[near]


def lego(data: Path, device: str, seed: int, amount: Amount) -> Row:
    """Its photographs as the scene of that name fits them."""
    from physics3d.scenes.transforms import TransformsSource

    file = data / "lego" / "transforms_train.json"
    if not file.exists():
        sys.exit(f"error: {file} is not there; take data=<folder that holds it>, or leave data out")
    source = TransformsSource(name="lego", path=str(file), up=(0.0, 0.0, 1.0), scale=0.2, single_object=True)
    capture = source(log=Log(None))
    photographs = [
        Photograph(camera=c, color=i.to(device), alpha=a.to(device))
        for c, i, a in zip(capture.cameras, capture.images, capture.alphas)
    ]
    photographs = [p.scaled(400 / max(p.camera.width, p.camera.height)) for p in photographs]
    cloud = (torch.rand(5000, 3, generator=torch.Generator().manual_seed(seed)) - 0.5) * 0.4
    start = from_points(cloud, torch.full((5000, 3), 0.5), sh_degree=2)
    background, found = torch.ones(3, device=device), []
    seconds = timed(lambda: found.append(fitted(start, photographs, background, amount, 4, seed)), device)
    return row("lego", "reconstruct", len(found[0]), seconds, "s")


# ---------------------------------------------------------------------------------------------------------- the page


def write(rows: list[Row], where: str, seed: int, seconds: float, out: Path) -> None:
    from matplotlib.figure import Figure

    out.mkdir(parents=True, exist_ok=True)
    title = f"{where}, seed {seed}"
    with (out / "gpu.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)
    lines = ["# On a GPU: right, and how fast", "", f"Made by `make bench-gpu` in {seconds:.0f} s. Machine: {title}."]
    lines += ["", *__doc__.split("\n\n", 2)[2].strip().splitlines(), "", "![cost against particles](gpu.png)", ""]
    lines += ["| what | | size | value | spread, or what is allowed | unit |", "|---|---|---|---|---|---|"]
    for r in rows:
        spread = f"{r['spread']:.2g}" if r["spread"] else ""
        lines.append(f"| {r['what']} | {r['kind']} | {r['size']} | {r['value']:.4g} | {spread} | {r['unit']} |")
    (out / "gpu.md").write_text("\n".join(lines) + "\n")
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axis = figure.add_subplot()
    for i, name in enumerate(MATERIALS):
        for style, kind in (("-", "forward"), ("--", "forward + adjoint")):
            mine = [r for r in rows if (r["what"], r["kind"], r["unit"]) == (name, kind, PER_SUBSTEP)]
            x, y, spread = ([r[key] for r in mine] for key in ("size", "value", "spread"))
            axis.errorbar(x, y, spread, fmt=f"o{style}", color=f"C{i}", capsize=3, label=f"{name}, {kind}")
    axis.set(xscale="log", yscale="log", xlabel="particles", ylabel=PER_SUBSTEP)
    axis.set_title(title, fontsize=8)
    axis.legend(fontsize=7)
    axis.grid(alpha=0.3, which="both")
    figure.savefig(out / "gpu.png", dpi=110)


if __name__ == "__main__":
    main(sys.argv[1:])
