"""Cost of the simulator and the renderer, forward and with adjoint, against the number of particles and Gaussians.

    python benchmarks/speed.py [device=cpu] [seed=0]   ->   docs/results/speed_<device>.csv, .png

Each row is the median of three timings after one warm-up on the machine that the table names. Machines may be shared:
rows of one run may be compared with each other and with nothing else.
"""

import csv
import statistics
import sys
import time
from pathlib import Path

import torch
import warp as wp
from machine import machine

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.rasterize import rasterize
from physics3d.log import Log
from physics3d.mpm.materials.neo_hookean import NeoHookean
from physics3d.mpm.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout
from physics3d.mpm.world import World

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
MATERIALS = {
    "fixed corotated": Viscoelastic(branches=0),
    "viscoelastic, one branch": Viscoelastic(branches=1),
    "neo-Hookean": NeoHookean(),
}
START = {
    "youngs_modulus": 1e5, "poissons_ratio": 0.3, "branch_shear_modulus": 2e4, "branch_bulk_modulus": 4e4,
    "shear_viscosity_time": 0.1, "bulk_viscosity_time": 0.1,
}  # fmt: skip


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    device, seed = options.get("device", "cpu"), int(options.get("seed", 0))
    cuda = device.startswith("cuda")
    rows: list[dict] = []

    def keep(more: list[dict]) -> None:
        rows.extend(more)
        for row in more:
            print(f"{row['what']}, {row['size']}: {row['value']:.4g} {row['unit']}", flush=True)
        write(rows, device, seed)

    for count, side in ((20_000, 320), (50_000, 400), *(((500_000, 800),) if cuda else ())):
        keep(rendering(count, side, device, seed))
    for count in (10_000, 100_000, 1_000_000) if cuda else (1_000, 10_000, 100_000):
        for name, material in MATERIALS.items():
            keep(simulation(name, material, count, device, seed))


def simulation(name: str, material, count: int, device: str, seed: int) -> list[dict]:
    """A jittered cube, 8 particles per cell, in a little motion: ns per particle and substep."""
    generator = torch.Generator().manual_seed(seed)
    side = round(count ** (1 / 3))
    dx = 2.0 / side
    lattice = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = (lattice + 0.5 + 0.2 * torch.rand(len(lattice), 3, generator=generator)) / side
    volume = torch.full((len(position),), 1.0 / side**3)
    world = World(
        material=material,
        density=1000.0,
        start={k: START[k] for k in material.parameters},
        dx=dx,
        gravity=(0.0, 0.0, 0.0),
    )
    parameters = {k: torch.tensor(START[k], requires_grad=True) for k in material.parameters}
    velocity = torch.stack([0.1 * position[:, 1], -0.1 * position[:, 0], 0 * position[:, 0]], -1)

    def run(backward: bool) -> tuple[float, int]:
        start = time.perf_counter()
        options = dict(velocity=velocity, frames=2, frame_dt=frame_dt, device=device, log=Log(None))
        if backward:
            motion = rollout(world, parameters, position, volume, **options)
            motion.position.square().sum().backward()
        else:
            with torch.no_grad():
                motion = rollout(world, parameters, position, volume, **options)
        synchronise(device)
        return time.perf_counter() - start, motion.substeps

    # of the short run; the long one has four times as many
    substeps = (256 if count < 1_000_000 else 64) if device.startswith("cuda") else 32
    substep = 0.5 * dx / 20.0  # [s]; the run says how many it took
    frame_dt = substeps * substep
    rows = []
    for backward in (False, True):
        run(backward)
        # setting up a rollout (sorting, health) is no part of a substep: time long minus short
        times = []
        for _ in range(3):
            frame_dt = substeps * substep
            short, few = run(backward)
            frame_dt = 4 * substeps * substep
            long, many = run(backward)
            times.append((long - short) / (many - few))
        rows.append(
            dict(
                what=f"{name}, {'forward + adjoint' if backward else 'forward'}", size=len(position),
                seconds=statistics.median(times), unit="ns per particle and substep",
                value=1e9 * statistics.median(times) / len(position),
            )
        )  # fmt: skip
    return rows


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
        rows.append(
            dict(
                what=f"render {side} x {side}, {'forward + adjoint' if backward else 'forward'}", size=count,
                seconds=statistics.median(times[1:]), unit="ms per picture", value=1e3 * statistics.median(times[1:]),
            )
        )  # fmt: skip
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
    figure = Figure(figsize=(9, 4), layout="constrained")
    axis = figure.add_subplot()
    names = [n for n in dict.fromkeys(r["what"] for r in rows) if not n.startswith("render")]
    for i, name in enumerate(names):
        mine = [r for r in rows if r["what"] == name]
        style = "--" if "adjoint" in name else "-"
        axis.plot(
            [r["size"] for r in mine], [r["value"] for r in mine], style, marker="o", color=f"C{i // 2}", label=name
        )
    axis.set(xscale="log", yscale="log", xlabel="particles", ylabel="ns per particle and substep", title=title)
    axis.title.set_size(8)
    axis.legend(fontsize=8)
    figure.savefig(RESULTS / f"speed_{kind}.png", dpi=110)


if __name__ == "__main__":
    main(sys.argv[1:])
