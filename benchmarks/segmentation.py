"""Labels against the truth, and the time they take: twins prompted as a person would, over views, mask sizes, rounds.

    make bench-segmentation   ->   docs/results/segmentation.csv, .png, .md

The twins are meshes (tests/labelled_twins.py): the part that covers most of a pixel is known, and Gaussians put on the
meshes have the label of their mesh, so that no reconstruction is in the way. The last rows reconstruct the carnation
from its photographs; a Gaussian's true label is then that of the nearest surface, and what exact masks of all
photographs would give is the row `exact masks`. Prompts: in one view, round each part a box drawn 2 % of the image too
wide, up to three clicks on it and two on each other thing in the box, placed by code; or those of conf/scene. IoU per
Gaussian is weighted by opacity and taken over all Gaussians; IoU per pixel over all masked photographs. The time is CPU
time of the stage on one thread.
"""

import csv
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml
from machine import machine

sys.path[:0] = [str(Path(__file__).parents[1] / "tests")]

from labelled_twins import Twin, agreement, ball, carnation

from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.segmentation.lift import contributions, lift
from physics3d.segmentation.prompts import Prompt
from stages.reconstruct import Reconstruct
from stages.segment import Segment

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
PHOTOGRAPHS, WIDTH, GAUSSIANS, SEED = 40, 320, 16_000, 0
VIEWS, SIZES, ROUNDS = (6, 10, 16, 24, 40), (120, 160, 240, 320), (0, 1, 2, 3)
MANY, LEVELS = 16, {"pixel": 0.97, "gaussian": 0.95}  # drawn as lines, for the eye
FRESH = (1, 2, 3)  # other flowers, on which nothing was tuned; the ball has only one look
PARTS = ("stem", "blossom", "pot")
SHIPPED: dict[str, tuple[str, dict[str, str]]] = {  # twin -> scene, names of its parts
    "plant": ("carnation", {}),
    "stem and blossom": ("carnation_parts", {"petals": "blossom"}),
}
QUIET = Log(None)


def main() -> None:
    torch.set_num_threads(1)
    rows: list[dict] = []
    plant = carnation(("plant",), views=PHOTOGRAPHS, width=WIDTH, seed=SEED, log=QUIET)
    twins = {
        "plant": plant,
        "stem and blossom": Twin(plant.capture, plant.studio, *relabelled(PARTS[:2])),
        "stem, blossom, pot": Twin(plant.capture, plant.studio, *relabelled(PARTS)),
        "ball": ball(views=PHOTOGRAPHS, width=WIDTH, seed=SEED, log=QUIET),
    }
    prompts = {name: twin.prompts(3, clicks=3) for name, twin in twins.items()}
    for name, twin in twins.items():
        model, truth = twin.gaussians(GAUSSIANS, SEED)
        plans = [(MANY, WIDTH, r) for r in ROUNDS] if name in ("plant", "ball") else [(MANY, WIDTH, 2)]
        plans += [(v, WIDTH, 2) for v in VIEWS if v != MANY]
        plans += [(MANY, s, 2) for s in SIZES if s != WIDTH] if name in ("plant", "ball") else []
        for views, size, rounds in plans:
            rows += measure(name, "on the meshes", twin, model, truth, prompts[name], views, size, rounds)
    for seed in FRESH:
        fresh = {
            "plant": carnation(("plant",), views=PHOTOGRAPHS, width=WIDTH, seed=seed, log=QUIET),
            "stem, blossom, pot": carnation(PARTS, views=PHOTOGRAPHS, width=WIDTH, seed=seed, log=QUIET),
        }
        for name, twin in fresh.items():
            TRUE.clear()
            model, truth = twin.gaussians(GAUSSIANS, seed)
            rows += measure(
                name, f"on the meshes, fresh seed {seed}", twin, model, truth, twin.prompts(3, clicks=3), MANY, WIDTH, 2
            )
    TRUE.clear()
    model = Reconstruct(iterations=1000, max_gaussians=12_000, seed=SEED)(plant.capture, log=QUIET)
    for name in list(twins)[:3]:
        twin = twins[name]
        truth = torch.from_numpy(twin.nearest_label(model.mean.numpy()))
        rows += measure(name, "reconstructed", twin, model, truth, prompts[name], MANY, WIDTH, 2)
        if name in SHIPPED:
            said = shipped(*SHIPPED[name])
            rows += measure(name, "reconstructed, prompts of the scene", twin, model, truth, said, MANY, WIDTH, 2)
        rows += exact(name, twin, model, truth)
    write(rows)


def shipped(scene: str, rename: dict[str, str]) -> tuple[Prompt, ...]:
    """The prompts of a scene's configuration, its parts called as here."""
    told = yaml.safe_load((Path(__file__).parents[1] / "conf" / "scene" / f"{scene}.yaml").read_text())
    prompts = [Prompt(**{k: v for k, v in p.items() if k != "_target_"}) for p in told["scene"]["prompts"]]
    return tuple(replace(p, part=rename.get(p.part, p.part)) for p in prompts)


def relabelled(parts: tuple[str, ...]) -> tuple[np.ndarray, tuple[str, ...]]:
    """The carnation's meshes with other parts: label of each, and the parts."""
    twin = carnation(parts, views=6, width=32, seed=SEED, log=QUIET)
    return twin.label_of_mesh, twin.parts


TRUE: dict[tuple[str, int, int], np.ndarray] = {}  # ray traced once


def measure(
    name: str,
    of: str,
    twin: Twin,
    model: Gaussians,
    truth: torch.Tensor,
    prompts: tuple[Prompt, ...],
    views,
    size,
    rounds,
) -> list[dict]:
    """One row per part."""
    start = time.process_time()
    found = Segment(prompts=prompts, views=views, size=size, rounds=rounds)(twin.capture, model, log=QUIET)
    seconds = time.process_time() - start
    for view in found.mask_views:
        camera = twin.capture.cameras[view]
        if (name, view, size) not in TRUE:
            TRUE[name, view, size] = twin.true_map(camera.scaled(size / camera.width))
    maps = np.stack([TRUE[name, view, size] for view in found.mask_views])
    rows = []
    for k, part in enumerate(found.parts, 1):
        each = [agreement(m == k, t == k) for m, t in zip(found.masks.numpy(), maps) if (t == k).any()]
        row = dict(twin=name, gaussians=of, part=part, masker="GrabCut", views=views, size=size, rounds=rounds)
        row |= dict(
            pixel=agreement(found.masks.numpy() == k, maps == k),
            worst_view=min(each),
            gaussian=agreement(found.label == k, truth == k, model.opacity.numpy()),
            seconds=seconds,
        )
        rows.append(row)
        print(row, flush=True)
    return rows


def exact(name: str, twin: Twin, model: Gaussians, truth: torch.Tensor) -> list[dict]:
    """What the lift alone gives, from exact masks of every photograph."""
    cameras = twin.capture.cameras
    maps = [torch.from_numpy(twin.true_map(camera)) for camera in cameras]
    label = lift(model.mean, contributions(model, cameras, maps, 1 + len(twin.parts)))
    row = dict(twin=name, gaussians="reconstructed", masker="exact masks", views=len(cameras), size=WIDTH, rounds=0)
    return [
        row | dict(part=part, pixel=1.0, gaussian=agreement(label == k, truth == k, model.opacity.numpy()))
        for k, part in enumerate(twin.parts, 1)
    ]


COLUMNS = (
    "twin",
    "gaussians",
    "part",
    "masker",
    "views",
    "size",
    "rounds",
    "pixel",
    "worst_view",
    "gaussian",
    "seconds",
)


def write(rows: list[dict]) -> None:
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / "segmentation.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    plot(rows)
    lines = ["# Segmentation: labels against the truth", "", "Made by `make bench-segmentation`.", ""]
    lines += [f"Machine: {machine('cpu')}, one thread; seed {SEED}. Shared with other work: compare times within", ""]
    lines[-2] += " this page only."
    lines += [__doc__.partition("\n\n")[2].partition("\n\n")[2].strip(), "", "![IoU](segmentation.png)", ""]
    lines += ["## What it shows", "", *verdicts(rows), "", "## Runs", ""]
    lines += [f"| {' | '.join(COLUMNS)} |".replace("_", " "), "|" + "---|" * len(COLUMNS)]
    for row in rows:
        values = [row.get(c, "") for c in COLUMNS]
        cells = [f"{v:.1f}" if c == "seconds" else f"{v:.3f}" for c, v in zip(COLUMNS, values) if isinstance(v, float)]
        words = [str(v) for v in values[:7]]
        padding = [""] * (len(COLUMNS) - len(words) - len(cells))
        if padding:  # exact masks have no worst view and no time
            cells = [cells[0], "", cells[1], ""]
        lines.append(f"| {' | '.join([*words, *cells])} |")
    (RESULTS / "segmentation.md").write_text("\n".join(lines) + "\n")
    print(RESULTS / "segmentation.md")


def verdicts(rows: list[dict]) -> list[str]:
    """One line per twin and part at the stage's own settings, and what views and exact masks change."""
    lines = []
    for row in rows:
        if (row["views"], row["size"], row["rounds"], row["masker"]) == (MANY, WIDTH, 2, "GrabCut"):
            best = next((r for r in rows if same(row, r) and r["masker"] == "exact masks"), None)
            ceiling = f"; exact masks would give {best['gaussian']:.3f}" if best else ""
            lines.append(
                f"- {row['twin']}, {row['part']}, Gaussians {row['gaussians']}: {row['pixel']:.3f} per pixel "
                f"(worst view {row['worst_view']:.3f}), {row['gaussian']:.3f} per Gaussian{ceiling}; "
                f"{row['seconds']:.0f} s of CPU."
            )
    usual = [r for r in rows if (r["views"], r["size"], r["rounds"], r["masker"]) == (MANY, WIDTH, 2, "GrabCut")]
    for what, why in (
        ("pixel", "By some thousandths: single pixels of the outline, many at leaves; by more: soil taken for stem"),
        ("gaussian", "Gaussians that lie across the boundary have one label; the rows with exact masks are the most"),
    ):
        short = [(LEVELS[what] - r[what], r) for r in usual if r[what] < LEVELS[what]]
        listed = "; ".join(f"{r['part']} ({r['twin']}, {r['gaussians']}) by {by:.3f}" for by, r in short)
        lines.append(f"- Below {LEVELS[what]} per {what}: {listed or 'none'}." + (f" {why}." if short else ""))
    small = [r for r in rows if r["twin"] == "ball" and r["size"] < WIDTH]
    coarse = ", ".join(f"{r['size']} px {r['pixel']:.2f} and {r['gaussian']:.2f}" for r in small)
    lines += [
        "- The thresholds of the method, the rule that places clicks and the clicks in conf/scene were chosen while "
        f"looking at the truth of the twins of seed {SEED}: theirs are values of a set that was tuned on. The "
        f"fresh seeds {', '.join(map(str, FRESH))} vary petals, leaves, soil and pot, but neither cameras nor the "
        "kind of scene. Where stem and pot of one twin are both far below the others', the stem has taken in soil: "
        "what the prompted view does not show may be the stem's until a view tells, and whether it is taken is near a "
        "threshold.",
        f"- The ball with masks below {WIDTH} px: {coarse} per pixel and per Gaussian. Its far side has other colours, "
        "which coarse masks do not always carry, and its lower rim, in shadow, goes to the table.",
    ]
    lines.append("- SAM 2 has not been measured: its weights were not at hand. The tests run it with random weights.")
    return lines


def same(a: dict, b: dict) -> bool:
    return (a["twin"], a["part"]) == (b["twin"], b["part"]) and a["gaussians"].startswith(b["gaussians"])


def plot(rows: list[dict]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8))
    panels = figure.subplots(2, 3, sharey="row")
    known = [r for r in rows if r["gaussians"] == "on the meshes"]
    for panel, what, title in zip(panels.T, ("views", "size", "rounds"), ("photographs masked", "mask [px]", "rounds")):
        usual = {"views": MANY, "size": WIDTH, "rounds": 2}
        for number, (twin, part) in enumerate(dict.fromkeys((r["twin"], r["part"]) for r in known)):
            fits = lambda r: all(r[k] == v for k, v in usual.items() if k != what)  # noqa: B023
            line = sorted(
                (r for r in known if (r["twin"], r["part"]) == (twin, part) and fits(r)), key=lambda r: r[what]
            )
            if len(line) < 2:
                continue
            for axes, measure_ in zip(panel, ("pixel", "gaussian")):
                axes.plot(
                    [r[what] for r in line],
                    [r[measure_] for r in line],
                    "o-",
                    color=f"C{number}",
                    label=f"{part} ({twin})",
                )
        for axes, (measure_, least) in zip(panel, LEVELS.items()):
            axes.axhline(least, color="0.6", linestyle=":")
            axes.set(xlabel=title, ylabel=f"IoU per {measure_}", ylim=(0.5, 1))
    panels[0, 0].legend(fontsize=7, loc="lower right")
    figure.savefig(RESULTS / "segmentation.png", dpi=90, bbox_inches="tight")


if __name__ == "__main__":
    main()
