"""What an implicit step costs, in explicit substeps of the same body.

    make bench-implicit_cost [ARGS="version=<words>"]   ->   docs/results/simulation_implicit.csv, simulation.md

A block of 16 x 10 x 10 cells with 12 800 particles, clamped at one end, falls and swings; fixed corotated, float32, one
thread. Its stiffness is such that a step of 1/24 s is `times` explicit substeps at their limit. `first` is a rollout of
one step, with setting it up; `later` the mean of the ten steps after two. Processor time, not wall clock. `version`
names the tree that was measured: rows of other ones are kept.
"""

import csv
import dataclasses
import math
import sys
import time
from pathlib import Path

import torch
from machine import machine

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout
from physics3d.world import World

TABLE = Path(__file__).resolve().parent.parent / "docs" / "results" / "simulation_implicit.csv"
COLUMNS = ("version", "times", "explicit", "first", "later", "newton", "products")
CELLS, DX, STEP = (16, 10, 10), 0.1, 1 / 24
NOW = "now"


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    version = options.get("version", NOW)
    torch.set_num_threads(1)
    rows = [row for row in read() if row["version"] != version]
    explicit = explicit_substep()
    print(f"an explicit substep: {1e3 * explicit:.2f} ms", flush=True)
    for times in (30, 300, 3000):
        rows.append(dict(version=version, times=times, explicit=explicit) | implicit_step(times, explicit))
        print(rows[-1], flush=True)
    with TABLE.open("w", newline="") as file:
        file.write(f"# {machine('cpu')}, 1 thread\n")
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)
    import simulation

    simulation.write_again()


def read() -> list[dict]:
    if not TABLE.exists():
        return []
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def block() -> World:
    return World(
        material=Viscoelastic(branches=0), density=1000.0, start={"youngs_modulus": 1e6, "poissons_ratio": 0.3}, dx=DX,
        gravity=(0.0, 0.0, -9.81), lower=(-2.0, -2.0, -2.0), upper=(4.0, 4.0, 4.0),
        boundaries=(FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.05, 5.0, 5.0)),),
    )  # fmt: skip


def taken(world: World, frame_dt: float) -> tuple[float, dict[str, list[float]]]:
    """(processor time [s], health) of a rollout of one frame."""
    axes = [(torch.arange(2 * n, dtype=torch.float64) + 0.5) * DX / 2 for n in CELLS]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    volume = torch.full((len(position),), (DX / 2) ** 3, dtype=torch.float64)
    begun = time.process_time()
    with torch.no_grad():
        parameters = {name: torch.tensor(value) for name, value in world.start.items()}
        options = dict(frames=2, frame_dt=frame_dt, device="cpu", threads=1, log=Log(None))
        motion = rollout(world, parameters, position, volume, **options)
    return time.process_time() - begun, motion.health


def explicit_substep() -> float:
    """[s], the median of three slopes between 32 and 160 substeps at half the limit."""
    world = block()
    dt = 0.5 * limit(world)
    world = dataclasses.replace(world, scheme="explicit", dt=dt)
    taken(world, 4 * dt)
    return sorted((taken(world, 160 * dt)[0] - taken(world, 32 * dt)[0]) / 128 for _ in range(3))[1]


def implicit_step(times: int, explicit: float) -> dict:
    speed = DX * times / math.sqrt(3) / STEP  # of waves [m/s]
    modulus = 1000 * speed**2
    stiff = {"youngs_modulus": modulus * 1.3 * 0.4 / 0.7, "poissons_ratio": 0.3}
    world = dataclasses.replace(block(), scheme="implicit", start=stiff, dt=STEP)
    taken(world, STEP)
    first, two, twelve = (taken(world, n * STEP) for n in (1, 2, 12))
    health = twelve[1]
    return dict(
        first=first[0] / explicit,
        later=(twelve[0] - two[0]) / 10 / explicit,
        newton=health["newton_iterations"][1] / 12,
        products=health["stiffness_products"][1] / 12,
    )


def limit(world: World) -> float:
    """The explicit limit of a lone particle [s]."""
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in world.start.items()}
    modulus = float(world.material.wave_modulus(world.material.coefficients(values)).max())
    return world.dx / math.sqrt(3 * modulus / world.density)


def table(rows: list[dict]) -> list[str]:
    """Lines of the page."""
    if not rows:
        return []
    lines = ["", "## What an implicit step costs", ""]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), ""]
    lines += [
        "| version | explicit substeps per step | first step costs | later steps | Newton iterations | products |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        cost, later = (f"{float(r[key]):.0f}" for key in ("first", "later"))
        newton, products = (f"{float(r[key]):.1f}" for key in ("newton", "products"))
        lines.append(f"| {r['version']} | {r['times']} | {cost} | {later} | {newton} | {products} |")
    return [
        *lines,
        "",
        "Costs in explicit substeps; iterations and products with the stiffness are means of twelve steps.",
    ]


if __name__ == "__main__":
    main(sys.argv[1:])
