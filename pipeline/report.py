"""What a person sees at the end of a run: steps, learned parameters, scores, and where to look; read from artifacts."""

import math
import sys
from contextlib import suppress
from pathlib import Path

from pipeline import told
from pipeline.flow import Plan
from pipeline.stage import peek


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
        left = told.told(step)
        memory = f"{left.memory / 1e9:.1f} GB"
        how = "taken" if step.taken else "reused" if hits[name] else "computed"
        stages.add_row(name, how, f"{left.seconds:.1f}", memory, str(_near(step.folder)))
    for name, why in plan.left_out.items():
        stages.add_row(name, "left out", "", "", why)
    console.print(stages)

    rows = told.parameters(plan)
    has_learned, has_truth = "learn" in steps, bool(peek(steps["capture"].folder)["truth"])
    heads = ["parameter", "start"] + ["learned", "with a probability of 90 %"] * has_learned + ["truth"] * has_truth
    parameters = table(*heads)
    for p in rows:
        row = [f"{p.start:.4g}"]
        if p.learned is not None:
            row += [f"{p.learned:.4g}", p.between]
        if has_truth:
            row.append("?" if p.truth is None else f"{p.truth:.4g}")
        parameters.add_row(p.name, *row)
    console.print(parameters)
    for sentence in told.models(plan):
        console.print(sentence, markup=False)

    for judged in told.scores(plan):
        scores = table("score", *judged.metrics)
        for name, cells in judged.values.items():
            scores.add_row(name, *("-" if cells.get(m) is None else f"{cells[m]:.4g}" for m in judged.metrics))
        console.print(scores)
        for name, note in judged.notes.items():
            console.print(f"{name}: {note}", markup=False)

    for page in sorted(steps["foretell"].folder.glob("*.md")) if "foretell" in steps else ():
        if page.name != "scores.md":
            console.print(f"take      {_near(page)}", markup=False)
    for video in sorted(steps["render"].folder.glob("*.mp4")):
        console.print(f"video     {_near(video)}", markup=False)
    with suppress(OSError):
        shelf, folder = steps["render"].shelf, steps["render"].folder
        (shelf / ".latest").write_text(f"{folder.relative_to(shelf)}\n")  # so that it holds when the shelf is moved
    console.print(f"previews  {_near(steps['render'].folder / 'previews')}   (make view)", markup=False)
    return headline(plan)


def headline(plan: Plan) -> dict[str, float]:
    """Learned parameters with their intervals, and scores, of a plan whose steps are all filed, by name."""
    found: dict[str, float] = {}
    for p in told.parameters(plan):
        for side, value in (("learned", p.learned), ("learned_low", p.low), ("learned_high", p.high)):
            if value is not None:
                found[f"{side}/{p.name}"] = value
    for judged in told.scores(plan):
        for name, cells in judged.values.items():
            found |= {f"score/{name}/{m}": v for m, v in cells.items() if v is not None and math.isfinite(v)}
    return found


def _near(path: Path) -> Path:
    """Relative to where the user stands, if it is below."""
    try:
        return path.resolve().relative_to(Path.cwd())
    except ValueError:
        return path
