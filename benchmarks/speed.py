"""Cost of the simulator and the renderer, forward and with adjoint, against size; compilation; memory; a peer beside.

    python benchmarks/speed.py [device=cpu] [seed=0] [peers=/path/to/python]   ->   docs/results/speed_<device>.*

A body is a jittered cube, 8 particles per cell, in a little motion, float32; times are the best of three after a
warm-up, that of a long run minus that of a short one, so that setting up a rollout does not count. `empty cells` is
a body with two lone particles beside it, near or so far away that the box around all has 8 times the nodes. `resident`
is what the process holds while it simulates, less what it held before. Compilation is that of a first rollout on an
empty kernel cache, less that of a second one. `peers` names a Python that has Taichi; its own example mpm3d (one
pressure per particle, no solid) runs there with the same number of particles, on 64^3 nodes and all cores, between our
rows.
"""

import csv
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import torch
import warp as wp
from machine import machine

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.rasterize import rasterize
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout
from physics3d.world import World

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
MATERIALS = {
    "fixed corotated": Viscoelastic(branches=0),
    "viscoelastic, one branch": Viscoelastic(branches=1),
    "neo-Hookean": NeoHookean(),
}
START = {
    "youngs_modulus": 1e5, "poissons_ratio": 0.3, "branch_shear_modulus": 2e4, "branch_bulk_modulus": 4e4,
    "shear_relaxation_time": 0.1, "bulk_relaxation_time": 0.1,
}  # fmt: skip
PER_SUBSTEP = "ns per particle and substep"


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    device, seed, peers = options.get("device", "cpu"), int(options.get("seed", 0)), options.get("peers", "")
    if "compile" in options:
        print(json.dumps(first_rollout(options["compile"], device)))
        return
    cuda = device.startswith("cuda")
    rows: list[dict] = []

    def keep(*more: dict) -> None:
        rows.extend(more)
        for row in more:
            print(f"{row['what']}, {row['size']}: {row['value']:.4g} {row['unit']}", flush=True)
        write(rows, device, seed)

    for name in MATERIALS:
        keep(compilation(name, device))
    for count in (10_000, 100_000, 1_000_000) if cuda else (1_000, 10_000, 100_000):
        for name in MATERIALS:
            keep(*simulation(name, count, device, seed))
        if peers and count == 100_000:
            keep(*taichi(peers, count))
    if not cuda:
        keep(*simulation("fixed corotated", 1_000_000, device, seed, backward=False))
    keep(*empty_cells(device, seed))
    for count, side in ((20_000, 320), (50_000, 400), *(((500_000, 800),) if cuda else ())):
        keep(*rendering(count, side, device, seed))
    if not peers:
        print("no peer: peers=/path/to/python of an environment with Taichi")


def row(what: str, size: int, value: float, unit: str) -> dict:
    return dict(what=what, size=size, value=value, unit=unit)


def cube(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """(position [m], volume [m^3], dx [m]) of about `count` particles in a cube of 1 m."""
    generator = torch.Generator().manual_seed(seed)
    side = round(count ** (1 / 3))
    lattice = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = (lattice + 0.5 + 0.2 * torch.rand(len(lattice), 3, generator=generator)) / side
    return position, torch.full((len(position),), 1.0 / side**3), 2.0 / side


def run(name: str, position, volume, dx: float, device: str, frame_dt: float, *, backward: bool) -> tuple[float, int]:
    """Seconds and substeps of a rollout of two frames."""
    material = MATERIALS[name]
    world = World(
        material=material, density=1000.0, start={k: START[k] for k in material.parameters}, dx=dx,
        gravity=(0.0, 0.0, 0.0), scheme="explicit",
    )  # fmt: skip
    parameters = {k: torch.tensor(v, requires_grad=True) for k, v in world.start.items()}
    velocity = torch.stack([0.1 * position[:, 1], -0.1 * position[:, 0], 0 * position[:, 0]], -1)
    options = dict(velocity=velocity, frames=2, frame_dt=frame_dt, device=device, log=Log(None))
    start = time.perf_counter()
    if backward:
        motion = rollout(world, parameters, position, volume, **options)
        motion.position.square().sum().backward()
    else:
        with torch.no_grad():
            motion = rollout(world, parameters, position, volume, **options)
    synchronise(device)
    return time.perf_counter() - start, motion.substeps


def per_substep(name: str, position, volume, dx: float, device: str, substeps: int, **options) -> float:
    """Seconds per substep, the long run having four times the `substeps` of the short one."""
    substep = 0.5 * dx / 20.0  # [s]; the run says how many it took
    short = long = math.inf
    run(name, position, volume, dx, device, substep, **options)
    for _ in range(3 if substeps > 8 else 1):
        seconds, few = run(name, position, volume, dx, device, substeps * substep, **options)
        short = min(short, seconds)
        seconds, many = run(name, position, volume, dx, device, 4 * substeps * substep, **options)
        long = min(long, seconds)
    return (long - short) / (many - few)


def simulation(name: str, count: int, device: str, seed: int, *, backward: bool = True) -> list[dict]:
    position, volume, dx = cube(count, seed)
    n = len(position)
    # few of them where they take seconds, many on a GPU
    substeps = (256 if count < 1_000_000 else 64) if device.startswith("cuda") else 32 if count < 1_000_000 else 8
    watched, forward = watch(lambda: per_substep(name, position, volume, dx, device, substeps, backward=False))
    rows = [row(f"{name}, forward", n, 1e9 * forward / n, PER_SUBSTEP)]
    if count == 1_000_000 and not device.startswith("cuda"):
        rows.append(row(f"{name}, resident forward", n, watched / n, "bytes per particle"))
    if backward:
        both = per_substep(name, position, volume, dx, device, substeps, backward=True)
        rows.append(row(f"{name}, forward + adjoint", n, 1e9 * both / n, PER_SUBSTEP))
        rows.append(row(f"{name}, adjoint / forward", n, both / forward - 1, "ratio"))
    return rows


def watch(work) -> tuple[float, float]:
    """(bytes the process holds in the middle of the work beyond those before, result)."""
    seen, done = [], threading.Event()

    def look() -> None:
        while not done.wait(0.05):
            seen.append(resident())

    before, thread = resident(), threading.Thread(target=look)
    thread.start()
    try:
        result = work()
    finally:
        done.set()
        thread.join()
    return statistics.median(seen or [before]) - before, result


def resident() -> int:
    """Bytes of memory this process holds (Linux); 0 elsewhere."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def empty_cells(device: str, seed: int) -> list[dict]:
    """A body and two lone particles, in a box as small as possible and in one of eight times the nodes."""
    position, volume, dx = cube(20_000, seed)
    rows = []
    for factor, what in ((1.0, "near"), (2.0, "far, 8 x the nodes")):
        lone = torch.tensor([[-0.3, -0.3, -0.3], [1.3, 1.3, 1.3]]) + torch.tensor([[0.0], [1.6 * (factor - 1)]])
        both = torch.cat([position, lone])
        seconds = per_substep(
            "fixed corotated", both, torch.cat([volume, volume[:2]]), dx, device, 32, backward=False
        )  # fmt: skip
        rows.append(row(f"empty cells, lone particles {what}", len(both), 1e9 * seconds / len(both), PER_SUBSTEP))
    return rows


def compilation(name: str, device: str) -> dict:
    """A small rollout and its gradient in a process of its own, with a kernel cache of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, f"compile={name}", f"device={device}"]
        found = subprocess.run(
            command, env=os.environ | {"WARP_CACHE_PATH": folder}, check=True, capture_output=True, text=True
        ).stdout
    return row(f"{name}, compilation", 8, json.loads(found.strip().splitlines()[-1]), "s")


def first_rollout(name: str, device: str) -> float:
    position, volume, dx = cube(8, 0)
    first, again = (run(name, position, volume, dx, device, 0.01, backward=True)[0] for _ in range(2))
    return first - again


def taichi(python: str, count: int) -> list[dict]:
    """Taichi's own mpm3d, as installed, with more particles and nodes; nothing if that Python has no Taichi."""
    script = """
import importlib.util, json, pathlib, sys, tempfile, time
import taichi as ti
source = pathlib.Path(importlib.util.find_spec("taichi").origin).parent / "examples" / "simulation" / "mpm3d.py"
text = source.read_text()
for old, new in (("arch=ti.gpu", "arch=ti.cpu"), ("dim, n_grid, steps, dt = 3, 32, 25, 4e-4",
                 "dim, n_grid, steps, dt = 3, 64, 25, 2e-4"), ("n_particles = n_grid**dim // 2 ** (dim - 1)",
                 "n_particles = COUNT")):
    assert old in text, old
    text = text.replace(old, new.replace("COUNT", sys.argv[1]))
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "mpm3d_here.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location("mpm3d_here", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.init()
    times = []
    for _ in range(4):
        ti.sync()
        start = time.perf_counter()
        for _ in range(25):
            example.substep()
        ti.sync()
        times.append((time.perf_counter() - start) / 25)
    print(json.dumps([sorted(times[1:])[1], ".".join(map(str, ti.__version__))]))
"""
    done = subprocess.run([python, "-c", script, str(count)], capture_output=True, text=True)
    if done.returncode:
        print(f"no row of Taichi: {(done.stderr.strip().splitlines() or ['?'])[-1]}")
        return []
    seconds, version = json.loads(done.stdout.strip().splitlines()[-1])
    return [row(f"Taichi {version} mpm3d, forward", count, 1e9 * seconds / count, PER_SUBSTEP)]


def rendering(count: int, side: int, device: str, seed: int) -> list[dict]:
    """Gaussians in a ball, a few pixels wide each: ms per picture."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.randn(count, 3, generator=generator) * 0.3
    scale = 0.012 * (20_000 / count) ** (1 / 3) * (1 + torch.rand(count, 3, generator=generator))
    covariance = torch.diag_embed(scale.square())
    opacity, color = torch.rand(count, generator=generator), torch.rand(count, 3, generator=generator)
    inputs = [v.to(device).requires_grad_() for v in (mean, covariance, opacity, color)]
    pose = look_at(torch.tensor([0.0, -3.0, 0.5]), torch.zeros(3))
    camera = Camera(width=side, height=side, fx=side, fy=side, cx=side / 2, cy=side / 2, world_to_camera=pose)
    rows = []
    for backward in (False, True):
        times = []
        for _ in range(4):
            synchronise(device)
            start = time.perf_counter()
            image = rasterize(*inputs, camera, background=torch.ones(3, device=device)).color
            if backward:
                image.square().sum().backward()
            synchronise(device)
            times.append(time.perf_counter() - start)
        what = f"render {side} x {side}, {'forward + adjoint' if backward else 'forward'}"
        rows.append(row(what, count, 1e3 * statistics.median(times[1:]), "ms per picture"))
    return rows


def synchronise(device: str) -> None:
    if device.startswith("cuda"):
        wp.synchronize()
        torch.cuda.synchronize()


def write(rows: list[dict], device: str, seed: int) -> None:
    from matplotlib.figure import Figure

    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine(device)}, seed {seed}"
    kind = device.split(":")[0]
    with (RESULTS / f"speed_{kind}.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)
    (RESULTS / f"speed_{kind}.md").write_text(page(rows, title, kind))
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axis = figure.add_subplot()
    timed = [r for r in rows if r["unit"] == PER_SUBSTEP and not r["what"].startswith("empty")]
    for i, name in enumerate(dict.fromkeys(r["what"].rsplit(", ", 1)[0] for r in timed)):
        for style, what in (("-", "forward"), ("--", "forward + adjoint")):
            mine = [r for r in timed if r["what"] == f"{name}, {what}"]
            if mine:
                sizes, values = [r["size"] for r in mine], [r["value"] for r in mine]
                axis.plot(sizes, values, style, marker="o", color=f"C{i}", label=f"{name}, {what}")
    axis.set(xscale="log", yscale="log", xlabel="particles", ylabel=PER_SUBSTEP, title=title)
    axis.title.set_size(8)
    if axis.lines:
        axis.legend(fontsize=7)
    axis.grid(alpha=0.3, which="both")
    figure.savefig(RESULTS / f"speed_{kind}.png", dpi=110)


def page(rows: list[dict], title: str, kind: str) -> str:
    lines = ["# Speed and memory", "", f"Made by `make bench-speed`. Machine: {title}.", ""]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), "", f"![cost against particles](speed_{kind}.png)", ""]
    sentences = findings(rows)
    if sentences:
        lines += ["## What it shows", "", *(f"- {sentence}" for sentence in sentences), ""]
    lines += ["## Rows", "", "| what | size | value | unit |", "|---|---|---|---|"]
    lines += [f"| {r['what']} | {r['size']} | {r['value']:.4g} | {r['unit']} |" for r in rows]
    return "\n".join(lines) + "\n"


def findings(rows: list[dict]) -> list[str]:
    sentences = []
    solid = [r for r in rows if r["what"] == "fixed corotated, forward"]
    peer = next((r for r in rows if r["what"].startswith("Taichi")), None)
    here = next((r for r in solid if peer and abs(r["size"] / peer["size"] - 1) < 0.1), None)
    if peer and here:
        name = peer["what"].split(",")[0]
        sentences.append(
            f"{name} takes {peer['value'] / here['value']:.1f} times as long per particle and substep as the fixed "
            f"corotated solid ({peer['value']:.0f} and {here['value']:.0f} ns)."
        )
    if len(solid) > 1:
        costs = ", ".join(f"{r['value']:.0f} ns at {r['size']:.0e}" for r in solid)
        sentences.append(f"Cost per particle and substep against size: {costs} particles.")
    empty = [r["value"] for r in rows if r["what"].startswith("empty")]
    if len(empty) == 2:
        sentences.append(
            f"Eight times the nodes around the same particles cost {empty[1] / empty[0]:.2f} times as much."
        )
    for r in rows:
        if r["what"].endswith("resident forward"):
            sentences.append(
                f"A forward run holds {r['value']:.0f} bytes per particle, its inputs and frames included."
            )
    return sentences


if __name__ == "__main__":
    main(sys.argv[1:])
