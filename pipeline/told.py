"""What the steps of a run left for people, read from their folders without torch: for the terminal and for the page."""

import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from physics3d.truth import truth_of
from pipeline.flow import Plan
from pipeline.stage import Step, manifest, peek

TIE = math.log(20.0)  # as in `physics3d/learning/which_model.py`, without torch
JUDGES = ("foretell", "evaluate")  # steps whose result is a table of scores


@dataclass(frozen=True, kw_only=True)
class Told:
    """Of one step."""

    step: Step
    seconds: float
    memory: int  # largest resident memory of the process [byte]
    manifest: dict[str, Any]
    lines: list[str]  # its log
    numbers: dict[str, float]  # what it measured once
    curves: dict[str, list[tuple[int, float]]]  # name -> (step, value)
    previews: dict[str, tuple[Path, int]]  # name -> the last picture of its series, and how many there are


@dataclass(frozen=True, kw_only=True)
class Parameter:
    name: str
    start: float
    learned: float | None = None
    truth: float | None = None
    low: float | None = None  # the number is below with a probability of 5 %
    high: float | None = None  # and above likewise
    determined: bool = True  # whether the clip has at least halved what was unknown before

    @property
    def between(self) -> str:
        """The interval in words; of what was not learned, that."""
        if self.learned is None or self.low is None or self.high is None:
            given = self.learned is None or math.isclose(self.learned, self.start, rel_tol=1e-6)  # filed in float32
            return "as given" if given else "no interval is known"
        words = f"between {self.low:.4g} and {self.high:.4g}"
        return words if self.determined else f"not determined by this clip; {words}"


@dataclass(frozen=True, kw_only=True)
class Table:
    """Scores: rows and metrics as `physics3d.metrics.scores` names them."""

    step: str
    values: dict[str, dict[str, float | None]]
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def metrics(self) -> list[str]:
        return list(dict.fromkeys(m for row in self.values.values() for m in row))


def told(step: Step) -> Told:
    """Raises ValueError if the step has not been filed."""
    stored, folder = manifest(step), step.folder
    numbers: dict[str, float] = {}
    curves: dict[str, list[tuple[int, float]]] = {}
    measured = folder / "metrics.jsonl"
    for line in measured.read_text().splitlines() if measured.is_file() else ():
        point = json.loads(line)
        if point["step"] is None:
            numbers[point["name"]] = point["value"]
        elif math.isfinite(point["value"]):
            curves.setdefault(point["name"], []).append((point["step"], point["value"]))
    previews: dict[str, tuple[Path, int]] = {}
    for path in sorted((folder / "previews").glob("*.png")):
        name = re.sub(r"_\d{5}$", "", path.stem)
        previews[name] = (path, previews.get(name, (path, 0))[1] + 1)
    lines = folder / "log.txt"
    return Told(
        step=step,
        seconds=stored["seconds"],
        memory=stored["peak_rss_bytes"],
        manifest=stored,
        lines=lines.read_text().splitlines() if lines.is_file() else [],
        numbers=numbers,
        curves={name: points for name, points in curves.items() if len(points) > 1},
        previews=previews,
    )


def parameters(plan: Plan) -> list[Parameter]:
    """Of the material, and the density where it is learned: where it started, what was learned and how far that can be
    trusted, what is true."""
    steps = {step.name: step for step in plan.steps}
    truth = peek(steps["capture"].folder)["truth"]
    start, learned, intervals = means(steps["guess"]), {}, {}
    if "learn" in steps:
        learned, found = means(steps["learn"]), peek(steps["learn"].folder)
        intervals = found.get("intervals", {})
        if (density := found.get("density")) is not None:
            start, learned = (
                start | {"density": manifest(steps["guess"])["config"]["world"]["density"]},
                learned | {"density": density},
            )
    sides = lambda name: (
        {key: intervals[name][key] for key in ("low", "high", "determined")} if name in intervals else {}
    )
    return [
        Parameter(name=name, start=value, learned=learned.get(name), truth=truth_of(name, truth), **sides(name))
        for name, value in start.items()
    ]


def models(plan: Plan) -> list[str]:
    """Which simpler models the clip leaves open, and which recording would settle it: a sentence each."""
    steps = {step.name: step for step in plan.steps}
    learned = peek(steps["learn"].folder) if "learn" in steps else {}
    return of_models(learned.get("models", {}), learned.get("film_next", {}))


def of_models(odds: dict[str, float], film_next: dict[str, float]) -> list[str]:
    """Both as of an `Estimate`; what tells most comes first."""
    verdict = lambda value: "explains the clip as well: a tie" if value < TIE else "does not explain the clip"
    settles = lambda value: "should settle it" if value >= TIE else "would hardly settle it"
    return [
        *(f"{name}: {verdict(value)} (ln B {value:+.1f})" for name, value in odds.items()),
        *(
            f"to film next: {name}: {settles(value)} (ln B {value:+.1f})"
            for name, value in sorted(film_next.items(), key=lambda one: -one[1])
        ),
    ]


def scores(plan: Plan) -> list[Table]:
    """Of every step that judges."""
    found = []
    for step in plan.steps:
        if step.name in JUDGES:
            stored = peek(step.folder)
            found.append(Table(step=step.name, values=stored["values"], notes=stored["notes"]))
    return found


def means(step: Step) -> dict[str, float]:
    """Material parameters of a filed Estimate; of a field, the mean over particles."""
    stored: dict[str, Any] = peek(step.folder, arrays=True)["parameters"]
    return {name: float(value.mean() if hasattr(value, "mean") else value) for name, value in stored.items()}
