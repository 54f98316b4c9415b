"""Cost of simulator and renderer, forward and with adjoint, against size and cores; compilation; memory; a peer.

    python benchmarks/speed.py [seed=0] [peers=/path/to/python] [most=1000000]   ->   docs/results/speed_cpu.*

A body is a jittered cube, 8 particles per cell, in a little motion, float32. A cost is the median slope of time over
four lengths of a run, each run several times in turn, with half the distance of the quartiles as its spread
(`slopes.py`), so that setting up a rollout does not count. Time is processor time on one thread, which other work on
the machine hardly changes, and wall clock on two, which it does: two are measured where the load is one at most. Rows
that contradict each other beyond their spreads end the command with an error, and nothing is written. `empty cells` is
a body with two lone particles beside it, near or so far away that the box around all has 8 times the nodes. `resident`
is what the process holds while it simulates, less what it held before. Compilation is that of a first rollout on an
empty kernel cache, less that of a second one. `peers` names a Python that has Taichi; its own example mpm3d (one
pressure per particle, no solid) runs there with the same number of particles, on 64^3 nodes, in the same run. A GPU is
measured by `make bench-gpu`.
"""

import csv
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import torch
from machine import machine
from slopes import contradictions, slope

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
SIMPLER = (("fixed corotated", "viscoelastic, one branch"),)
UNSURE = 0.5
QUIET = 1.0  # load of the machine above which a second thread is not measured
HUGE = 500_000  # particles whose arrays take seconds to set up
PER_SUBSTEP = "ns per particle and substep"


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    device, seed, peers = options.get("device", "cpu"), int(options.get("seed", 0)), options.get("peers", "")
    if "compile" in options:
        print(json.dumps(first_rollout(options["compile"], device)))
        return
    if device != "cpu":
        sys.exit("error: this is for a CPU; make bench-gpu measures a GPU")
    most, begun = int(options.get("most", 1_000_000)), os.getloadavg()[0]
    cores = (1, 2) if begun <= QUIET else (1,)
    rows: list[dict] = []

    def keep(*more: dict) -> None:
        rows.extend(more)
        for r in more:
            print(f"{named(r)}: {r['value']:.4g} +- {r['spread']:.2g} {r['unit']}", flush=True)

    for name in MATERIALS:
        keep(compilation(name, device))
    for count in (1_000, 10_000, 100_000):
        for name in MATERIALS:
            for threads in cores:
                if count <= most:
                    keep(*simulation(name, count, threads, seed))
        if peers and count == 100_000 <= most:
            for threads in cores:
                keep(*taichi(peers, count, threads))
    if most >= 1_000_000:
        for threads in cores:
            keep(*simulation("fixed corotated", 1_000_000, threads, seed, backward=False))
    keep(*empty_cells(seed))
    for count, side in ((20_000, 320), (50_000, 400)):
        keep(*rendering(count, side, device, seed))
    if not peers:
        print("no peer: peers=/path/to/python of an environment with Taichi")
    wrong = contradictions(rows, simpler=SIMPLER)
    if wrong:
        sys.exit("error: nothing is written, for rows contradict each other:\n" + "\n".join(wrong))
    write(rows, device, seed, (begun, os.getloadavg()[0]))


def row(
    what: str, kind: str, size: int, value: float, unit: str, *, spread: float = 0.0, threads: int | str = ""
) -> dict:
    return dict(what=what, kind=kind, size=size, threads=threads, value=value, spread=spread, unit=unit)


def named(r: dict) -> str:
    threads = f", {r['threads']} thread{'s' if r['threads'] == 2 else ''}" if r["threads"] else ""
    return f"{r['what']}, {r['kind']}, {r['size']}{threads}"


def cube(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """(position [m], volume [m^3], dx [m]) of about `count` particles in a cube of 1 m."""
    generator = torch.Generator().manual_seed(seed)
    side = round(count ** (1 / 3))
    lattice = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = (lattice + 0.5 + 0.2 * torch.rand(len(lattice), 3, generator=generator)) / side
    return position, torch.full((len(position),), 1.0 / side**3), 2.0 / side


def run(
    name: str, position, volume, dx: float, device: str, frame_dt: float, *, backward: bool, threads: int = 1
) -> tuple[float, int]:
    """Seconds and substeps of a rollout of two frames."""
    material = MATERIALS[name]
    world = World(
        material=material, density=1000.0, start={k: START[k] for k in material.parameters}, dx=dx,
        gravity=(0.0, 0.0, 0.0), scheme="explicit",
    )  # fmt: skip
    parameters = {k: torch.tensor(v, requires_grad=True) for k, v in world.start.items()}
    velocity = torch.stack([0.1 * position[:, 1], -0.1 * position[:, 0], 0 * position[:, 0]], -1)
    options = dict(velocity=velocity, frames=2, frame_dt=frame_dt, device=device, threads=threads, log=Log(None))
    clock = time.process_time if threads == 1 else time.perf_counter
    start = clock()
    with torch.set_grad_enabled(backward):
        motion = rollout(world, parameters, position, volume, **options)
    if backward:
        motion.position.square().sum().backward()
    return clock() - start, motion.substeps


def per_substep(name: str, position, volume, dx: float, *, backward: bool, threads: int) -> tuple[float, float]:
    """(seconds per substep, spread)."""
    n, substep = len(position), 0.5 * dx / 20.0  # [s]; the run says how many it took
    # of a shortest run of a twentieth of a second at least, and of seconds where setting up takes some
    shortest = (12 if n > HUGE else max(4, min(256, 1_000_000 // n))) * (1 if backward else 2)

    def work(length: int) -> tuple[float, int]:
        return run(
            name, position, volume, dx, "cpu", length * shortest * substep, backward=backward, threads=threads
        )  # fmt: skip

    work(1)
    return slope(work, (1, 2, 3, 4), 3)


def simulation(name: str, count: int, threads: int, seed: int, *, backward: bool = True) -> list[dict]:
    position, volume, dx = cube(count, seed)
    n = len(position)
    work = lambda backward: per_substep(name, position, volume, dx, backward=backward, threads=threads)
    watched, (forward, spread) = watch(lambda: work(False))
    cost = lambda kind, seconds, spread: row(
        name, kind, n, 1e9 * seconds / n, PER_SUBSTEP, spread=1e9 * spread / n, threads=threads
    )
    rows = [cost("forward", forward, spread)]
    if count == 1_000_000 and threads == 1:
        rows.append(row(name, "resident forward", n, watched / n, "bytes per particle", threads=threads))
    if backward:
        both, wide = work(True)
        rows.append(cost("forward + adjoint", both, wide))
        ratio = both / forward - 1
        error = (ratio + 1) * (spread / forward + wide / both)
        rows.append(row(name, "adjoint / forward", n, ratio, "ratio", spread=error, threads=threads))
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


def empty_cells(seed: int) -> list[dict]:
    """A body and two lone particles, in a box as small as possible and in one of eight times the nodes."""
    position, volume, dx = cube(20_000, seed)
    rows = []
    for factor, what in ((1.0, "near"), (2.0, "far, 8 x the nodes")):
        lone = torch.tensor([[-0.3, -0.3, -0.3], [1.3, 1.3, 1.3]]) + torch.tensor([[0.0], [1.6 * (factor - 1)]])
        both, volumes = torch.cat([position, lone]), torch.cat([volume, volume[:2]])
        seconds, spread = per_substep("fixed corotated", both, volumes, dx, backward=False, threads=1)
        n = len(both)
        cost, wide = 1e9 * seconds / n, 1e9 * spread / n
        rows.append(row("empty cells", f"lone particles {what}", n, cost, PER_SUBSTEP, spread=wide, threads=1))
    return rows


def compilation(name: str, device: str) -> dict:
    """A small rollout and its gradient in a process of its own, with a kernel cache of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, f"compile={name}", f"device={device}"]
        found = subprocess.run(
            command, env=os.environ | {"WARP_CACHE_PATH": folder}, check=True, capture_output=True, text=True
        ).stdout
    return row(name, "compilation", 8, json.loads(found.strip().splitlines()[-1]), "s")


def first_rollout(name: str, device: str) -> float:
    position, volume, dx = cube(8, 0)
    first, again = (run(name, position, volume, dx, device, 0.01, backward=True)[0] for _ in range(2))
    return first - again


def taichi(python: str, count: int, threads: int) -> list[dict]:
    """Taichi's own mpm3d, as installed, with more particles and nodes; nothing if that Python has no Taichi."""
    script = """
import importlib.util, json, pathlib, sys, tempfile, time
import taichi as ti
source = pathlib.Path(importlib.util.find_spec("taichi").origin).parent / "examples" / "simulation" / "mpm3d.py"
text = source.read_text()
for old, new in (("arch=ti.gpu", f"arch=ti.cpu, cpu_max_num_threads={sys.argv[2]}"),
                 ("dim, n_grid, steps, dt = 3, 32, 25, 4e-4",
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
    clock = time.process_time if sys.argv[2] == "1" else time.perf_counter
    for k in range(21):
        ti.sync()
        start = clock()
        for _ in range(10 * (1 + k % 4)):
            example.substep()
        ti.sync()
        times.append([clock() - start, 10 * (1 + k % 4)])
    print(json.dumps([times[1:], ".".join(map(str, ti.__version__))]))
"""
    done = subprocess.run([python, "-c", script, str(count), str(threads)], capture_output=True, text=True)
    if done.returncode:
        print(f"no row of Taichi: {(done.stderr.strip().splitlines() or ['?'])[-1]}")
        return []
    times, version = json.loads(done.stdout.strip().splitlines()[-1])
    measured = iter(times)
    seconds, spread = slope(lambda length: next(measured), (20, 30, 40, 10), 5)
    name = f"Taichi {version} mpm3d"
    return [
        row(name, "forward", count, 1e9 * seconds / count, PER_SUBSTEP, spread=1e9 * spread / count, threads=threads)
    ]


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
    for kind, backward in (("forward", False), ("forward + adjoint", True)):

        def pictures(number: int, backward: bool = backward) -> tuple[float, int]:
            start = time.process_time()
            for _ in range(number):
                with torch.set_grad_enabled(backward):
                    image = rasterize(*inputs, camera, background=torch.ones(3, device=device)).color
                if backward:
                    image.square().sum().backward()
            return time.process_time() - start, number

        pictures(1)
        seconds, spread = slope(pictures, (1, 3, 5), 4)
        rows.append(
            row(f"render {side} x {side}", kind, count, 1e3 * seconds, "ms per picture", spread=1e3 * spread)
        )  # fmt: skip
    return rows


def write(rows: list[dict], device: str, seed: int, load: tuple[float, float]) -> None:
    """Table, plot and page. What scatters by more than half of itself says nothing, and is left out with a word."""
    from matplotlib.figure import Figure

    told = [r for r in rows if r["spread"] <= UNSURE * abs(r["value"])]
    unsure, rows = len(rows) - len(told), told

    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine(device)}, seed {seed}, load {load[0]:.1f} at the start and {load[1]:.1f} at the end"
    with (RESULTS / "speed_cpu.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)
    (RESULTS / "speed_cpu.md").write_text(page(rows, title, unsure))
    cores = sorted({r["threads"] for r in rows if r["threads"]})
    figure = Figure(figsize=(2 + 5 * len(cores), 5), layout="constrained")
    for axis, threads in zip(figure.subplots(1, len(cores), sharey=True, squeeze=False)[0], cores):
        timed = [r for r in rows if r["unit"] == PER_SUBSTEP and r["threads"] == threads and r["what"] != "empty cells"]
        for i, name in enumerate(dict.fromkeys(r["what"] for r in timed)):
            for style, kind in (("-", "forward"), ("--", "forward + adjoint")):
                mine = [r for r in timed if (r["what"], r["kind"]) == (name, kind)]
                if mine:
                    x, y, spread = ([r[key] for r in mine] for key in ("size", "value", "spread"))
                    axis.errorbar(x, y, spread, fmt=f"o{style}", color=f"C{i}", capsize=3, label=f"{name}, {kind}")
        axis.set(xscale="log", yscale="log", xlabel="particles", title=f"{threads} thread{'s' * (threads - 1)}")
        axis.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel(PER_SUBSTEP)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=7)
    figure.savefig(RESULTS / "speed_cpu.png", dpi=110)


def page(rows: list[dict], title: str, unsure: int) -> str:
    lines = ["# Speed and memory", "", f"Made by `make bench-speed`. Machine: {title}.", ""]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), "", "![cost against particles](speed_cpu.png)", ""]
    lines += ["## What it shows", "", *(f"- {sentence}" for sentence in findings(rows)), ""]
    if not any(r["threads"] == 2 for r in rows):
        lines += ["Two threads were not measured: other work kept the cores.", ""]
    if unsure:
        lines += [f"{unsure} rows are left out: they scatter by more than {UNSURE:.0%} of themselves at this load.", ""]
    lines += ["## Rows", "", "| what | | size | threads | value | spread | unit |", "|---|---|---|---|---|---|---|"]
    for r in rows:
        spread = f"{r['spread']:.2g}" if r["spread"] else ""
        lines.append(
            f"| {r['what']} | {r['kind']} | {r['size']} | {r['threads']} | {r['value']:.4g} | {spread} | {r['unit']} |"
        )
    return "\n".join(lines) + "\n"


def findings(rows: list[dict]) -> list[str]:
    sentences = []
    costs = {(r["what"], r["kind"], r["size"], r["threads"]): r for r in rows if r["unit"] == PER_SUBSTEP}
    for (what, _, size, threads), peer in costs.items():
        if what.startswith("Taichi"):
            alike = [
                r
                for key, r in costs.items()
                if key[:2] == ("fixed corotated", "forward") and key[3] == threads and abs(key[2] / size - 1) < 0.1
            ]
            if not alike:
                continue
            here = alike[0]
            sentences.append(
                f"{what} takes {peer['value'] / here['value']:.1f} times as long per particle and substep as the fixed "
                f"corotated solid, threads: {threads} ({peer['value']:.0f} +- {peer['spread']:.0f} "
                f"and {here['value']:.0f} +- {here['spread']:.0f} ns)."
            )
    for name in MATERIALS:
        gains = [
            f"{r['value'] / costs[what, kind, size, 2]['value']:.2f} at {size}"
            for (what, kind, size, threads), r in costs.items()
            if (what, kind, threads) == (name, "forward", 1) and (what, kind, size, 2) in costs
        ]
        if gains:
            sentences.append(f"{name}: two threads gain {', '.join(gains)} particles.")
        ratios = [
            f"{r['value']:.1f} at {r['size']}"
            for r in rows
            if (r["what"], r["unit"], r["threads"]) == (name, "ratio", 1)
        ]
        if ratios:
            sentences.append(
                f"{name}: the adjoint takes {', '.join(ratios)} particles times the forward run, on one thread."
            )
    empty = [r["value"] for r in rows if r["what"] == "empty cells"]
    if len(empty) == 2:
        sentences.append(
            f"Eight times the nodes around the same particles cost {empty[1] / empty[0]:.2f} times as much."
        )
    for r in rows:
        if r["kind"] == "resident forward":
            sentences.append(
                f"A forward run holds {r['value']:.0f} bytes per particle, its inputs and frames included."
            )
    return sentences


if __name__ == "__main__":
    main(sys.argv[1:])
