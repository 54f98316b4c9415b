"""Stiff and extreme cases: where the simulator is right, where it refuses, and that it never ends in NaN.

    make bench-stability [ARGS="seed=0"]   ->   docs/results/stability.csv, stability_extremes.csv, .png, .md

Map. A free bar of 16 cells between lateral slip walls, 128 particles, fixed corotated, nu = 0.4, in its first axial
vibration, v = 0.05 m/s at its ends. Young's modulus against a fixed substep, 48 substeps and more (dt = None: as long
as 48 of cfl 0.5). The error is the relative L2 error of the strain H = F - I at its first peak, 8 dx/c, or at the end
of shorter runs. The reference is our solver in float64 with dt <= dx/(8 c), itself within 2 % of the closed form; plain
float64 checks it, being a program of its own.

Plain. The textbook explicit MLS-MPM in numpy (Hu et al. 2018): the same transfers and material, a fixed dt, with F, x
and C stored in single or double precision, and without any of our checks.
"""

import csv
import math
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from machine import machine

from physics3d.log import Log
from physics3d.mpm.boundaries.bounding_box import BoundingBox
from physics3d.mpm.boundaries.impulse import Impulse
from physics3d.mpm.boundaries.moving_cuboid import MovingCuboid
from physics3d.mpm.driver import prescribed
from physics3d.mpm.materials.neo_hookean import NeoHookean
from physics3d.mpm.materials.newtonian import Newtonian
from physics3d.mpm.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout
from physics3d.mpm.transfer import velocity_gradient
from physics3d.mpm.world import World

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
YOUNG = tuple(10.0**k for k in range(2, 11))  # [Pa]
DT = (*(10.0 ** (k / 2) for k in range(-14, 1)), None)  # [s]
POISSON, DENSITY, DX, SPEED = 0.4, 1000.0, 0.04, 0.05
SUBSTEPS = 48
ACCURATE = 0.1
HANG = 20  # [s]
OUTCOMES = ("accurate", "stable, inaccurate", "refused", "FAILED")
COLORS = ("#2a9d5c", "#e9c46a", "#8fa3b8", "#c1121f")


def main(words: list[str]) -> None:
    torch.set_num_threads(1)
    seed = int(dict(word.split("=", 1) for word in words).get("seed", 0))
    signal.signal(signal.SIGALRM, _hang)
    cells = [cell for young in YOUNG for dt in DT for cell in map_cells(young, dt)]
    extremes = [extreme(*case) for case in cases(seed)]
    write(cells, extremes, seed)


def _hang(*_: object) -> None:
    raise TimeoutError(f"no answer within {HANG} s")


def attempt(run: Callable[[], dict]) -> dict:
    """What came of a run: its own row, or `refused` for a ValueError, or FAILED for anything else."""
    signal.alarm(HANG)
    try:
        return run()
    except ValueError as reason:
        return {"outcome": "refused", "detail": str(reason)}
    except Exception as reason:
        return {"outcome": "FAILED", "detail": f"{type(reason).__name__}: {reason}"}
    finally:
        signal.alarm(0)


# --- map --------------------------------------------------------------------------------------------------------------


def block(cells: tuple[int, int, int], dx: float, corner=(1.0, 1.0, 1.0)) -> tuple[torch.Tensor, torch.Tensor]:
    """(position [p, 3], volume [p]), eight particles per cell."""
    axes = [(torch.arange(c * 2, dtype=torch.float64) + 0.5) * dx / 2 for c in cells]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    volume = torch.full((len(position),), (dx / 2) ** 3, dtype=torch.float64)
    return position + torch.tensor(corner, dtype=torch.float64), volume


def wave_speed(young: float, poisson: float) -> float:
    return math.sqrt(young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson)) / DENSITY)


def map_cells(young: float, dt: float | None) -> list[dict]:
    position, volume = block((16, 1, 1), DX)
    rate = SPEED * math.pi / (16 * DX)  # largest velocity gradient [1/s]
    velocity = torch.zeros_like(position)
    velocity[:, 0] = SPEED * torch.cos(math.pi * (position[:, 0] - 1.0) / (16 * DX))
    gradient = velocity_gradient(position / DX, velocity, DENSITY * volume) / DX
    walls = BoundingBox(kind="slip", lower=(-50.0, 1.0, 1.0), upper=(50.0, 1.0 + DX, 1.0 + DX))
    crossing = DX / wave_speed(young, POISSON)
    peak = 8 * crossing
    # substeps up to the first look, and looks
    steps = SUBSTEPS if dt is None else min(max(round(peak / dt), 1), SUBSTEPS)
    first = peak if dt is None else steps * dt
    looks = 3 if dt is None else math.ceil(SUBSTEPS / steps)

    def ours(precision: str, dt: float | None, frames: int) -> tuple[torch.Tensor, torch.Tensor]:
        world = World(
            material=Viscoelastic(branches=0), density=DENSITY,
            start=dict(youngs_modulus=young, poissons_ratio=POISSON), dx=DX, gravity=(0.0, 0.0, 0.0), dt=dt,
            precision=precision, boundaries=(walls,),
        )  # fmt: skip
        motion = simulate(world, position, volume, velocity=velocity, frames=frames, frame_dt=first)
        H = motion.deformation.double() - torch.eye(3, dtype=torch.float64)
        return H[1], H[-1]

    reference = None
    if first <= 2 * peak:  # longer ones are beyond the stable limit for certain
        reference = ours("float64", min(first / steps, crossing / 8), 2)[0]

    def judged(run: Callable[[], tuple[torch.Tensor, torch.Tensor]]) -> dict:
        early, late = run()
        if not bool(torch.isfinite(early).all() and torch.isfinite(late).all()):
            return {"outcome": "FAILED", "detail": "NaN, infinity, or out of the grid"}
        strain = max(float(early.abs().max()), float(late.abs().max()))
        # a free bar is strained most at the first peak
        bound = 5 * (rate * peak if reference is None else max(float(reference.abs().max()), rate * first))
        detail = f"largest strain {strain:.2g}"
        if strain > bound:
            return {"outcome": "FAILED", "detail": f"exploded, {detail}"}
        if reference is None:
            return {"outcome": OUTCOMES[1], "detail": f"no reference, {detail}"}
        error = float((early - reference).norm() / reference.norm())
        return {"outcome": OUTCOMES[0 if error <= ACCURATE else 1], "error": error, "detail": detail}

    found = []
    for solver, run in (
        ("ours, float32", lambda: ours("float32", dt, 1 + looks)),
        ("ours, float64", lambda: ours("float64", dt, 1 + looks)),
        ("plain, float32", lambda: plain(position, volume, velocity, gradient, young, dt, steps, looks, np.float32)),
        ("plain, float64", lambda: plain(position, volume, velocity, gradient, young, dt, steps, looks, np.float64)),
    ):
        if dt is None and solver.startswith("plain"):
            continue
        row = dict(solver=solver, youngs_modulus=young, dt=dt, outcome="", error=math.nan, detail="")
        found.append(row | attempt(lambda run=run: judged(run)))
    print({f"{r['solver']}": (r["outcome"], f"{r['error']:.2g}") for r in found}, young, dt, flush=True)
    return found


def simulate(world: World, position, volume, **more):
    parameters = {name: torch.tensor(value, dtype=torch.float64) for name, value in world.start.items()}
    with torch.no_grad():
        return rollout(world, parameters, position, volume, threads=1, log=Log(None), **more)


def plain(
    position, volume, velocity, gradient, young: float, dt: float, steps: int, looks: int, real
) -> tuple[torch.Tensor, torch.Tensor]:
    """H after `steps` and after steps * looks substeps of textbook MLS-MPM, everything stored in `real`."""
    mu, lam = real(young / (2 * (1 + POISSON))), real(young * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)))
    x, v = position.numpy().astype(real), velocity.numpy().astype(real)
    V, m = volume.numpy().astype(real), (DENSITY * volume).numpy().astype(real)
    n, side, dx, dt = len(x), 64, real(DX), real(dt)
    eye = np.eye(3, dtype=real)
    F = np.tile(eye, (n, 1, 1))
    C = gradient.numpy().astype(real)
    offsets = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)
    nothing = torch.full((n, 3, 3), math.nan, dtype=torch.float64)
    seen = []
    with np.errstate(all="ignore"):
        for step in range(1, steps * looks + 1):
            if not (np.isfinite(F).all() and np.isfinite(x).all()):
                return nothing, nothing
            U, _, Vt = np.linalg.svd(F)
            flip = np.sign(np.linalg.det(U @ Vt))
            U[:, :, 2] *= flip[:, None]  # a rotation, also of an inverted element
            J = np.linalg.det(F)
            FT = F.transpose(0, 2, 1)
            tau = 2 * mu * (F - U @ Vt) @ FT + (lam * J * (J - 1))[:, None, None] * eye
            base = np.floor(x / dx - real(0.5)).astype(np.int64)
            f = x / dx - base.astype(real)
            w = np.stack(
                [real(0.5) * (real(1.5) - f) ** 2, real(0.75) - (f - 1) ** 2, real(0.5) * (f - real(0.5)) ** 2], 1
            )
            weight = w[:, offsets[:, 0], 0] * w[:, offsets[:, 1], 1] * w[:, offsets[:, 2], 2]
            node = base[:, None] + offsets
            if node.min() < 0 or node.max() >= side:
                return nothing, nothing  # out of the grid: a crash
            index = (node[..., 0] * side + node[..., 1]) * side + node[..., 2]
            d = (offsets.astype(real)[None] - f[:, None]) * dx
            A = m[:, None, None] * C - (dt * 4 / dx**2) * V[:, None, None] * tau
            p = weight[..., None] * (m[:, None, None] * v[:, None] + np.einsum("pij,pkj->pki", A, d))
            used, where = np.unique(index, return_inverse=True)
            where = where.reshape(n, 27)
            mass, momentum = np.zeros(len(used), real), np.zeros((len(used), 3), real)
            np.add.at(mass, where, weight * m[:, None])
            np.add.at(momentum, where, p)
            at = (momentum / np.maximum(mass, np.finfo(real).tiny)[:, None])[where]
            at[..., 1:] = 0  # every node of this bar lies on a slip wall or beyond
            v = (weight[..., None] * at).sum(1)
            C = 4 / dx**2 * np.einsum("pk,pki,pkj->pij", weight, at, d)
            x, F = x + dt * v, (eye + dt * C) @ F
            if step in (steps, steps * looks):
                seen.append(torch.from_numpy(F.astype(np.float64)) - torch.eye(3, dtype=torch.float64))
    return seen[0], seen[-1]


# --- extremes ---------------------------------------------------------------------------------------------------------


def cases(seed: int) -> list[tuple[str, str, dict]]:
    """(what, value, arguments of `extreme_run`): each one an ordinary jelly cube but for what the name says."""
    position, volume = block((3, 3, 3), DX)
    centre = position.mean(0)
    noise = torch.randn(position.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    squeeze = -SPEED / (1.5 * DX) * (position - centre)
    pull = torch.zeros_like(position)
    pull[:, 0] = (position - centre)[:, 0]
    shear = torch.zeros_like(position)
    shear[:, 0] = (position - centre)[:, 2]
    one = torch.tensor([[1.0, 1.0, 1.0]], dtype=torch.float64)
    sheet = position[:1] + torch.cartesian_prod(torch.arange(16), torch.arange(16), torch.arange(1)).double() * DX / 2
    wavy = torch.zeros_like(sheet)
    wavy[:, 2] = SPEED * torch.cos(2 * math.pi * (sheet[:, 0] - sheet[0, 0]) / (16 * DX / 2))
    alternating = torch.where(torch.arange(len(volume)) % 2 == 0, 1.0, 1e-6) * volume
    far = torch.tensor([[0.0, 0.0, 0.0], [1e5, 1e5, 1e5]], dtype=torch.float64)
    floor = BoundingBox(kind="slip", lower=(1.0, 1.0, 1.0), upper=(1.12, 1.12, 2.0))
    press = MovingCuboid(lower=(0.5, 0.5, 1.12), upper=(2.0, 2.0, 3.0), velocity=(0.0, 0.0, -1.0), duration=1.0)
    room = BoundingBox(kind="sticky", lower=(0.5, 0.5, 0.5), upper=(1.6, 1.6, 1.6))
    shot = Impulse(force=(1e9, 0.0, 0.0), centre=(1.06, 1.06, 1.06), radius=0.2, duration=1.0)
    branch = dict(youngs_modulus=1e5, poissons_ratio=0.3, branch_shear_modulus=4e4, branch_bulk_modulus=8e4)
    fluid = dict(bulk_modulus=1e5, power_index=1.0)

    def jelly(**changes) -> dict:
        usual = dict(
            material=Viscoelastic(branches=0), start=dict(youngs_modulus=1e5, poissons_ratio=POISSON),
            position=position, volume=volume, velocity=squeeze, density=DENSITY,
        )  # fmt: skip
        return usual | changes

    def elastic(young: float, poisson: float) -> dict:
        return dict(youngs_modulus=young, poissons_ratio=poisson)

    soft, rubber = elastic(1e3, 0.3), NeoHookean()
    found = [("Poisson's ratio", f"{nu:g}", jelly(start=elastic(1e5, nu))) for nu in (0, 0.45, 0.499, 0.4999, 0.5)]
    for time in (0.0, 1e-30, 1e-9, 1e-3, 1e9, math.inf):
        start = branch | dict(shear_viscosity_time=time, bulk_viscosity_time=time)
        found.append(("relaxation time [s]", f"{time:g}", jelly(material=Viscoelastic(), start=start)))
    for viscosity in (0.0, 1.0, 1e3, 1e6, 1e12):
        liquid = jelly(material=Newtonian(), start=fluid | dict(viscosity=viscosity), velocity=shear)
        found.append(("viscosity of a fluid [Pa s]", f"{viscosity:g}", liquid))
    found += [("the material alone, stretched to", f"{s:g}", dict(stretch=s)) for s in (0.01, 20.0)]
    found += [
        ("density [kg/m^3]", f"{density:g}", jelly(density=density, velocity=(100 if density < 1 else 1) * squeeze))
        for density in (1e-3, 1e3, 1e6)
    ]
    found += [
        ("mass of neighbouring particles", "1 : 1e6", jelly(volume=alternating)),
        ("all particles in one point", "", jelly(position=one.expand(len(volume), 3), velocity=None)),
        ("compression between plates", "fixed corotated", jelly(
            start=soft, velocity=None, boundaries=(floor, press), frame_dt=0.04)),
        ("compression between plates", "neo-Hookean", jelly(
            start=soft, velocity=None, boundaries=(floor, press), frame_dt=0.04, material=rubber)),
        ("stretch by inertia, torn apart", "fixed corotated", jelly(
            start=soft, velocity=1e3 * pull, frame_dt=0.002, frames=11)),
        ("stretch by inertia, torn apart", "neo-Hookean", jelly(
            start=soft, velocity=1e3 * pull, frame_dt=0.002, frames=11, material=rubber)),
        ("collapse by inertia", "fixed corotated", jelly(start=soft, velocity=200 * squeeze, frame_dt=0.0025)),
        ("collapse by inertia", "neo-Hookean", jelly(
            start=soft, velocity=200 * squeeze, frame_dt=0.0025, material=rubber)),
        ("velocities at random", "10 m/s", jelly(start=soft, velocity=10 * noise, frame_dt=0.0025)),
        ("velocities at random", "1e4 m/s", jelly(start=soft, velocity=1e4 * noise, frame_dt=2.5e-6)),
        ("one isolated particle", "thrown", jelly(
            position=one, volume=volume[:1], velocity=torch.tensor([1.0, 2.0, 3.0]), gravity=-9.81)),
        ("two particles", "1.7e5 m apart", jelly(position=far, volume=volume[:2], velocity=None, gravity=-9.81)),
        ("particle on the boundary of the grid", "at rest", jelly(
            position=one, volume=volume[:1], velocity=None, lower=(1.0, 1.0, 1.0), upper=(2.0, 2.0, 2.0))),
        ("particle on the boundary of the grid", "leaving", jelly(
            position=one, volume=volume[:1], velocity=torch.tensor([-10.0, 0.0, 0.0]), lower=(1.0, 1.0, 1.0),
            upper=(2.0, 2.0, 2.0))),
        ("particle outside the grid", "", jelly(
            position=one, volume=volume[:1], velocity=None, lower=(1.01, 1.0, 1.0), upper=(2.0, 2.0, 2.0))),
        ("sheet, one particle thick", "bending", jelly(
            position=sheet, volume=volume[:1].expand(256), velocity=wavy)),
        ("impulse across the grid in a step", "1e9 N, free", jelly(velocity=None, excitation=(shot,))),
        ("impulse across the grid in a step", "1e9 N, in a box", jelly(
            velocity=None, excitation=(shot,), boundaries=(room,))),
        ("gravity", "1e6 m/s^2", jelly(gravity=-1e6, boundaries=(room,), frame_dt=1.25e-4)),
        ("Young's modulus and Poisson's ratio", "1e10 Pa, 0.4999", jelly(
            start=elastic(1e10, 0.4999), velocity=1000 * squeeze)),
        ("Young's modulus", "nan", jelly(start=elastic(math.nan, 0.3))),
    ]  # fmt: skip
    return found


def extreme(what: str, value: str, arguments: dict) -> dict:
    row = dict(what=what, value=value, outcome="", error=math.nan, detail="")
    row |= attempt(lambda: (stretched if "stretch" in arguments else extreme_run)(**arguments))
    print(what, value, {k: v for k, v in row.items() if k not in ("what", "value")}, flush=True)
    return row


def stretched(stretch: float) -> dict:
    """The material alone, float32, along one axis in 200 steps, against its closed form."""
    s = torch.linspace(1.0, stretch, 201, dtype=torch.float64)
    F = torch.eye(3, dtype=torch.float64).repeat(len(s), 1, 1)
    F[:, 0, 0] = s
    values = dict(youngs_modulus=torch.tensor(1e5), poissons_ratio=torch.tensor(POISSON))
    mu, lam = 1e5 / (2 * (1 + POISSON)), 1e5 * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    exact = 2 * mu * (s**2 - s) + lam * s * (s - 1)
    time = torch.linspace(0, 1, len(s), dtype=torch.float64)
    tau = prescribed(Viscoelastic(branches=0), values, time, F.float())
    error = float((tau[:, 0, 0].double() - exact).norm() / exact.norm())
    return {
        "outcome": OUTCOMES[0 if error <= ACCURATE else 1],
        "error": error,
        "detail": f"tau_11 {float(tau[-1, 0, 0]):.4g} Pa, closed form {float(exact[-1]):.4g} Pa",
    }


def extreme_run(
    *, material, start, position, volume, velocity, density, gravity=0.0, frame_dt=None, frames=9, excitation=(), **more
) -> dict:
    """Once in float32, as everyone runs it; then in float64 to compare with."""
    world = World(
        material=material, density=density, start=start, dx=DX, gravity=(0.0, 0.0, gravity), **more
    )  # fmt: skip
    world.check()
    if frame_dt is None:
        values = {name: torch.tensor(value, dtype=torch.float64) for name, value in start.items()}
        modulus = float(material.wave_modulus(material.coefficients(values)).max())
        frame_dt = SUBSTEPS / 16 * DX / math.sqrt(modulus / density)
    options = dict(velocity=velocity, frames=frames, frame_dt=frame_dt, excitation=excitation)
    motion = simulate(world, position, volume, **options)
    if not (bool(torch.isfinite(motion.position).all()) and bool(torch.isfinite(motion.deformation).all())):
        return {"outcome": "FAILED", "detail": "NaN or infinity"}
    health = motion.health
    detail = (
        f"J {min(health['J_min']):.3g} .. {max(health['J_max']):.3g}, stretch <= {max(health['stretch_max']):.3g}, "
        f"inverted {max(health['inverted']):g}, substeps {motion.substeps}"
    )
    energy = health["energy"]
    if not excitation and not world.boundaries and energy[-1] - energy[0] > 0.05 * max(abs(e) for e in energy):
        return {"outcome": OUTCOMES[1], "detail": f"energy from {energy[0]:.3g} to {energy[-1]:.3g} J; {detail}"}
    try:
        fine = simulate(replace(world, precision="float64"), position, volume, **options)
    except (ValueError, TimeoutError) as reason:
        return {"outcome": OUTCOMES[1], "detail": f"nothing to compare with ({reason}); {detail}"}
    # over all frames, against the largest displacement of any
    difference = (motion.position.double() - motion.rest_position.double()) - (fine.position - position)
    size = float((fine.position - position).square().sum((1, 2)).max().sqrt())
    error = float(difference.square().sum((1, 2)).max().sqrt()) / (size or 1.0)
    return {"outcome": OUTCOMES[0 if error <= ACCURATE else 1], "error": error, "detail": detail}


# --- results ----------------------------------------------------------------------------------------------------------


def write(cells: list[dict], extremes: list[dict], seed: int) -> None:
    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine('cpu')}, numpy {np.__version__}, 1 thread, seed {seed}"
    for name, rows in (("stability", cells), ("stability_extremes", extremes)):
        with (RESULTS / f"{name}.csv").open("w", newline="") as file:
            file.write(f"# {title}\n")
            table = csv.DictWriter(file, rows[0])
            table.writeheader()
            table.writerows(r | {"detail": shortened(r["detail"])} for r in rows)
    draw(cells, title)
    (RESULTS / "stability.md").write_text(page(cells, extremes, title))


def draw(cells: list[dict], title: str) -> None:
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(13, 7.6), layout="constrained")
    figure.suptitle(title, fontsize=9)
    solvers = list(dict.fromkeys(r["solver"] for r in cells))
    for axis, solver in zip(figure.subplots(2, 2, sharex=True, sharey=True).flat, solvers, strict=True):
        table = np.full((len(YOUNG), len(DT)), np.nan)
        for r in cells:
            if r["solver"] == solver:
                table[YOUNG.index(r["youngs_modulus"]), DT.index(r["dt"])] = OUTCOMES.index(r["outcome"])
        axis.imshow(table, cmap=ListedColormap(COLORS), vmin=-0.5, vmax=3.5, aspect="auto", origin="lower")
        limits = [math.log10(DX / wave_speed(young, POISSON)) * 2 + 14 for young in YOUNG]
        axis.plot(limits, range(len(YOUNG)), "k--", linewidth=1)
        axis.set(title=solver, xlim=(-0.5, len(DT) - 0.5), ylim=(-0.5, len(YOUNG) - 0.5))
        axis.set_xticks(range(len(DT)), [f"{dt:.0e}" if dt else "None" for dt in DT], rotation=60, fontsize=8)
        axis.set_yticks(range(len(YOUNG)), [f"{young:.0e}" for young in YOUNG], fontsize=8)
        axis.label_outer()
        axis.set_xlabel("substep dt [s]")
        axis.set_ylabel("Young's modulus [Pa]")
    patches = [Patch(color=color, label=name) for name, color in zip(OUTCOMES, COLORS, strict=True)]
    line = axis.plot([], [], "k--", linewidth=1, label="dt = dx/c")
    figure.legend(handles=[*patches, *line], loc="outside lower center", ncols=5)
    figure.savefig(RESULTS / "stability.png", dpi=110)


def page(cells: list[dict], extremes: list[dict], title: str) -> str:
    lines = ["# Stability: stiff and extreme cases", "", 'Made by `make bench-stability ARGS="seed=0"`.', ""]
    lines += [f"Machine: {title}.", "", *__doc__.split("\n\n", 2)[2].strip().splitlines(), ""]
    lines += [
        f"Accurate: error at most {100 * ACCURATE:g} % and no growth later. Stable, inaccurate: bounded, without that. "
        "Refused: a ValueError that says why. FAILED: NaN or infinity, five times the largest strain that the start "
        f"allows, a particle out of the grid, or no answer in {HANG} s.",
        "", "![Young's modulus against substep](stability.png)", "", "## Map, counted", "",
        "| solver | " + " | ".join(OUTCOMES) + " |", "|---" * 5 + "|",
    ]  # fmt: skip
    solvers = list(dict.fromkeys(r["solver"] for r in cells))
    for solver in solvers:
        counts = [sum(r["solver"] == solver and r["outcome"] == o for r in cells) for o in OUTCOMES]
        lines.append(f"| {solver} | " + " | ".join(map(str, counts)) + " |")
    fixed = [r for r in cells if r["dt"] is not None]

    def among(solver: str, outcome: str) -> set:
        return {(r["youngs_modulus"], r["dt"]) for r in fixed if (r["solver"], r["outcome"]) == (solver, outcome)}

    spared = len(among("ours, float32", "refused") & among("plain, float64", "accurate"))
    lines += [
        "",
        f"{spared} cells that ours refuses run well in plain double precision. They lie about dx/c; ours stops at "
        "dx/(sqrt(3) c), where a lone particle becomes unstable, and this bar has none.",
        "",
        "Errors at dt = 1e-7 s, the shortest, after 48 substeps. The increments of F are below the rounding of 1 in "
        "float32: an F that is stored directly does not move, H = F - I does. What is left of ours is the rounding of "
        "the F it returns.",
        "",
        "| E [Pa] | " + " | ".join(solvers) + " |",
        "|---" * (1 + len(solvers)) + "|",
    ]
    for young in YOUNG:
        row = [f"{young:.0e}"]
        for solver in solvers:
            cell = next(r for r in cells if (r["solver"], r["youngs_modulus"], r["dt"]) == (solver, young, DT[0]))
            row.append(f"{cell['error']:.1e}")
        lines.append("| " + " | ".join(row) + " |")
    lines += ["", "## Extreme cases, our solver", ""]
    lines += [
        "One run each in float32, cfl 0.5, a jelly cube of 216 particles but for what the table says. Accurate: the",
        f"displacements are those of float64 to {100 * ACCURATE:g} % and a free body gains less than 5 % of energy:",
        "stability and rounding, not agreement with nature. Stable, inaccurate: finite, without that. FAILED: NaN, any",
        f"other exception, or no answer in {HANG} s. A body torn apart ends as lone particles, whose F means nothing;",
        "and debris that spreads over hundreds of cells is slow, because the grid is dense around all particles.", "",
    ]  # fmt: skip
    lines += ["| case | value | outcome | difference | what happened |"]
    lines += ["|---|---|---|---|---|"]
    for r in extremes:
        error = "" if math.isnan(r["error"]) else f"{r['error']:.1e}"
        detail = shortened(r["detail"]).replace("|", "/")
        lines.append(f"| {r['what']} | {r['value']} | {r['outcome']} | {error} | {detail} |")
    return "\n".join(lines) + "\n"


def shortened(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 220 else text[:217] + "..."


if __name__ == "__main__":
    main(sys.argv[1:])
