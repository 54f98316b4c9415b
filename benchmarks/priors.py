"""The laboratory of priors: what distillation finds where the answer is known, by every estimator.

    make bench-priors [ARGS="sections=one,many,tiny twins=3 draws=16 steps=60"]
        ->   docs/results/priors.md, .csv, .png

The bodies are stems with a blossom whose films are made in closed form (`physics3d/scenes/stems.py`); theta is
ln(E/mode). Three priors are asked, each knows more of chance than the one before:

    one     the exact denoiser of the film of theta = 0: every answer is known in closed form
    many    the exact denoiser of 16 films of the same body and poke, ln E drawn from the family's distribution
    tiny    the small video model, trained on films of other bodies (`make train-prior`); left out without weights

Of each: the denoising loss along theta, the gradient of single draws (mean, zero, deviation at the mode), and descents
from a factor 4 above and below; of the small video model also as `learn` does it, after a search. `priors_tiny.py` has
the rows.
"""

import csv
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import machine
from priors_tiny import ESTIMATORS, GRID, RANGES, SEED, SPAN, PriorOf, Row, Twin, distil, gradients, landscape, tiny

from physics3d.priors.base import AbstractPrior
from physics3d.priors.exemplar import Exemplar
from physics3d.priors.tiny_video import TinyVideo
from physics3d.scenes.stems import SPREAD

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
FILMS = 16  # of the second prior
NAMES = {"one": "one exemplar", "many": f"{FILMS} exemplars", "tiny": "tiny_video"}


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    torch.set_num_threads(1)
    twins = [Twin.number(k) for k in range(int(options.get("twins", 3)))]
    draws, steps = int(options.get("draws", 16)), int(options.get("steps", 60))
    weights = options.get("weights")
    priors: dict[str, PriorOf] = {"one": exemplar(1), "many": exemplar(FILMS), "tiny": tiny(weights)}
    rows: list[Row] = []
    missing = ""
    for name in options.get("sections", "one,many,tiny").split(","):
        began = time.process_time()
        if name == "tiny":
            try:
                TinyVideo(weights=weights).files()
            except ValueError as error:
                missing = str(error)
                print(f"tiny is left out: {missing}")
                continue
        few = twins[:1] if name == "one" else twins
        every = [(estimator, RANGES[1]) for estimator in ESTIMATORS]
        found = [
            *landscape(few, draws, priors[name]),
            *gradients(few, draws, priors[name]),
            *distil(few[:1], steps, priors[name], chosen=every, by="closed form"),
        ]
        if name == "tiny":
            best = [(options.get("best", "stratified"), RANGES[1])]
            for searched in (False, True):
                found += distil(twins, steps, priors[name], chosen=best, by="solver", searched=searched)
        rows += [{"prior": NAMES[name], **row} for row in found]
        print(f"{NAMES[name]}: {len(found)} rows, {time.process_time() - began:.0f} s of CPU", flush=True)
        write(rows, missing, twins=len(twins), draws=draws, steps=steps)


def exemplar(count: int) -> PriorOf:
    """The exact denoiser of one film of theta = 0, or of `count` films whose theta is drawn."""

    def prior_of(twin: Twin, span: tuple[float, float]) -> tuple[AbstractPrior, Any]:
        prior = Exemplar(blur=(0.0,), sigma=span)
        rng = np.random.default_rng(SEED)
        thetas = [0.0] if count == 1 else (SPREAD * rng.normal(size=count)).tolist()
        films = tuple(twin.clip(theta).detach() for theta in thetas)
        return prior, prior.condition(films[0][0], films)

    return prior_of


def write(rows: list[Row], missing: str, **made: int) -> None:
    RESULTS.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "curve"))
    with (RESULTS / "priors.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, columns, extrasaction="ignore", restval="")
        table.writeheader()
        table.writerows(rows)
    draw(rows).savefig(RESULTS / "priors.png", dpi=100)
    (RESULTS / "priors.md").write_text(page(rows, missing, **made))


def draw(rows: list[Row]) -> Any:
    """A row of panels for each prior: landscape, mean gradient, descents; of the first twin."""
    from matplotlib.figure import Figure

    priors = list(dict.fromkeys(row["prior"] for row in rows))
    figure = Figure(figsize=(12, 3.3 * len(priors)), layout="constrained")
    for axes, prior in zip(figure.subplots(len(priors), 3, squeeze=False), priors):
        mine = [row for row in rows if row["prior"] == prior]
        first = mine[0]["twin"]
        for row in mine:
            curve = np.array(row["curve"])
            if row["twin"] != first or row.get("by", "").startswith("solver"):
                continue
            if row["section"] == "landscape":
                axes[0].plot(GRID, curve / curve.max(), label=f"noise {row['range']}")
            elif row["section"] == "gradient" and row["range"] == "3-30":
                axes[1].plot(GRID[::2], curve / np.abs(curve).max(), label=row["estimator"])
            elif row["section"] == "distil":
                number = list(ESTIMATORS).index(row["estimator"])
                axes[2].plot(curve, color=f"C{number}", label=row["estimator"] if row["start"] > 1 else None, lw=1)
        axes[0].set(title=f"{prior}: denoising loss / highest", xlabel="theta = ln(E/mode)", yscale="log")
        axes[1].set(title="mean gradient / largest, noise 3-30", xlabel="theta = ln(E/mode)")
        axes[1].axhline(0, color="0.7", lw=0.8)
        axes[2].set(title="theta along the descent", xlabel="step")
        axes[2].axhline(0, color="0.7", lw=0.8)
        for axis in axes:
            axis.legend(frameon=False, fontsize="x-small")
    return figure


def page(rows: list[Row], missing: str, *, twins: int, draws: int, steps: int) -> str:
    lines = [
        "# Priors: what distillation finds where the answer is known",
        "",
        f'`make bench-priors ARGS="twins={twins} draws={draws} steps={steps}"`. {machine("cpu")}. Seed {SEED}.',
        "",
        "Stems with a blossom are poked; how stiff they are is drawn around a mode, and theta = ln(E/mode) has to come",
        "out as 0. A prior is the exact denoiser of one film of theta = 0, that of 16 films of the same body, or the",
        "small video model, which was trained on other bodies. Noise is sigma/alpha, in units of the code. Weaknesses",
        "that the numbers show are those of the estimators; where the prior is exact, nothing else can be wrong.",
        "",
        "![landscapes, gradients and descents](priors.png)",
        "",
        "## Where is the denoising loss lowest?",
        "",
        "Above 1 in the last column: the still picture is held less probable than the best motion.",
        "",
        "| prior | noise | lowest at theta, mean (worst) | valleys | loss of the still picture / lowest |",
        "|---|---|---|---|---|",
    ]
    for prior, span, group in grouped(rows, "landscape", "range"):
        off = np.array([row["lowest"] for row in group])
        still = np.mean([row["still"] for row in group])
        beside = f"{still:.3g}" if np.isfinite(still) else "the best has none"
        valleys = max(row["valleys"] for row in group)
        lines.append(
            f"| {prior} | {span} | {off.mean():+.2f} ({off[np.abs(off).argmax()]:+.2f}) | {valleys} | {beside} |"
        )
    lines += [
        "",
        "## Where does the mean gradient vanish, and how well does one draw see it?",
        "",
        "Bias: the zero to which descent goes, where the gradient turns from negative to positive; none where it never",
        "does, and the words say where it pulls to then. Spread: the deviation of one draw's gradient at the mode, in",
        "units of theta. A stratified draw is eight questions to the prior.",
        "",
        "| prior | noise | estimator | bias, mean over twins | spread of one draw | ms per draw |",
        "|---|---|---|---|---|---|",
    ]
    for prior, (span, name), group in grouped(rows, "gradient", "range", "estimator"):
        known = [row for row in group if not np.isnan(row["bias"])]
        if known:
            bias = f"{np.mean([row['bias'] for row in known]):+.2f}"
            spread = f"{np.mean([row['spread'] for row in known]):.2g}"
            if len(known) < len(group):
                bias += f" (of {len(known)} of {len(group)})"
        else:
            bias, spread = f"none: {pull(np.array([row['curve'] for row in group]))}", "-"
        ms = 1e3 * np.mean([row["seconds"] for row in group])
        lines.append(f"| {prior} | {span} | {name} | {bias} | {spread} | {ms:.3g} |")
    lines += [
        "",
        "## Descents from a factor 4 off",
        "",
        f"{steps} steps of Adam; E/mode at the end. The solver is the project's own, with large rotations, and did not",
        "make the films. A search, as in `learn`, looks at five factors on the start by the denoising loss, from",
        f"1/{SPAN:g} to {SPAN:g}; none of them is the answer. Seconds are those of one processor, with the search.",
        "",
        "| prior | noise | moved by | estimator | twin | from 1/4 | from 4 | s each |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for prior, (span, by, name, twin), group in grouped(rows, "distil", "range", "by", "estimator", "twin"):
        ends = [row["found"] for row in sorted(group, key=lambda row: row["start"])]
        seconds = np.mean([row["processor_seconds"] for row in group])
        lines.append(f"| {prior} | {span} | {by} | {name} | {twin} | {ends[0]:.2f} | {ends[-1]:.2f} | {seconds:.1f} |")
    if missing:
        lines += ["", f"tiny_video is left out: {missing}"]
    return "\n".join(lines) + "\n"


def pull(gradient: np.ndarray) -> str:
    """Where descent goes, in words; a positive gradient lowers theta."""
    if (gradient <= 0).all():
        return "pulls to stiffer"
    if (gradient >= 0).all():
        return "pulls to softer"
    return f"pulls to stiffer at {100 * (gradient < 0).mean():.0f} % of the places, to softer at the others"


def grouped(rows: list[Row], section: str, *keys: str) -> list[tuple[str, Any, list[Row]]]:
    """(prior, value or values of the keys, rows) in the order in which they came."""
    found: dict[tuple, list[Row]] = {}
    for row in rows:
        if row["section"] == section:
            found.setdefault((row["prior"], *(row[key] for key in keys)), []).append(row)
    return [(k[0], k[1] if len(keys) == 1 else k[1:], group) for k, group in found.items()]


if __name__ == "__main__":
    main(sys.argv[1:])
