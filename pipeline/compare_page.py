"""What `make compare` writes: compare.md with one table for each scene, compare.csv, compare.png (error against run
time), and a sheet of pictures for each scene. Each file is complete under its name, or not there.

What others have published of the same things stands below (`published.py`)."""

import csv
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.filed import beside
from pipeline.published import published
from pipeline.settings import CONF, choices, described
from pipeline.stage import here

FIELD, FROZEN, FILMED = "deformation_field", "frozen first frame", "filmed"
METRICS = ("psnr", "ssim", "ms_ssim", "vmaf", "motion_psnr", "flow_error")
WHOLE = "physics3d"  # the method with which the others compare
IMAGE = "image modes"  # a row that only takes of unknown cause have
INSTANTS = 6  # pictures of a sheet
PANELS = 4  # of the plot, side by side
MARKS = "oxd"  # of methods in the plot, for each ten of them
TOLD = {  # what rows are, besides the methods of conf/method
    FROZEN: "the first picture, standing still",
    FIELD: "a deformation field without physics, fitted to the recorded clip (the peer is DreamGaussian4D)",
    IMAGE: "the flow of what was seen goes on as it swung, without a body",
    "last frame seen, frozen": "the last picture that was seen, standing still",
    "mean of the first half": "the mean of the pictures that were seen",
    "learned material": "the motion of the learned material alone, in modes that nothing has corrected",
}
OF_TAKES = [
    "Of real takes nobody knows the cause, and no method can be told the force. Of the first the first half is learned",
    "from and the rest foretold, of the others half a second from their release on is seen, in which the start is",
    f"sought; rows are means over the takes. There {WHOLE} swings by the modes that were seen, physgaussian by the",
    "material before learning, and deformation_field plays again what was seen, as one would that fits it without",
    "error.",
    "",
]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method on one scene."""

    scene: str
    method: str
    scores: dict[str, float]
    seconds: float | None = None  # of the stages that this method needs
    learned: dict[str, str] = field(default_factory=dict)  # parameter -> value and interval, in words
    video: Any = None  # uint8 [t, h, w, 3] of the first camera that judges
    fps: float | None = None  # of what was filmed [1/s]
    models: list[str] = field(default_factory=list)  # which simpler ones the clip leaves open, what would settle it

    @property
    def name(self) -> str:
        return self.method.replace("_", " ")


@dataclass
class Compared:
    """What is known of some scenes; keys are (scene, method)."""

    rows: list[Row] = field(default_factory=list)
    lost: dict[tuple[str, str], str] = field(default_factory=dict)  # why there is no row
    left_out: dict[tuple[str, str], str] = field(default_factory=dict)  # why there can be none

    def add(self, other: "Compared") -> None:
        self.rows += other.rows
        self.lost |= other.lost
        self.left_out |= other.left_out

    @property
    def scenes(self) -> list[str]:
        return list(dict.fromkeys([*(row.scene for row in self.rows), *(scene for scene, _ in self.lost)]))

    def of(self, scene: str) -> "Compared":
        mine = lambda cells: {key: why for key, why in cells.items() if key[0] == scene}
        rows = [row for row in self.rows if row.scene == scene]
        return Compared(rows=rows, lost=mine(self.lost), left_out=mine(self.left_out))


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


def write(folder: Path, found: Compared, config: dict[str, Any], *, words: list[str]) -> None:
    """`words` said more than scenes and methods, e.g. profile=smoke. Raises OSError if there is no room."""
    folder.mkdir(parents=True, exist_ok=True)
    with beside(folder / "compare.csv", over=True) as hidden, hidden.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["scene", "method", "seconds", *METRICS], restval="")
        writer.writeheader()
        writer.writerows({"scene": r.scene, "method": r.method, "seconds": r.seconds, **r.scores} for r in found.rows)
    with beside(folder / "compare.png", over=True) as hidden:
        plot(found.rows).savefig(hidden, dpi=100)
    for scene in found.scenes:
        sheet(folder / f"compare_{scene}.jpg", found.of(scene).rows)
    with beside(folder / "compare.md", over=True) as hidden:
        hidden.write_text(page(found, config, words))


def page(found: Compared, config: dict[str, Any], words: list[str]) -> str:
    """compare.md."""
    from physics3d.machine import machine

    told = {name: described(CONF / "method" / f"{name}.yaml") for name in choices("method")} | TOLD
    used = sorted({row.method for row in found.rows if row.scores}, key=rank)
    lines = [
        "# Methods compared",
        "",
        f"`{command(found.scenes, words)}`, seed {config['seed']}. Written on {machine(here(config['device']))}.",
        "",
        "All learn from one recorded motion and are judged by another one, of another force, that nobody saw. More is",
        "better, but for the error of the flow, which is relative to the motion: 1 is that of a picture that stands",
        "still. Seconds are those of all stages that a method needs, on the machine that ran them, which may have had",
        "other work. Intervals hold with a probability of 90 %.",
        "",
        *(f"- **{name}**: {told.get(name, name)}" for name in used),
        "",
        *(OF_TAKES if any(row.method == IMAGE for row in found.rows) else ()),
        *overall(found),
        "",
        "![error against run time](compare.png)",
    ]
    for scene in found.scenes:
        lines += section(scene, found.of(scene))
    return "\n".join([*lines, *published()]) + "\n"


def section(scene: str, found: Compared) -> list[str]:
    """The tables and the sheet of one scene."""
    table = sorted((row for row in found.rows if row.scores), key=lambda row: rank(row.method))
    # what pictures are too small for, or a thing moves too little, is no column
    measures = [m for m in METRICS if any(m in row.scores for row in table)]
    lines = ["", f"## {scene}", ""]
    for row in found.rows:
        if row.method == FILMED and row.fps is not None:
            lines += [f"The unseen motion is filmed for {len(row.video) / row.fps:.2g} s.", ""]
    lines += ["| method | " + " | ".join(m.replace("_", " ") for m in measures) + " | s |"]
    lines += ["|---" * (len(measures) + 2) + "|"]
    best = {}
    for m in measures:
        known = [row.scores[m] for row in table if m in row.scores]
        best[m] = (min if m == "flow_error" else max)(known)
    for row in table:
        cells = [cell(row.scores.get(m), best[m]) for m in measures]
        lines.append(f"| {row.method} | {' | '.join(cells)} | {'' if row.seconds is None else round(row.seconds)} |")
    reasons = [("not done", *one) for one in found.lost.items()]
    reasons += [("left out", *one) for one in found.left_out.items()]
    for verdict, (_, method), why in reasons:
        why = re.sub(r" \(traceback: .*\)$", "", why).replace("|", "/")  # a file of this machine tells no reader
        lines.append(f"| {method} | {verdict}: {why} |" + " |" * len(measures))
    lines += ["", *ties(found.rows), ""]
    lines += [
        f"- {row.method} learned " + "; ".join(f"{name} {value}" for name, value in row.learned.items())
        for row in table
        if row.learned
    ]
    if any(row.video is not None for row in found.rows):
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


def overall(found: Compared) -> list[str]:
    """One row for each method, one column for each scene, and the means over what can be compared."""
    of = {(row.scene, row.method): row.scores["psnr"] for row in found.rows if "psnr" in row.scores}
    asked = {method for _, method in (*of, *found.lost, *found.left_out)}
    methods = sorted(asked, key=rank)
    # what only some scenes have rows of, such as image modes, is compared there alone
    tried = {method for _, method in (*of, *found.lost)} & {*choices("method"), FIELD, FROZEN}
    ran = [method for method in methods if method in tried]
    whole = [scene for scene in found.scenes if all((scene, method) in of for method in ran)]
    mean = {m: sum(of[scene, m] for scene in whole) / len(whole) for m in ran} if whole else {}
    best = {scene: max((of[scene, m] for m in methods if (scene, m) in of), default=None) for scene in found.scenes}

    def entry(scene: str, method: str) -> str:
        if (scene, method) in found.lost:
            return "not done"
        return "-" if (scene, method) in found.left_out else cell(of.get((scene, method)), best[scene])

    lines = [
        f"PSNR of the unseen motion in dB; the mean is that of {len(whole)} of {len(found.scenes)} scenes, on which",
        "every method ended."
        + (" A dash: the method is not asked there, why is said below." if found.left_out else ""),
        "",
        "| method | " + " | ".join(found.scenes) + " | mean |",
        "|---" * (len(found.scenes) + 2) + "|",
    ]
    for method in methods:
        last = cell(mean.get(method), max(mean.values(), default=None))
        lines.append(f"| {method} | {' | '.join(entry(scene, method) for scene in found.scenes)} | {last} |")
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
            f"- This clip does not tell {', '.join([best.name, *alike])} apart. What would: sharper pictures, a "
            "recording that goes on until the motion has died away, a second force, or a weight hung on the thing."
        )
        lines += [f"- {row.name} itself says: {sentence}" for row in judged for sentence in row.models]
    return lines


def cell(value: float | None, best: float | None) -> str:
    """A number, bold where it is the best of its column."""
    if value is None:
        return ""
    return f"**{value:.4g}**" if value == best else f"{value:.4g}"


def plot(rows: list[Row]) -> Any:
    """Error against run time, a panel for each scene; below them what the colours mean."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row.scene for row in rows))
    methods = sorted({row.method for row in rows if "psnr" in row.scores}, key=rank)
    across = min(PANELS, len(scenes))
    down = -(-len(scenes) // across)
    figure = Figure(figsize=(3.6 * max(2, across), 2.9 * down + 1.0), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False)
    keys: dict[str, Any] = {}
    for axis, scene in zip(panels.flat, scenes):
        for row in rows:
            if row.scene != scene or "psnr" not in row.scores:
                continue
            colour = f"C{methods.index(row.method) % 10}"
            if row.seconds is None:
                line = axis.axhline(row.scores["psnr"], color=colour, linestyle=":")
                keys.setdefault(row.method, line)  # a point, where there is one, says more
            else:
                (keys[row.method],) = axis.plot(
                    row.seconds, row.scores["psnr"], MARKS[methods.index(row.method) // 10], color=colour
                )
        axis.set(title=scene, xscale="log")
        axis.xaxis.set_major_formatter(lambda value, at: f"{value:g}")
        axis.xaxis.set_minor_formatter(lambda value, at: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
    for axis in panels.flat[len(scenes) :]:
        axis.set_axis_off()
    figure.supxlabel("run time [s]", fontsize=9)
    figure.supylabel("PSNR of the unseen motion [dB]", fontsize=9)
    shown = [method for method in methods if method in keys]
    figure.legend([keys[m] for m in shown], shown, loc="outside upper center", ncols=4, fontsize=8)
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
