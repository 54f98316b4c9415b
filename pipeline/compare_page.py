"""What `make compare` writes: compare.md with one table for each scene, compare.csv, compare.png (error against run
time), and a sheet of pictures for each scene. Each file is complete under its name, or not there."""

import csv
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.filed import beside
from pipeline.settings import CONF, choices, described
from pipeline.stage import here

FIELD, FROZEN, FILMED = "deformation_field", "frozen first frame", "filmed"
METRICS = ("psnr", "ssim", "ms_ssim", "vmaf", "motion_psnr", "flow_error")
WHOLE = "physics3d"  # the method with which the others compare
INSTANTS = 6  # pictures of a sheet


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method on one scene."""

    scene: str
    method: str
    scores: dict[str, float]
    seconds: float | None = None  # of the stages that this method needs
    learned: dict[str, str] = field(default_factory=dict)  # parameter -> value and interval, in words
    video: Any = None  # uint8 [t, h, w, 3] of the first camera that judges

    @property
    def name(self) -> str:
        return self.method.replace("_", " ")


def better(filmed: Any, one: Any, other: Any, *, seed: int = 0) -> tuple[float, float, float]:
    """By how much the PSNR of `one` lies above that of `other`, and between what with a probability of 90 % [dB].

    Of the mean over the frames that move, by resampling stretches of a sixth of the clip (moving block bootstrap,
    Kuensch 1989), for neighbouring frames err alike. Videos are uint8 [t, h, w, 3].
    """
    import numpy as np

    count = min(map(len, (filmed, one, other)))
    truth = filmed[1:count].float()
    error = lambda clip: 10 * np.log10(((clip[1:count].float() - truth) ** 2).mean((1, 2, 3)).clamp_min(1e-6).numpy())
    gain = error(other) - error(one)
    block = max(1, round(len(gain) / 6))
    starts = np.random.default_rng(seed).integers(0, len(gain) - block + 1, (4000, -(-len(gain) // block)))
    means = gain[(starts[..., None] + np.arange(block)).reshape(4000, -1)[:, : len(gain)]].mean(1)
    return float(gain.mean()), float(np.quantile(means, 0.05)), float(np.quantile(means, 0.95))


def write(
    folder: Path, rows: list[Row], lost: dict[tuple[str, str], str], config: dict[str, Any], *, words: list[str]
) -> None:
    """`lost`: (scene, method) -> why there is no row; `words` said more than scenes and methods, e.g. profile=smoke.
    Raises OSError if there is no room."""
    folder.mkdir(parents=True, exist_ok=True)
    with beside(folder / "compare.csv", over=True) as hidden, hidden.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["scene", "method", "seconds", *METRICS], restval="")
        writer.writeheader()
        writer.writerows({"scene": r.scene, "method": r.method, "seconds": r.seconds, **r.scores} for r in rows)
    with beside(folder / "compare.png", over=True) as hidden:
        plot(rows).savefig(hidden, dpi=100)
    scenes = list(dict.fromkeys([*(row.scene for row in rows), *(scene for scene, _ in lost)]))
    for scene in scenes:
        sheet(folder / f"compare_{scene}.jpg", [row for row in rows if row.scene == scene])
    with beside(folder / "compare.md", over=True) as hidden:
        hidden.write_text(page(rows, lost, scenes, config, words))


def page(
    rows: list[Row], lost: dict[tuple[str, str], str], scenes: list[str], config: dict[str, Any], words: list[str]
) -> str:
    """compare.md."""
    from physics3d.machine import machine

    told = {name: described(CONF / "method" / f"{name}.yaml") for name in choices("method")}
    told |= {
        FROZEN: "the first picture, standing still",
        FIELD: "a deformation field without physics, fitted to the recorded clip (the peer is DreamGaussian4D)",
    }
    used = sorted({row.method for row in rows if row.scores}, key=rank)
    lines = [
        "# Methods compared",
        "",
        f"`{command(scenes, words)}`, seed {config['seed']}. Written on {machine(here(config['device']))}.",
        "",
        "All learn from one recorded motion and are judged by another one, of another force, that nobody saw. More is",
        "better, but for the error of the flow, which is relative to the motion: 1 is that of a picture that stands",
        "still. Seconds are those of all stages that a method needs, on the machine that ran them, which may have had",
        "other work. Intervals hold with a probability of 90 %.",
        "",
        *(f"- **{name}**: {told.get(name, name)}" for name in used),
        "",
        *overall(rows, lost, scenes),
        "",
        "![error against run time](compare.png)",
    ]
    for scene in scenes:
        of_scene = [row for row in rows if row.scene == scene]
        lines += section(scene, of_scene, {method: why for (s, method), why in lost.items() if s == scene})
    return "\n".join(lines) + "\n"


def section(scene: str, rows: list[Row], lost: dict[str, str]) -> list[str]:
    """The tables and the sheet of one scene; `lost`: method -> why there is no row."""
    table = sorted((row for row in rows if row.scores), key=lambda row: rank(row.method))
    # what pictures are too small for, or a thing moves too little, is no column
    measures = [m for m in METRICS if any(m in row.scores for row in table)]
    lines = ["", f"## {scene}", "", "| method | " + " | ".join(m.replace("_", " ") for m in measures) + " | s |"]
    lines += ["|---" * (len(measures) + 2) + "|"]
    best = {}
    for m in measures:
        known = [row.scores[m] for row in table if m in row.scores]
        best[m] = (min if m == "flow_error" else max)(known)
    for row in table:
        cells = [cell(row.scores.get(m), best[m]) for m in measures]
        lines.append(f"| {row.method} | {' | '.join(cells)} | {'' if row.seconds is None else round(row.seconds)} |")
    for method, why in lost.items():
        why = re.sub(r" \(traceback: .*\)$", "", why).replace("|", "/")  # a file of this machine tells no reader
        lines.append(f"| {method} | not done: {why} |" + " |" * len(measures))
    lines += ["", *ties(rows), ""]
    lines += [f"- {row.method} learned {n}: {v}" for row in table for n, v in row.learned.items()]
    if any(row.video is not None for row in rows):
        lines += ["", f"![{scene}: what was filmed, and the methods at the same instants](compare_{scene}.jpg)"]
    return lines


def rank(method: str) -> tuple[bool, bool, bool, bool, str]:
    """What was filmed first, then pictures without physics, peers, ablations and the whole method."""
    without_physics = method in (FROZEN, FIELD)
    return method != FILMED, method == WHOLE, method.startswith("without"), not without_physics, method


def command(scenes: list[str], words: list[str]) -> str:
    """What makes this page."""
    said = dict(word.partition("=")[::2] for word in words)
    said.pop("output", None)  # where results lie makes none of them
    named = [f"{name.upper()}={said.pop(name)}" for name in ("profile", "data") if name in said]
    more = [f'ARGS="{" ".join(f"{k}={v}" for k, v in said.items())}"'] if said else []
    return " ".join(["make compare", f"SCENES={','.join(scenes)}", *named, *more])


def overall(rows: list[Row], lost: dict[tuple[str, str], str], scenes: list[str]) -> list[str]:
    """The PSNR of every method on every scene, and means over the scenes on which every method that ran ended."""
    of = {(row.scene, row.method): row.scores["psnr"] for row in rows if "psnr" in row.scores}
    methods = sorted({m for _, m in of} | {m for _, m in lost}, key=rank)
    ran = [method for method in methods if method in (*choices("method"), FIELD, FROZEN)]
    whole = [scene for scene in scenes if all((scene, method) in of for method in ran)]
    mean = {m: sum(of[scene, m] for scene in whole) / len(whole) for m in ran} if whole else {}
    best = {scene: max((of[scene, m] for m in methods if (scene, m) in of), default=None) for scene in scenes}
    lines = [
        f"PSNR of the unseen motion in dB; the mean is that of {len(whole)} of {len(scenes)} scenes, on which every",
        "method ended.",
        "",
        "| method | " + " | ".join(scenes) + " | mean |",
        "|---" * (len(scenes) + 2) + "|",
    ]
    for method in methods:
        cells = [
            "not done" if (scene, method) in lost else cell(of.get((scene, method)), best[scene]) for scene in scenes
        ]
        last = cell(mean.get(method), max(mean.values(), default=None))
        lines.append(f"| {method} | {' | '.join(cells)} | {last} |")
    return lines


def ties(rows: list[Row]) -> list[str]:
    """The best method by PSNR beside each of the others, in words."""
    filmed = next((row.video for row in rows if row.method == FILMED), None)
    judged = [row for row in rows if row.video is not None and "psnr" in row.scores]
    if filmed is None or len(judged) < 2:
        return []
    judged.sort(key=lambda row: -row.scores["psnr"])
    best, alike, lines = judged[0], [], []
    for row in judged[1:]:
        gain, low, high = better(filmed, best.video, row.video)
        lines.append(f"- {best.name} is {gain:.2f} dB above {row.name} (between {low:.2f} and {high:.2f})")
        if low <= 0:
            lines[-1] += ": a tie"
            alike.append(row.name)
    if alike:
        lines.append(
            f"- This clip does not tell {', '.join([best.name, *alike])} apart. What would: a recording that goes on "
            "until the motion has died away, a second force, or a weight hung on the thing."
        )
    return lines


def cell(value: float | None, best: float | None) -> str:
    """A number, bold where it is the best of its column."""
    if value is None:
        return ""
    return f"**{value:.4g}**" if value == best else f"{value:.4g}"


def plot(rows: list[Row]) -> Any:
    """Error against run time, a panel for each scene."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row.scene for row in rows))
    methods = sorted({row.method for row in rows if "psnr" in row.scores}, key=rank)
    figure = Figure(figsize=(5.2 * len(scenes), 4.0), layout="constrained")
    for axis, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes):
        for row in sorted(rows, key=lambda row: rank(row.method)):
            if row.scene != scene or "psnr" not in row.scores:
                continue
            if row.seconds is None:
                axis.axhline(row.scores["psnr"], color="0.5", linestyle=":", label=row.method)
            else:
                axis.plot(row.seconds, row.scores["psnr"], "o", color=f"C{methods.index(row.method)}", label=row.method)
        axis.set(title=scene, xlabel="run time [s]", ylabel="PSNR of the unseen motion [dB]", xscale="log")
        axis.legend(fontsize=7)
    return figure


def sheet(path: Path, rows: list[Row]) -> None:
    """A line of pictures for each method, at the same instants."""
    import numpy as np
    from matplotlib.figure import Figure

    shown = sorted((row for row in rows if row.video is not None), key=lambda row: rank(row.method))
    if not shown:
        return
    count = min(len(row.video) for row in shown)
    at = np.linspace(0, count - 1, INSTANTS).round().astype(int)
    height, width = shown[0].video.shape[1:3]
    figure = Figure(
        figsize=(1.6 * INSTANTS, 1.6 * height / width * len(shown) + 0.2 * len(shown)), layout="constrained"
    )
    for line, row in zip(figure.subplots(len(shown), INSTANTS, squeeze=False), shown):
        for axis, i in zip(line, at):
            axis.imshow(row.video[int(i)].numpy())
            axis.set(xticks=[], yticks=[])
        line[0].set_title(row.method, fontsize=7, loc="left")
    with beside(path, over=True) as hidden:
        figure.savefig(hidden, dpi=110, pil_kwargs={"quality": 80})
