"""Error against run time of the simulator, on every problem whose answer is known.

    make bench-simulation   ->   docs/results/simulation.csv, .png, .md
    make bench-simulation ARGS="problems=vortex,column"   measures these again and keeps the other rows

The problems are in benchmarks/known_answers.py, each with its equation and source; `cells` is the number of grid cells
along the length that matters. Explicit runs take automatic substeps (cfl), implicit ones a fixed multiple of the
explicit limit where waves are what limits it. `modes` is the solver without a grid, by its automatic steps, with the
building of its model in the time: of a cantilever of the same particles, and of the viscoelastic bar without Poisson's
ratio (tests/modes/modes_bodies.py), which needs no walls; its cells are pieces along the bar. The error is the relative
error of what the problem is about; for the shear start-up, which has no grid, that of the final tau_12 and N1. The time
is that of the processor, on one thread, kernels compiled before: the median of three runs, or one run where that takes
over two seconds. A run with a fixed substep beyond the stable limit must be refused.
"""

import csv
import functools
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "modes"))
import implicit_cost
import modes_bodies
from known_answers import K_N, M_E, MU_N, PROBLEMS, Answer
from machine import machine

from physics3d.materials.driver import simple_shear
from physics3d.materials.viscoelastic import Viscoelastic

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
PRECISIONS = ("float32", "float64")
# problem -> cells; smooth motions to high resolution, the expensive ones to what takes half a minute
CELLS = {
    "free fall": (2, 4, 8),
    "spinning cube": (2, 3, 4),
    "covariance transport": (3, 6, 12),
    "vibrating bar": (8, 16, 32, 64),
    "viscoelastic bar": (8, 16, 32, 64, 128),
    "wave speed": (32, 64, 128, 256),
    "column": (8, 16, 32, 64),
    "bimaterial bar": (16, 32, 64),
    "cantilever": (2, 4, 8),
    "simple shear": (8, 12, 24, 48),
    "vortex": (8, 16, 32),
    "two disks": (16, 32, 64),
    "Taylor bar": (3, 4, 6, 8),
    "sand column": (10, 20),
    "Poiseuille": (8, 16, 32),
}
EXPLICIT = {"cfl 0.5": dict(cfl=0.5, scheme="explicit"), "cfl 0.2": dict(cfl=0.2, scheme="explicit")}
MODES = {"viscoelastic bar": (4, 8, 16, 32), "cantilever": (1, 2, 4)}
# problem -> wave speed [m/s] and length [m] of the cells, for substeps in units of dx/c
C_BAR, C_VISCOUS = math.sqrt(M_E / 1000.0), math.sqrt((M_E + K_N + 4 / 3 * MU_N) / 1000.0)
WAVES = {
    "vibrating bar": (C_BAR, 1.0),
    "viscoelastic bar": (C_VISCOUS, 1.0),
    "column": (math.sqrt(1e6 * 0.7 / (1.3 * 0.4) / 1000.0), 1.0),
    "bimaterial bar": (math.sqrt(4e6 / 1000.0), 1.0),
    "cantilever": (math.sqrt(1e6 / 1000.0), 0.1),
}
IMPLICIT = (5, 20)  # substeps in units of the explicit limit
LIMIT = 1 / math.sqrt(3)  # of dx/c: the explicit limit of a lone particle
TOO_LONG = 1.2  # dx/c, the fixed substep of the runs that must be refused
STEPS = (8, 32, 128, 512)  # of the shear start-up


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    chosen = options["problems"].split(",") if "problems" in options else [*CELLS, "shear start-up"]
    torch.set_num_threads(1)
    kept = [row for row in read() if row["problem"] not in chosen]
    rows: list[dict] = []
    for problem in [name for name in CELLS if name in chosen]:
        for precision in PRECISIONS:
            for step, changes in settings(problem):
                # an implicit step costs as much as a hundred explicit ones: not on the finest grids
                for cells in CELLS[problem][:2] if step.startswith("implicit") else CELLS[problem]:
                    extra = changes(cells) | dict(precision=precision)
                    run = lambda problem=problem, cells=cells, extra=extra: PROBLEMS[problem](cells, **extra)
                    if cells == CELLS[problem][0]:
                        attempt(run)  # compiles
                    rows.append(measure(run, problem=problem, precision=precision, size=f"{cells} cells", step=step))
            for cells in MODES.get(problem, ()):
                run = functools.partial(without_grid, problem, cells, precision)
                rows.append(measure(run, problem=problem, precision=precision, size=f"{cells} cells", step="modes"))
    if "shear start-up" in chosen:
        for precision in PRECISIONS:
            start_up(8, precision)
            for steps in STEPS:
                run = lambda steps=steps, precision=precision: start_up(steps, precision)
                rows.append(
                    measure(
                        run, problem="shear start-up", precision=precision, size=f"{steps} steps", step="exponential"
                    )
                )
    order = [*CELLS, "shear start-up"]
    rows = sorted([*kept, *rows], key=lambda row: order.index(row["problem"]))
    mark_front(rows)
    write(rows, sorted({row["problem"] for row in kept}, key=order.index))


def settings(problem: str) -> list[tuple[str, Callable[[int], dict]]]:
    """(label, cells -> changes of World) of the ways in which a problem is run."""
    found = [(label, lambda cells, changes=changes: dict(changes)) for label, changes in EXPLICIT.items()]
    if problem in WAVES:
        c, length = WAVES[problem]
        for times in IMPLICIT:
            found.append(
                (
                    f"implicit, {times} x limit",
                    lambda cells, times=times: dict(scheme="implicit", dt=times * LIMIT * length / cells / c),
                )
            )
        found.append(
            (
                f"dt = {TOO_LONG} dx/c",
                lambda cells: dict(scheme="explicit", dt=TOO_LONG * length / cells / c),
            )
        )
    return found


def attempt(run: Callable[[], Answer]) -> tuple[Answer | None, str]:
    """The answer, or why there is none: a ValueError is a refusal, anything else goes through."""
    try:
        return run(), ""
    except ValueError as reason:
        return None, " ".join(str(reason).split())


def measure(run: Callable[[], Answer], **row) -> dict:
    """One row: the error, and the time [s]."""
    row |= dict(substeps=0, error=math.nan, seconds=math.nan, outcome="refused", reason="")
    times: list[float] = []
    while len(times) < (3 if not times or times[0] < 2 else 1):
        start = time.process_time()
        answer, row["reason"] = attempt(run)
        times.append(time.process_time() - start)
        if answer is None:
            break
        row |= dict(outcome="ran" if math.isfinite(answer.error) else "FAILED", substeps=answer.substeps)
        row |= dict(error=answer.error, seconds=statistics.median(times))
    print({k: v for k, v in row.items() if v}, flush=True)
    return row


def without_grid(problem: str, cells: int, precision: str) -> Answer:
    """By the modes."""
    if problem == "cantilever":
        return PROBLEMS[problem](cells, solver="modes", precision=precision)
    error, steps = modes_bodies.viscoelastic_bar(cells, precision)
    return Answer(error=error, substeps=steps, more={})


def start_up(steps: int, precision: str) -> Answer:
    """(tau_12, N1) at a shear of 4, shear rate 1/s: mu_N 2 Pa, lam_N 1 Pa, viscosities 10 Pa s."""
    values = dict(
        branch_shear_modulus=2.0, branch_bulk_modulus=1 + 4 / 3,
        shear_relaxation_time=1 / 0.4, bulk_relaxation_time=1 / (0.2 * (1 + 4 / 3)),
    )  # fmt: skip
    table = torch.linspace(0, 4, steps + 1, dtype=torch.float64)
    shear = table.to(torch.float32 if precision == "float32" else torch.float64)
    with torch.no_grad():
        tau = simple_shear(Viscoelastic(elastic=False), values, table, shear)[-1].double()
    known = torch.tensor([1.58283, 4.67265], dtype=torch.float64)  # six digits: errors below 3e-6 say nothing
    measured = torch.stack([tau[0, 1], tau[0, 0] - tau[1, 1]])
    return Answer(error=float((measured - known).norm() / known.norm()), substeps=steps, more={})


def mark_front(rows: list[dict]) -> None:
    """pareto: no other run of the same problem is faster and at most 1 % worse (in time they scatter by more)."""
    for row in rows:
        others = [r for r in rows if r["problem"] == row["problem"] and r["outcome"] == "ran" and r is not row]
        beaten = any(r["seconds"] <= row["seconds"] and r["error"] <= 1.01 * row["error"] for r in others)
        row["pareto"] = row["outcome"] == "ran" and not beaten


def write_again() -> None:
    """The page of the table that is there."""
    rows = read()
    page_of = RESULTS / "simulation.md"
    head = next(line for line in page_of.read_text().splitlines() if line.startswith("Machine: "))
    title = head.removeprefix("Machine: ").partition(". Busy")[0]
    earlier = next((line for line in page_of.read_text().splitlines() if line.startswith("Of an earlier run")), "")
    kept = earlier.rstrip(".").partition(": ")[2].split(", ") if earlier else []
    mark_front(rows)
    page_of.write_text(page(rows, title, kept))


def read() -> list[dict]:
    """The rows of the table that is there."""
    table = RESULTS / "simulation.csv"
    if not table.exists():
        return []
    with table.open(newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    number = lambda text, kind, none: kind(text) if text else none
    return [
        row
        | dict(
            substeps=number(row["substeps"], int, 0),
            error=number(row["error"], float, math.nan),
            seconds=number(row["seconds"], float, math.nan),
        )
        for row in rows
    ]


def write(rows: list[dict], kept: list[str]) -> None:
    """`kept`: problems whose rows are of an earlier run."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    columns = ("problem", "precision", "size", "step", "outcome", "substeps", "error", "seconds", "pareto", "reason")
    title = f"{machine('cpu')}, 1 thread"
    with (RESULTS / "simulation.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, columns, restval="")
        table.writeheader()
        table.writerows(rows)
    draw(rows, title)
    (RESULTS / "simulation.md").write_text(page(rows, title, kept))


def draw(rows: list[dict], title: str) -> None:
    from matplotlib.figure import Figure

    problems = list(dict.fromkeys(r["problem"] for r in rows))
    steps = list(dict.fromkeys(r["step"] for r in rows if r["outcome"] == "ran"))
    across = min(4, len(problems))
    down = math.ceil(len(problems) / across)
    figure = Figure(figsize=(4.2 * across, 3.4 * down + 0.8), layout="constrained")
    figure.suptitle(title, fontsize=9)
    axes = list(figure.subplots(down, across, squeeze=False).flat)
    for axis, problem in zip(axes, problems):
        mine = [r for r in rows if r["problem"] == problem]
        ran = [r for r in mine if r["outcome"] == "ran"]
        floor = min((r["error"] for r in ran if r["error"] > 0), default=1e-16)
        for i, step in enumerate(steps):
            for precision, filled in zip(PRECISIONS, ("full", "none"), strict=True):
                line = [r for r in ran if r["step"] == step and r["precision"] == precision]
                x, y = [r["seconds"] for r in line], [max(r["error"], floor) for r in line]
                axis.plot(x, y, "o-", color=f"C{i}", linewidth=0.7, markersize=4, fillstyle=filled)
        front = sorted((r["seconds"], max(r["error"], floor)) for r in mine if r["pareto"])
        if front:
            axis.plot(*zip(*front, strict=True), "ko-", linewidth=3, markersize=9, alpha=0.25, zorder=0)
        without = [r for r in mine if r["outcome"] != "ran"]
        for i, r in enumerate(without):
            place = ((i + 1) / (len(without) + 1), 0.96)
            axis.plot(*place, "x", color="crimson" if r["outcome"] == "FAILED" else "gray", transform=axis.transAxes)
        for r in ran:
            if r["precision"] == "float64" and r["step"] == "cfl 0.5":
                label = r["size"].split()[0]
                place = (r["seconds"], max(r["error"], floor))
                axis.annotate(label, place, textcoords="offset points", xytext=(4, 4), fontsize=7)
        axis.set(xscale="log", yscale="log", title=problem)
        axis.grid(which="major", alpha=0.2)
        axis.tick_params(labelsize=7)
        axis.title.set_size(9)
    for axis in axes[len(problems) :]:
        axis.set_axis_off()
    figure.supxlabel("processor time [s]", fontsize=9)
    figure.supylabel("relative error", fontsize=9)
    from matplotlib.lines import Line2D

    keys = [Line2D([], [], color=f"C{i}", marker="o", label=step) for i, step in enumerate(steps)]
    keys += [Line2D([], [], color="k", marker="o", fillstyle="none", linestyle="", label="hollow: float64")]
    keys += [Line2D([], [], color="k", linewidth=3, alpha=0.25, label="Pareto front")]
    keys += [Line2D([], [], color="gray", marker="x", linestyle="", label="refused")]
    keys += [Line2D([], [], color="crimson", marker="x", linestyle="", label="failed")]
    figure.legend(handles=keys, loc="outside lower center", ncols=5, fontsize=8)
    figure.savefig(RESULTS / "simulation.png", dpi=100)


def page(rows: list[dict], title: str, kept: list[str]) -> str:
    """The results as a page. What it says of them is computed from them."""
    lines = ["# Simulation: error against run time", "", "Made by `make bench-simulation`. No random numbers.", ""]
    if kept:  # the first such runs looked at the clock on the wall
        lines += [f"Of an earlier run, perhaps of another machine, by wall clock: {', '.join(kept)}.", ""]
    lines += [f"Machine: {title}. Busy with other work: compare times within this page only.", ""]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), "", "![error against time](simulation.png)", ""]
    lines += ["Numbers beside points are cells.", "", "## What it shows", ""]
    lines += [f"- {sentence}" for sentence in findings(rows)]
    lines += ["", "## At the finest grid that was run", ""]
    lines += ["| problem | about | cells | float32 | float64 | order in dx |", "|---|---|---|---|---|---|"]
    for problem in dict.fromkeys(r["problem"] for r in rows):
        if problem not in PROBLEMS:
            continue
        single, double = (line_of(rows, problem, "cfl 0.5", precision) for precision in PRECISIONS)
        if double:
            about = about_problem(problem)
            order = f"{slope(double):.2f}" if len(double) > 1 and double[-1]["error"] > 1e-6 else "round-off"
            errors = " | ".join(f"{line[-1]['error']:.2e}" if line else "" for line in (single, double))
            lines.append(f"| {problem} | {about} | {double[-1]['size'].split()[0]} | {errors} | {order} |")
    lines += ["", "## Runs", "", "| problem | precision | size | substep | outcome | substeps | error | s | front |"]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    for r in rows:
        ran = r["outcome"] == "ran"
        numbers = [f"{r['substeps']}", f"{r['error']:.2e}", f"{r['seconds']:.3f}"] if ran else ["", "", ""]
        cells = [r["problem"], r["precision"], r["size"], r["step"], r["outcome"], *numbers, "*" if r["pareto"] else ""]
        lines.append("| " + " | ".join(cells) + " |")
    lines += implicit_cost.table(implicit_cost.read())
    refused = next((r for r in rows if r["outcome"] == "refused"), None)
    if refused:
        lines += ["", f"A refusal reads: `{refused['reason']}`."]
    return "\n".join(lines) + "\n"


def about_problem(problem: str) -> str:
    function = PROBLEMS[problem]
    text = (getattr(function, "func", function).__doc__ or "").strip().splitlines()[0]
    return text.replace("|", "/").rstrip(".")


def line_of(rows: list[dict], problem: str, step: str, precision: str) -> list[dict]:
    key = (problem, step, precision)
    return [r for r in rows if (r["problem"], r["step"], r["precision"]) == key and r["outcome"] == "ran"]


def slope(line: list[dict]) -> float:
    """Order of convergence between the two finest grids."""
    a, b = line[-2:]
    return math.log(a["error"] / b["error"]) / math.log(int(b["size"].split()[0]) / int(a["size"].split()[0]))


def findings(rows: list[dict]) -> list[str]:
    sentences = []
    for problem in ("vibrating bar", "viscoelastic bar"):
        line = line_of(rows, problem, "cfl 0.5", "float64")
        at = next((r for r in line if r["size"] == "64 cells"), None)
        if at:
            sentences.append(f"{problem}: {100 * at['error']:.2g} % at 64 cells, order {slope(line):.1f} in dx.")
    for problem in WAVES:
        explicit = line_of(rows, problem, "cfl 0.5", "float64")
        for times in IMPLICIT:
            line = line_of(rows, problem, f"implicit, {times} x limit", "float64")
            if line and any(r["size"] == line[-1]["size"] for r in explicit):
                b = line[-1]
                a = next(r for r in explicit if r["size"] == b["size"])
                sentences.append(
                    f"{problem}, {b['size']}: implicit steps of {times} times the explicit limit take "
                    f"{b['seconds'] / a['seconds']:.2g} times as long, error {b['error']:.1e} instead of "
                    f"{a['error']:.1e}."
                )
    few, many = (
        next((r for r in rows if (r["problem"], r["size"], r["precision"]) == ("shear start-up", s, "float64")), None)
        for s in ("32 steps", "128 steps")
    )
    if few and many:
        order = math.log(few["error"] / many["error"], 4)
        sentences.append(
            f"The constitutive step alone is of order {order:.2f}, {many['error']:.1e} at 128 steps; the "
            "known answer has six digits, which is the floor of the last points."
        )
    for problem in MODES:
        for r in line_of(rows, problem, "modes", "float64")[-1:]:
            grid = min(line_of(rows, problem, "cfl 0.5", "float64"), key=lambda g: g["error"], default=None)
            if grid:
                sentences.append(
                    f"{problem}, without a grid: error {r['error']:.1e} in {r['seconds']:.2g} s; the best of the grid, "
                    f"{grid['size']}, {grid['error']:.1e} in {grid['seconds']:.2g} s."
                )
    refused = sum(r["outcome"] == "refused" for r in rows)
    failed = sum(r["outcome"] == "FAILED" for r in rows)
    sentences.append(f"{refused} runs were refused with a reason, {failed} failed.")
    return sentences


if __name__ == "__main__":
    main(sys.argv[1:])
