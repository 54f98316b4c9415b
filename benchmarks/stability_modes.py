"""The solver without a grid over stiff and extreme cases; part of `make bench-stability`.

A cantilever of 12 pieces, 120 mm long and 10 mm square, 300 kg/m^3, let go with the speed of its first mode at a
hundredth of its length, against Timoshenko's frequency and, with a branch, the closed form of that oscillator
(tests/modes/swinging_beam.py). Four maps against the step: Young's modulus at nu = 0.3 and 0.499, and the viscosity of
a branch at 1e5 Pa, as stiff as the springs and of whatever time, or of a time of 0.1 s and whatever stiffness. Two
periods, at least 8 steps and at most 400. Accurate: the displacement of the end within 10 %. Stable, inaccurate: at
most 1.5 times as large as it may be, and the log says that the step is too long. FAILED: anything else, also what is
wrong without a word.

Extremes: the same beam, pushed, thrown, and of materials at the edge of what they may be. There the steps are
automatic; the motion is compared with the same in steps a fourth as long.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from modes_bodies import row, world
from swinging_beam import ACCURATE, DENSITY, EDGE, LENGTH, OUTCOMES, Case, Heard, angular, run

from physics3d.boundaries.impulse import Impulse
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.modes.rollout import Solver

DT = (*(10.0 ** (k / 2) for k in range(-8, -1)), None)  # [s]
YOUNG = tuple(10.0**k for k in range(2, 11))  # [Pa]
VISCOSITY = tuple(10.0**k for k in range(-2, 7))  # [Pa s]
E, TIME = 1e5, 0.1  # of the maps over the viscosity [Pa], [s]
MU = E / 2.6


@dataclass(frozen=True, kw_only=True)
class Map:
    """A quantity against the step."""

    title: str
    values: tuple[float, ...]
    case: Callable[[float, float | None], Case]


MAPS = (
    Map(title="Young's modulus [Pa], nu 0.3", values=YOUNG, case=lambda y, dt: Case(young=y, dt=dt)),
    Map(title="Young's modulus [Pa], nu 0.499", values=YOUNG, case=lambda y, dt: Case(young=y, poisson=0.499, dt=dt)),
    Map(
        title="viscosity [Pa s], branch as stiff as the springs",
        values=VISCOSITY,
        case=lambda y, dt: Case(young=E, ratio=1.0, time=y / MU, dt=dt),
    ),
    Map(
        title=f"viscosity [Pa s], branch of {TIME} s",
        values=VISCOSITY,
        case=lambda y, dt: Case(young=E, ratio=y / TIME / MU, time=TIME, dt=dt),
    ),
)


def maps() -> list[dict]:
    """title, value, dt, outcome, error, detail of every cell."""
    found = []
    for one in MAPS:
        for value in one.values:
            cells = [dict(title=one.title, value=value, dt=dt) | run(one.case(value, dt)) for dt in DT]
            print(one.title, value, [(c["outcome"], f"{c['error']:.2g}") for c in cells], flush=True)
            found += cells
    return found


def extremes() -> list[dict]:
    """what, value, outcome, error, detail of every extreme case."""
    found = []
    for what, value, attempt in cases():
        try:
            row_ = attempt()
        except ValueError as reason:
            row_ = dict(outcome="refused", error=math.nan, detail=str(reason))
        except Exception as reason:
            row_ = dict(outcome="FAILED", error=math.nan, detail=f"{type(reason).__name__}: {reason}")
        found.append(dict(what=what, value=value) | row_)
        print(found[-1], flush=True)
    return found


def cases() -> list[tuple[str, str, Callable[[], dict]]]:
    elastic = dict(youngs_modulus=1e5, poissons_ratio=0.3)
    branch = elastic | dict(branch_shear_modulus=4e4, branch_bulk_modulus=8e4)
    found: list[tuple[str, str, Callable[[], dict]]] = []
    for nu in (0.0, 0.45, 0.499, 0.4999, 0.5):
        found.append(("Poisson's ratio", f"{nu:g}", partial(moved, NeoHookean(), elastic | dict(poissons_ratio=nu))))
    for time in (1e-30, 1e-9, 1e-3, 1e9, math.inf):
        start = branch | dict(shear_relaxation_time=time, bulk_relaxation_time=time)
        found.append(("relaxation time of a branch [s]", f"{time:g}", partial(moved, Viscoelastic(), start)))
    for name, material, start in (
        ("neo-Hookean", NeoHookean(), elastic),
        ("fixed corotated", Viscoelastic(branches=0), elastic),
    ):
        for force in (1e-6, 1e-2, 1.0, 1e2, 1e4):  # it is bent to a half circle by about 0.03 N
            push = Impulse(force=(0.0, 0.0, force), centre=(LENGTH, 0.0, 0.0), nearest=1, duration=0.1)
            found.append((f"force on the end [N], {name}", f"{force:g}", partial(moved, material, start, push=push)))
        for speed in (1e-6, 1.0, 100.0, 1e4):
            found.append((f"thrown at [m/s], {name}", f"{speed:g}", partial(moved, material, start, speed=speed)))
    for density in (1e-3, 1e6):
        found.append(
            (
                "density [kg/m^3], thrown at 0.1 m/s",
                f"{density:g}",
                partial(moved, NeoHookean(), elastic, density=density),
            )
        )
    for g in (9.81, 1e3):
        found.append(("gravity [m/s^2]", f"{g:g}", partial(moved, NeoHookean(), elastic, gravity=(0.0, 0.0, -g))))
    return found


def moved(
    material: AbstractMaterial,
    start: dict[str, float],
    *,
    push: Impulse | None = None,
    speed: float | None = None,
    density: float = DENSITY,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict:
    """Two periods of the beam in eight frames, by automatic steps and by a fourth of these."""
    position, volume = row(12, EDGE)
    if push is None and speed is None and not any(gravity):
        speed = 0.1
    velocity = None
    if speed is not None:
        velocity = torch.zeros_like(position)
        velocity[:, 2] = speed * position[:, 0] / LENGTH
    body = world(1e5, 0.3, material=material, start=start, density=density, gravity=gravity, precision="float32")
    excitation = (push,) if push is not None else ()
    log = Heard()
    period = 2 * math.pi / angular(start["youngs_modulus"], start["poissons_ratio"]) * math.sqrt(density / DENSITY)
    options = dict(velocity=velocity, frames=9, frame_dt=period / 4, log=log)
    parameters = {name: torch.tensor(value, dtype=torch.float64) for name, value in start.items()}
    with torch.no_grad():
        solver = Solver.of(body, position, volume, excitation=excitation, log=log)
        motion = solver.rollout(parameters, **options)
        said = list(log.warnings)
        fine = replace(solver, world=replace(body, dt=motion.substep_dt / 4)).rollout(parameters, **options)
    there, known = (m.position.double() - m.rest_position.double() for m in (motion, fine))
    if not bool(torch.isfinite(there).all() and torch.isfinite(known).all()):
        return dict(outcome="FAILED", error=math.nan, detail="NaN or infinity")
    error = float((there - known).norm() / known.norm().clamp(min=1e-12))
    stretch, inverted = (np.max(motion.health[name]) for name in ("stretch_max", "inverted"))
    way = float(there.norm(dim=2).max()) / LENGTH
    detail = f"moves {way:.2g} of its length, stretched by {stretch:.2g}, inverted points {inverted:g}"
    detail = "; ".join([*said[:1], detail])
    outcome = "accurate" if error <= ACCURATE else "stable, inaccurate" if said else "FAILED"
    return dict(outcome=outcome, error=error, detail=detail)


# --- results ----------------------------------------------------------------------------------------------------------


def draw(cells: list[dict], colors: Sequence[str], path: Path, title: str) -> None:
    """The maps, one colour an outcome."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(12, 8), layout="constrained")
    figure.suptitle(title, fontsize=9)
    for axis, one in zip(figure.subplots(2, 2).flat, MAPS, strict=True):
        mine = {(c["value"], c["dt"]): OUTCOMES.index(c["outcome"]) for c in cells if c["title"] == one.title}
        table = np.array([[mine[value, dt] for dt in DT] for value in one.values])
        axis.imshow(table, cmap=ListedColormap(colors), vmin=-0.5, vmax=3.5, aspect="auto", origin="lower")
        axis.set_title(one.title, fontsize=9)
        axis.set_xticks(range(len(DT)), [f"{dt:.0e}" if dt else "None" for dt in DT], rotation=60, fontsize=8)
        axis.set_yticks(range(len(one.values)), [f"{value:.0e}" for value in one.values], fontsize=8)
        axis.set_xlabel("step world.dt [s]", fontsize=8)
    patches = [Patch(color=color, label=name) for name, color in zip(OUTCOMES, colors, strict=True)]
    figure.legend(handles=patches, loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=100)


def section(cells: list[dict], rows: list[dict], picture: str) -> list[str]:
    """Of the page."""
    lines = ["## The solver without a grid", "", *__doc__.split("\n\n", 1)[1].strip().splitlines(), ""]
    lines += [f"![maps]({picture})", "", "| map | " + " | ".join(OUTCOMES) + " |", "|---" * 5 + "|"]
    for one in MAPS:
        mine = [c["outcome"] for c in cells if c["title"] == one.title]
        lines.append(f"| {one.title} | " + " | ".join(str(mine.count(o)) for o in OUTCOMES) + " |")
    automatic = [c["error"] for c in cells if c["dt"] is None]
    lines += ["", f"With automatic steps the largest error is {100 * max(automatic):.2g} %.", ""]
    silent = [c for c in cells if c["outcome"] == OUTCOMES[3]]
    lines += [f"- {c['title']} {c['value']:g}, dt {c['dt']}: {c['detail']}" for c in silent]
    told = next((c["detail"] for c in cells if c["outcome"] == OUTCOMES[1]), None)
    if told:
        lines += [f"What the log says of one that is not accurate: `{told}`.", ""]
    lines += ["| case | value | outcome | difference | what happened |", "|---|---|---|---|---|"]
    for r in rows:
        error = "" if math.isnan(r["error"]) else f"{r['error']:.1e}"
        detail = " ".join(r["detail"].split()).replace("|", "/")
        lines.append(f"| {r['what']} | {r['value']} | {r['outcome']} | {error} | {detail[:220]} |")
    return [*lines, ""]
