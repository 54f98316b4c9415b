"""What a person sees at the end of a run: steps, learned parameters, scores, and where to look; read from artifacts."""

import math
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.flow import Plan
from pipeline.stage import Step, manifest, peek


def report(plan: Plan, hits: dict[str, bool]) -> dict[str, float]:
    """Print the tables; `hits` says which steps were reused. Returns the headline numbers by name, for tracking.

    The folder of the video is noted in artifacts/.latest, where `make view` looks.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 160)
    steps = {step.name: step for step in plan.steps}

    def table(*columns: str) -> Table:
        made = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for i, column in enumerate(columns):
            made.add_column(column, justify="left" if i == 0 else "right", overflow="fold")
        return made

    stages = table("stage", "", "seconds", "memory", "result")
    stages.columns[-1].justify = "left"
    for name, step in steps.items():
        told = manifest(step)
        memory = f"{told['peak_rss_bytes'] / 1e9:.1f} GB"
        how = "taken" if step.taken else "reused" if hits[name] else "computed"
        stages.add_row(name, how, f"{told['seconds']:.1f}", memory, str(_near(step.folder)))
    for name, why in plan.left_out.items():
        stages.add_row(name, "left out", "", "", why)
    console.print(stages)

    truth = peek(steps["capture"].folder)["truth"]
    start = _parameters(steps["guess"])
    learned = _parameters(steps["learn"]) if "learn" in steps else None
    parameters = table("parameter", "start", *(["learned"] if learned else []), *(["truth"] if truth else []))
    for name, value in start.items():
        row = [f"{value:.4g}"]
        if learned:
            row.append(f"{learned[name]:.4g}")
        if truth:
            row.append(f"{truth[name]:.4g}" if name in truth else "?")
        parameters.add_row(name, *row)
    console.print(parameters)

    for judge in ("foretell", "evaluate"):
        if judge not in steps:
            continue
        stored = peek(steps[judge].folder)
        metrics = list(dict.fromkeys(m for row in stored["values"].values() for m in row))
        scores = table("score", *metrics)
        for name, row in stored["values"].items():
            scores.add_row(name, *("-" if row.get(m) is None else f"{row[m]:.4g}" for m in metrics))
        console.print(scores)
        for name, note in stored["notes"].items():
            console.print(f"{name}: {note}", markup=False)

    for video in sorted(steps["render"].folder.glob("*.mp4")):
        console.print(f"video     {_near(video)}", markup=False)
    with suppress(OSError):
        shelf, folder = steps["render"].shelf, steps["render"].folder
        (shelf / ".latest").write_text(f"{folder.relative_to(shelf)}\n")  # so that it holds when the shelf is moved
    console.print(f"previews  {_near(steps['render'].folder / 'previews')}   (make view)", markup=False)
    return headline(plan)


def headline(plan: Plan) -> dict[str, float]:
    """Learned parameters and scores of a plan whose steps are all filed, by name."""
    steps = {step.name: step for step in plan.steps}
    found = {f"learned/{k}": v for k, v in _parameters(steps["learn"]).items()} if "learn" in steps else {}
    for judge in ("foretell", "evaluate"):
        for name, row in peek(steps[judge].folder)["values"].items() if judge in steps else ():
            found |= {f"score/{name}/{m}": v for m, v in row.items() if v is not None and math.isfinite(v)}
    return found


def _parameters(step: Step) -> dict[str, float]:
    """Material parameters of a filed Estimate; of a field, the mean over particles."""
    stored: dict[str, Any] = peek(step.folder, arrays=True)["parameters"]
    return {name: float(value.mean() if hasattr(value, "mean") else value) for name, value in stored.items()}


def _near(path: Path) -> Path:
    """Relative to where the user stands, if it is below."""
    try:
        return path.resolve().relative_to(Path.cwd())
    except ValueError:
        return path
