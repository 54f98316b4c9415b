"""Reconstruction: PSNR of photographs held out against time, over budgets and ways to add Gaussians.

    make bench-reconstruction [ARGS="data=../shared/data quick=1 scenes=lego,plush,carnation device=cpu seed=0"]
        ->   docs/results/reconstruction.csv, .png, .md

A budget is iterations x Gaussians x resolution; the largest is what conf/scene says. Every model is scored at the
largest resolution, whatever it was fitted at. The time is wall clock of the fit with its looks at the photographs held
out, kernels compiled before; CPU time beside it tells how busy the machine was with other things. Scenes whose data is
not there are left out, and the page says so. `quick=1` runs the smallest budget only.
"""

import csv
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from machine import machine

from physics3d.gaussians.densification.adaptive import Adaptive
from physics3d.gaussians.densification.relocation import Relocation
from physics3d.gaussians.loss import held_out_psnr
from physics3d.log import Log
from physics3d.scenes.base import Capture
from pipeline.settings import compose
from pipeline.stage import build
from stages.reconstruct import Reconstruct

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
SCENES = ("lego", "plush", "carnation")
# name -> part of the configured iterations, of the Gaussians, of the resolution
BUDGETS = {"small": (0.12, 0.3, 0.5), "medium": (0.35, 0.6, 0.75), "as configured": (1.0, 1.0, 1.0)}
WAYS = {"adaptive": Adaptive(), "MCMC": Relocation()}
COLUMNS = (
    "scene", "budget", "way", "exposure", "iterations", "max_gaussians", "longest_side", "step", "gaussians", "psnr_db",
    "seconds", "cpu_seconds", "floaters", "floaters_change_db", "final",
)  # fmt: skip


class Curve:
    """Stands where a Log does; keeps every number with the time since the start."""

    folder = None

    def __init__(self):
        self.start, self.cpu, self.points = time.perf_counter(), time.process_time(), []
        self.bar = Log(None).progress

    def metric(self, name: str, value: float, step: int | None = None) -> None:
        now, cpu = time.perf_counter() - self.start, time.process_time() - self.cpu
        self.points.append((name, float(value), step, now, cpu))

    def last(self, name: str) -> float | None:
        return next((value for n, value, *_ in reversed(self.points) if n == name), None)

    def info(self, text: str) -> None: ...

    def image(self, name: str, image, step: int | None = None) -> None: ...

    def progress(self, items, description: str, total: int | None = None):
        return self.bar(items, description, total)


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    device, seed, data = options.get("device", "cpu"), int(options.get("seed", 0)), options.get("data")
    budgets = {"small": BUDGETS["small"]} if options.get("quick") == "1" else BUDGETS
    rows: list[dict] = []
    left_out: list[str] = []
    for scene in options.get("scenes", ",".join(SCENES)).split(","):
        config, _ = compose([f"scene={scene}", f"seed={seed}", *([f"data={data}"] if data else [])])
        try:
            capture = build(config["capture"], device, "capture").source(log=Log(None))
        except ValueError as error:
            print(f"{scene} left out: {error}", flush=True)
            left_out.append(scene)
            continue
        full = build(config["reconstruct"], device, "reconstruct")
        side = min(full.longest_side, max(capture.cameras[0].width, capture.cameras[0].height))
        views = [p.to(device) for i, p in enumerate(replace(full, longest_side=side).photographs(capture))]
        views = [views[i] for i in capture.held_out]
        once = replace(full, iterations=20, max_gaussians=500, longest_side=64)
        once(capture, log=Log(None))  # compiles
        for budget, (share, count, factor) in budgets.items():
            stage = replace(
                full,
                iterations=round(share * full.iterations),
                max_gaussians=round(count * full.max_gaussians),
                longest_side=round(factor * side),
                check_every=max(20, round(share * full.iterations / 8)),
            )
            # the costly last budget is measured with what is the default
            for way in WAYS if budget != "as configured" else ["adaptive"]:
                keep(rows, scene, budget, way, replace(stage, densification=WAYS[way]), capture, views)
            if budget == "medium" and not capture.alphas:
                keep(rows, scene, budget, "adaptive", replace(stage, exposure=not full.exposure), capture, views)
            write(rows, left_out, device, seed)
    if not rows:
        sys.exit("nothing measured: no data; give data=<folder that holds lego/ and plush/>")


def keep(
    rows: list[dict], scene: str, budget: str, way: str, stage: Reconstruct, capture: Capture, views: list
) -> None:
    """Fit once; a row per look at the photographs held out, and a last one at the largest resolution."""
    curve = Curve()
    gaussians = stage(capture, log=curve)
    seconds, cpu = time.perf_counter() - curve.start, time.process_time() - curve.cpu
    head = dict(
        scene=scene, budget=budget, way=way, exposure=stage.exposure, iterations=stage.iterations,
        max_gaussians=stage.max_gaussians, longest_side=stage.longest_side,
    )  # fmt: skip
    for name, value, step, now, used in curve.points:
        if name == "psnr_held_out" and step is not None:
            rows.append({**head, "step": step, "psnr_db": value, "seconds": now, "cpu_seconds": used, "final": False})
    final = held_out_psnr(gaussians.to(stage.device), views, torch.tensor(capture.background, device=stage.device))
    last = dict(
        step=rows[-1]["step"], gaussians=len(gaussians), psnr_db=final, seconds=seconds, cpu_seconds=cpu, final=True,
        floaters=curve.last("floaters"), floaters_change_db=curve.last("psnr_without_floaters_minus_with"),
    )  # fmt: skip
    rows.append({**head, **last})
    print(f"{scene}, {budget}, {way}{', exposure' * stage.exposure}: {final:.2f} dB in {seconds:.0f} s", flush=True)


def write(rows: list[dict], left_out: list[str], device: str, seed: int) -> None:
    from matplotlib.figure import Figure

    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine(device)}, seed {seed}"
    with (RESULTS / "reconstruction.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows([{k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows])
    final = [row for row in rows if row["final"]]
    scenes = list(dict.fromkeys(row["scene"] for row in final))
    figure = Figure(figsize=(4.5 * len(scenes), 4), layout="constrained")
    for axis, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes):
        for way, marker in (("adaptive", "o"), ("MCMC", "s")):
            mine = [r for r in final if (r["scene"], r["way"], r["exposure"]) == (scene, way, False)]
            axis.plot([r["seconds"] for r in mine], [r["psnr_db"] for r in mine], marker=marker, label=way)
        aware = [r for r in final if r["scene"] == scene and r["exposure"]]
        if aware:
            axis.plot([r["seconds"] for r in aware], [r["psnr_db"] for r in aware], "^", label="adaptive, exposures")
        whole = [r for r in rows if r["scene"] == scene and r["budget"] == "as configured" and not r["final"]]
        if whole:
            axis.plot([r["seconds"] for r in whole], [r["psnr_db"] for r in whole], ":", label="during the largest")
        axis.set(xscale="log", xlabel="time [s]", ylabel="PSNR of photographs held out [dB]", title=scene)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(RESULTS / "reconstruction.png", dpi=110)
    (RESULTS / "reconstruction.md").write_text(page(final, left_out, title))


def page(final: list[dict], left_out: list[str], title: str) -> str:
    lines = [
        "# Reconstruction: quality against time",
        "",
        f"Made by `make bench-reconstruction`. Machine: {title}.",
        "Other work may have run beside it: then CPU seconds are less than about 1.5 times the seconds on two cores.",
        "",
        "PSNR [dB] of photographs that were held out, all at the largest resolution of their scene. The largest",
        "budget is the scene's configuration, the others are parts of it. `adaptive` splits what draws the most",
        "error, `MCMC` moves faded Gaussians to where opaque ones are (`physics3d/gaussians/densification/`). The last",
        "column is the change of PSNR by the removal of floaters, which is part of every row that has one.",
        "",
        "![PSNR against time](reconstruction.png)",
        "",
        "| scene | budget | way | iterations | Gaussians | longest side [px] | PSNR [dB] | s | CPU s | floaters | dB |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in final:
        floaters = ("", "") if r["floaters"] is None else (f"{r['floaters']:.0f}", f"{r['floaters_change_db']:+.3f}")
        way = r["way"] + ", exposures" * r["exposure"]
        lines.append(
            f"| {r['scene']} | {r['budget']} | {way} | {r['step']} | {r['gaussians']} | {r['longest_side']} | "
            f"{r['psnr_db']:.2f} | {r['seconds']:.0f} | {r['cpu_seconds']:.0f} | {floaters[0]} | {floaters[1]} |"
        )
    lines += [""]
    for scene in SCENES:
        mine = [r for r in final if r["scene"] == scene]
        if mine:
            best = max(mine, key=lambda r: r["psnr_db"])
            lines.append(f"- {scene}: at best {best['psnr_db']:.2f} dB, in {best['seconds']:.0f} s.")
    lines += [f"- {scene}: not measured, its data was not there." for scene in left_out]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(sys.argv[1:])
