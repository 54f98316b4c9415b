"""Does it matter where learning starts? The same clip from starts two decades apart, and from other velocities.

    make bench-starts [ARGS="scenes=carnation,bird data=../shared/data"]   ->   docs/results/starts.md, .csv, .png

Of each scene the stages up to the filling run once, then the learning from every start, all of it as in `make run`.
The carnation starts a factor 10 too soft to a factor 10 too stiff, and with relaxation times a factor 10 apart. The
bird of PAC-NeRF falls: its stiffness starts over two decades, its Poisson's ratio over most of what can be, and the
velocity with which it comes, read off the silhouettes, is 10 % wrong or learned beside the material. The answer should
stay within 10 %, or the run should say what else explains the clip.

A run that is done stands in the .csv and is not done again; remove the file to begin anew.
"""

import csv
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from machine import machine

from physics3d.log import Log
from pipeline.settings import compose
from pipeline.stage import build

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
BAR = 10.0  # [%] that answers may differ from their middle


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Where its learning starts, in words -> in words of the configuration; what is learned, with its unit."""

    shown: dict[str, str]
    starts: dict[str, tuple[str, ...]] = field(default_factory=dict)


E, NU, TAU = "material.start.youngs_modulus", "material.start.poissons_ratio", "material.start"
tau = lambda value: (f"{TAU}.shear_relaxation_time={value}", f"{TAU}.bulk_relaxation_time={value}")
SCENES = {
    "carnation": Scene(
        shown={"youngs_modulus": "E [Pa]", "branch_shear_modulus": "mu_N [Pa]", "shear_relaxation_time": "tau [s]"},
        starts={
            "as configured: 5e4 Pa, 0.3 s": (),
            **{f"{value:g} Pa": (f"{E}={value}",) for value in (1.5e4, 1.5e5, 5e5, 1.5e6)},
            **{f"{value:g} s": tau(value) for value in (0.05, 0.5)},
        },
    ),
    "bird": Scene(
        shown={"youngs_modulus": "E [Pa]", "poissons_ratio": "nu"},
        starts={
            "as configured: 5e4 Pa, 0.3": (),
            **{f"{value:g} Pa": (f"{E}={value}",) for value in (3e4, 3e5, 3e6)},
            **{f"nu {value:g}": (f"{NU}={value}",) for value in (0.15, 0.42)},
            "10 % faster": ("world.velocity=[0.117, 0.0, -0.565]",),
            "10 % slower": ("world.velocity=[0.095, 0.0, -0.463]",),
            "velocity learned": ("learn.learn_velocity=true",),
        },
    ),
}


def main(words: list[str]) -> None:
    options = {"scenes": ",".join(SCENES), "data": "../shared/data"} | dict(word.split("=", 1) for word in words)
    table = RESULTS / "starts.csv"
    rows = list(csv.DictReader(table.open())) if table.exists() else []
    for name in options["scenes"].split(","):
        left = [start for start in SCENES[name].starts if (name, start) not in {(r["scene"], r["start"]) for r in rows}]
        made: tuple[Any, ...] = ()
        for start in left:
            config, _ = compose([f"scene={name}", f"data={options['data']}", *SCENES[name].starts[start]])
            made = made or prepared(config)
            began = time.perf_counter()
            learned = build(config["learn"], "cpu", "learn")(*made, log=Log(None))
            row: dict[str, Any] = {"scene": name, "start": start, "seconds": f"{time.perf_counter() - began:.0f}"}
            row["machine"] = machine("cpu")
            for key in SCENES[name].shown:
                found = learned.intervals[key]
                row |= {key: f"{float(learned.parameters[key]):.5g}", f"{key}_low": f"{found.low:.5g}"}
                row |= {f"{key}_high": f"{found.high:.5g}"}
            row["models"] = "; ".join(f"{model} {odds:+.1f}" for model, odds in learned.models.items())
            row["loss"] = f"{learned.history['loss'][-1]:.5g}"
            rows.append(row)
            keep(table, rows)
            write(rows)
            print(", ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    write(rows)


def prepared(config: dict[str, Any]) -> tuple[Any, ...]:
    """(capture, gaussians, body), as the pipeline makes them."""
    stage = {name: build(config[name], "cpu", name) for name in ("capture", "reconstruct", "segment", "fill")}
    capture = stage["capture"](log=Log(None))
    gaussians = stage["reconstruct"](capture, log=Log(None))
    segmentation = None if capture.single_object else stage["segment"](capture, gaussians, log=Log(None))
    return capture, gaussians, stage["fill"](capture, gaussians, segmentation, log=Log(None))


def keep(table: Path, rows: list[dict[str, Any]]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    half = table.with_suffix(".part")
    with half.open("w", newline="") as stream:
        out = csv.DictWriter(stream, columns, restval="")
        out.writeheader()
        out.writerows(rows)
    half.replace(table)


def write(rows: list[dict[str, Any]]) -> None:
    text = ["# Where learning starts", "", "Made by `make bench-starts`.", ""]
    text += [__doc__.partition("\n\n")[2].partition("\n\n")[2].partition("A run that is done")[0].strip(), ""]
    text += [f"Machine: {'; '.join(dict.fromkeys(row['machine'] for row in rows))}; seed 0.", ""]
    text += ["![what was found from every start](starts.png)", ""]
    for name, scene in SCENES.items():
        mine = [row for row in rows if row["scene"] == name]
        if not mine:
            continue
        heads = [cell for unit in scene.shown.values() for cell in (unit, "90 %")]
        text += [f"## {name}", "", f"| start | {' | '.join(heads)} | loss | s |", "|---" * (len(heads) + 3) + "|"]
        for row in mine:
            cells = [
                cell
                for key in scene.shown
                for cell in (
                    f"{float(row[key]):.4g}",
                    f"{float(row[key + '_low']):.3g} to {float(row[key + '_high']):.3g}",
                )
            ]
            text.append(f"| {row['start']} | {' | '.join(cells)} | {row['loss']} | {row['seconds']} |")
        text += ["", *(spread(mine, key, unit) for key, unit in scene.shown.items())]
        if name == "bird":
            text.append(
                "- PAC-NeRF, from the same clips: 2.78e5 Pa and 0.273; usually quoted for the data: 3e5 Pa and 0.3"
            )
        text += [""]
    (RESULTS / "starts.md").write_text("\n".join(text))
    draw(rows)


def spread(rows: list[dict[str, Any]], key: str, unit: str) -> str:
    values = sorted(float(row[key]) for row in rows)
    middle = values[len(values) // 2]
    far = max(abs(value / middle - 1) for value in values)
    holds = "holds" if 100 * far <= BAR else "does not hold"
    return f"- {unit}: {middle:.4g} in the middle, {100 * far:.1f} % away at most; the bar of {BAR:g} % {holds}"


def draw(rows: list[dict[str, Any]]) -> None:
    from matplotlib.figure import Figure

    shown = [
        (name, key) for name, scene in SCENES.items() for key in scene.shown if any(r["scene"] == name for r in rows)
    ]
    figure = Figure(figsize=(11, 2.6 * len(shown)), layout="constrained")
    panels = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for panel, (name, key) in zip(panels, shown):
        mine = [row for row in rows if row["scene"] == name]
        low, value, high = ([float(row[key + end]) for row in mine] for end in ("_low", "", "_high"))
        panel.vlines(range(len(mine)), low, high, color="C0", linewidth=6, alpha=0.35)
        panel.plot(range(len(mine)), value, "o", color="C0")
        panel.set_xticks(range(len(mine)), [row["start"] for row in mine], fontsize=7)
        panel.set(title=f"{name}: {SCENES[name].shown[key]}, with 90 % intervals, by where it started")
        if key != "poissons_ratio":
            panel.set_yscale("log")
    figure.savefig(RESULTS / "starts.png", dpi=110)


if __name__ == "__main__":
    main(sys.argv[1:])
