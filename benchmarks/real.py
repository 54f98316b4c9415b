"""Real recordings of unknown cause: one material per thing, learned from half of one take, foretells the rest.

    make bench-real [ARGS="data=../shared/data scenes=carnation_real,telephone_real"]
        ->   docs/results/real.md, .csv, .png

Of take 0 the first half is learned from and the second foretold; of the others half a second from the release on is
seen, in which only their start is sought, and all that follows is foretold. Every prediction stands beside still
pictures, image modes (flow of what was seen, extrapolated without physics), and the material before it was learned.
Means over the frames that were foretold. The recordings carry no licence, so no picture of theirs is shown. What was
seen on the takes, and why some are foretold worse than others: [real takes](../real_takes.md).
"""

import csv
import sys
import time
from pathlib import Path

import numpy as np
from machine import machine

from physics3d.log import Log
from physics3d.metrics.scores import REFERENCE
from physics3d.motion.stills import FIRST, LAST, MEAN
from pipeline.settings import compose
from pipeline.stage import build
from stages.foretell import IMAGE, LEARNED, SEEN, START

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
ROWS = (SEEN, LEARNED, START, IMAGE, LAST, MEAN, FIRST)
MEASURES = (
    *("psnr", "ssim", "ms_ssim", "vmaf", "flow_error", "frequency", "damping"),
    *("thing_flow_error", "thing_damping"),
)


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    data = options.get("data", "../shared/data")
    rows: list[dict] = []
    said: list[str] = []
    for scene in options.get("scenes", "carnation_real,telephone_real").split(","):
        config, _ = compose([f"scene={scene}", f"data={data}"])
        stages = {name: build(config[name], "cpu", name) for name in ("capture", "fill", "learn", "foretell")}
        log = lambda name: Log(None)
        began = time.perf_counter()
        try:
            capture = stages["capture"](log=log("capture"))
        except ValueError as error:
            said.append(f"{scene} is left out: {error}")
            continue
        body = stages["fill"](capture, capture.gaussians, None, log=log("fill"))
        estimate = stages["learn"](capture, capture.gaussians, body, log=log("learn"))
        learned = time.perf_counter() - began
        scores = stages["foretell"](capture, capture.gaussians, body, estimate, log=log("foretell"))
        E = estimate.parameters["youngs_modulus"].double()
        said.append(
            f"{scene}: {len(body.position)} particles; E/rho {float(E.mean()) / config['scene']['density']:.3g} m^2/s^2"
            f"{'' if E.ndim == 0 else ' in the mean over zones'}, branch of "
            f"{float(estimate.parameters['branch_shear_modulus'].mean() / E.mean() * 2.6):.2g} of the stiffness and "
            f"{float(estimate.parameters['shear_relaxation_time']):.2g} s, for the distance and thickness assumed; "
            f"{learned:.0f} s to the material, {time.perf_counter() - began:.0f} s in all"
        )
        for name, cells in scores.values.items():
            take, row = name.split(": ")
            rows.append(dict(scene=scene, take=take, row=row, **cells))
        write(rows, said)
        print("\n".join(said), flush=True)
    if not rows:
        sys.exit("\n".join(said))


def write(rows: list[dict], said: list[str]) -> None:
    with (RESULTS / "real.csv").open("w", newline="") as file:
        out = csv.DictWriter(file, ("scene", "take", "row", *MEASURES), extrasaction="ignore")
        out.writeheader()
        out.writerows({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    text = ["# Real motion, foretold", "", f"Made by `make bench-real`. Machine: {machine('cpu')}.", ""]
    text += [__doc__.partition("\n\n")[2].partition("\n\n")[2].strip(), "", "![PSNR of every take](real.png)", ""]
    text += [*(f"- {line}" for line in said), "", "## PSNR [dB] / SSIM / MS-SSIM / VMAF", ""]
    text += [f"| take | {' | '.join(ROWS)} |", "|---" * (len(ROWS) + 1) + "|"]
    takes = list(dict.fromkeys((row["scene"], row["take"]) for row in rows))
    found = {(row["scene"], row["take"], row["row"]): row for row in rows}
    for take in takes:
        text.append(f"| {' '.join(take)} | {' | '.join(cell(found[(*take, name)]) for name in ROWS)} |")
    means = {
        name: {m: float(np.mean([found[(*take, name)][m] for take in takes])) for m in MEASURES[:4]} for name in ROWS
    }
    text += [f"| mean | {' | '.join(cell(means[name]) for name in ROWS)} |", ""]
    text += ["## Against the bars", "", *(f"- {line}" for line in bars(takes, found, means)), ""]
    text += ["## Motion: flow error, frequency [Hz], damping [1/s] of what was foretold and of what came", ""]
    text += ["| take | flow error, modes as seen | image modes | frequency | recorded | damping | recorded |"]
    text += ["|---" * 7 + "|"]
    for take in takes:
        mine, image, real = (found[(*take, name)] for name in (SEEN, IMAGE, REFERENCE))
        values = [mine["flow_error"], image["flow_error"], mine["frequency"], real["frequency"]]
        values += [mine["damping"], real["damping"]]
        text.append(f"| {' '.join(take)} | {' | '.join('–' if v is None else f'{v:.3g}' for v in values)} |")
    text += ["", "## The same at the thing's own pixels", ""]
    text += ["Flow is a guess beside what moves and where there is no texture; both are counted above.", ""]
    text += ["| take | flow error, modes as seen | image modes | damping | recorded | off [%] |", "|---" * 6 + "|"]
    for take in takes:
        mine, image, real = (found[(*take, name)] for name in (SEEN, IMAGE, REFERENCE))
        damped, recorded = mine.get("thing_damping"), real.get("thing_damping")
        values = [mine.get("thing_flow_error"), image.get("thing_flow_error"), damped, recorded]
        values.append(100 * (damped / recorded - 1) if damped is not None and recorded else None)
        text.append(f"| {' '.join(take)} | {' | '.join('–' if v is None else f'{v:.3g}' for v in values)} |")
    (RESULTS / "real.md").write_text("\n".join(text) + "\n")
    plot(takes, found)


def bars(takes: list, found: dict, means: dict) -> list[str]:
    """What is asked of the prediction, and whether it is reached."""
    said = []
    for name, measures in ((LAST, MEASURES[:4]), (IMAGE, MEASURES[:1])):
        for m in measures:
            mine, bar = means[SEEN][m], means[name][m]
            above = sum(found[(*take, SEEN)][m] > found[(*take, name)][m] for take in takes)
            said.append(
                f"{m.upper().replace('_', '-')} in the mean over takes {'above' if mine > bar else 'NOT above'} that "
                f"of {name}: {mine:.4g} against {bar:.4g}; above in {above} of {len(takes)} takes"
            )
    for m, share in (("frequency", 0.03), ("damping", 0.2)):
        pairs = [(found[(*take, SEEN)][m], found[(*take, REFERENCE)][m]) for take in takes]
        off = [abs(a / b - 1) if a is not None and b else None for a, b in pairs]
        good = sum(e is not None and e <= share for e in off)
        shown = ", ".join("–" if e is None else f"{100 * e:.0f} %" for e in off)
        said.append(
            f"{m} within {100 * share:.0f} % of what is read off the recording in {good} of {len(takes)}: {shown}"
        )
    return said


def cell(row: dict) -> str:
    digits = {"psnr": ".2f", "ssim": ".3f", "ms_ssim": ".3f", "vmaf": ".2f"}
    return " / ".join("–" if row[k] is None else format(row[k], d) for k, d in digits.items())


def plot(takes: list, found: dict) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.6 * len(takes) + 2, 3.4), layout="constrained")
    axis = figure.add_subplot()
    for i, name in enumerate(ROWS):
        at = np.arange(len(takes)) + 0.11 * (i - 3)
        axis.bar(at, [found[(*take, name)]["psnr"] for take in takes], 0.1, label=name)
    axis.set_xticks(range(len(takes)), ["\n".join(take) for take in takes], fontsize=8)
    axis.set(ylabel="PSNR [dB]", ylim=(18, None))
    axis.legend(frameon=False, fontsize=8, ncols=3)
    figure.savefig(RESULTS / "real.png", dpi=110)


if __name__ == "__main__":
    main(sys.argv[1:])
