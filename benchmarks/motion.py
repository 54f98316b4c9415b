"""Motion of real takes: what still pictures score, and how far extrapolated flow (image modes) goes without physics.

    make bench-motion [ARGS="data=../shared/data things=carnation,telephone takes=0,1,2,3"]
        ->   docs/results/motion.csv, .png, .md

The first half of a take is seen, the second predicted: frame 0 frozen, the last frame seen frozen, the mean of the
first half, and image modes (`physics3d/motion/image_modes.py`). Numbers are means over the frames of the second half;
PSNR is the mean of that of the frames. Frequencies and dampings are those of the decay that was fitted to what was
seen, with standard errors, beside those of the same fit to the whole take. Then one take tells of the others: shapes,
frequencies and dampings of the first take, of the others only the start, from their first 25 frames; the rest is
predicted.

Takes that are not there are left out, and the page says so. The recordings carry no licence, so no picture of theirs is
shown.
"""

import csv
import sys
import time
from pathlib import Path

import numpy as np
import torch
from machine import machine

from physics3d.metrics.image import likeness
from physics3d.metrics.video import vmaf
from physics3d.motion.clip import read_clip
from physics3d.motion.decay import Decay
from physics3d.motion.flow import flow, trust
from physics3d.motion.image_modes import ImageModes, image_modes, of_another_take
from physics3d.motion.shapes import signals
from physics3d.motion.stills import FIRST, LAST, MEAN, stills

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
MODES, TOLD = "image modes", "told by take {}"
SEEN_OF_OTHERS = 25  # frames
COLUMNS = ("thing", "take", "seen", "row", "psnr", "ssim", "ms_ssim", "vmaf")


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    data = Path(options.get("data", "../shared/data"))
    takes = [int(i) for i in options.get("takes", "0,1,2,3").split(",")]
    rows: list[dict] = []
    decays: list[dict] = []
    lines: dict[str, dict[str, list[float]]] = {}
    left_out: list[str] = []
    for thing in options.get("things", "carnation,telephone").split(","):
        clips = {}
        for i in takes:
            path = data / thing / "videos" / f"real_take{i}.mp4"
            if path.is_file():
                clips[i] = read_clip(path)
            else:
                left_out.append(f"{thing} {i}")
        teacher: tuple[int, ImageModes] | None = None
        for i, clip in clips.items():
            started, seen = time.process_time(), len(clip.frames) // 2
            future = clip.frames[seen:]
            modes = image_modes(clip.frames[:seen], clip.fps)
            predictions = stills(clip.frames, seen=seen)
            predictions[MODES] = modes.frames(range(seen, len(clip.frames)))
            for name, prediction in predictions.items():
                cells, line = scores(prediction, future)
                rows.append(dict(thing=thing, take=i, seen=seen, row=name, **cells))
                lines.setdefault(f"{thing} {i}", {})[name] = line
            whole = image_modes(clip.frames, clip.fps)
            signal = measured(modes, clip.frames)
            decays.append(dict(thing=thing, take=i, modes=modes, whole=whole, measured=signal))
            if teacher is None:
                teacher = i, whole
            else:
                rows += told(thing, teacher, i, clip.frames, clip.fps)
            print(f"{thing} {i}: {time.process_time() - started:.0f} s of CPU", rows[-1], flush=True)
            write(rows, decays, lines, left_out)
    if not rows:
        sys.exit(f"nothing measured: no takes in {data}; give data=<folder that holds carnation/ and telephone/>")


def told(thing: str, teacher: tuple[int, ImageModes], take: int, frames: torch.Tensor, fps: float) -> list[dict]:
    """Another take, told by the first, beside its own last frame seen."""
    seen, future = frames[:SEEN_OF_OTHERS], frames[SEEN_OF_OTHERS:]
    modes = of_another_take(teacher[1], seen)
    prediction = modes.frames(range(SEEN_OF_OTHERS, len(frames)))
    own = image_modes(seen, fps).frames(range(SEEN_OF_OTHERS, len(frames)))
    still = stills(frames, seen=SEEN_OF_OTHERS)[LAST]
    head = dict(thing=thing, take=take, seen=SEEN_OF_OTHERS)
    named = {LAST: still, MODES: own, TOLD.format(teacher[0]): prediction}
    return [dict(**head, row=name, **scores(video, future)[0]) for name, video in named.items()]


def scores(video: torch.Tensor, future: torch.Tensor) -> tuple[dict[str, float | None], list[float]]:
    """(means over frames, PSNR of every frame)."""
    like = likeness(video, future)
    line = like.psnr_per_frame
    cells = {"psnr": float(np.mean(line)), "ssim": float(np.mean(like.ssim)), "vmaf": vmaf(video, future)[0]}
    return cells | {"ms_ssim": None if like.ms_ssim is None else float(np.mean(like.ms_ssim))}, line


def write(rows: list[dict], decays: list[dict], lines: dict, left_out: list[str]) -> None:
    with (RESULTS / "motion.csv").open("w", newline="") as file:
        out = csv.DictWriter(file, COLUMNS)
        out.writeheader()
        rounded = lambda v: f"{v:.5g}" if isinstance(v, float) else v
        out.writerows({k: rounded(row.get(k)) for k in COLUMNS} for row in rows)
    plot(lines, decays)
    text = ["# Motion of real takes: still pictures and image modes", "", "Made by `make bench-motion`. Machine: "]
    text[-1] += f"{machine('cpu')}."
    text += ["", __doc__.partition("\n\n")[2].partition("\n\n")[2].strip(), "", "![PSNR per frame](motion.png)", ""]
    if left_out:
        text += [f"Left out, for they are not there: {', '.join(left_out)}.", ""]
    names = (FIRST, LAST, MEAN, MODES)
    text += ["## The second half of every take: PSNR [dB] / SSIM / MS-SSIM / VMAF", ""]
    text += [f"| take | {' | '.join(names)} |", "|---" * 5 + "|"]
    halves = [row for row in rows if row["seen"] != SEEN_OF_OTHERS]
    for thing, take in dict.fromkeys((row["thing"], row["take"]) for row in halves):
        found = {row["row"]: row for row in halves if (row["thing"], row["take"]) == (thing, take)}
        text.append(f"| {thing} {take} | {' | '.join(cell(found[name]) for name in names)} |")
    means = {name: mean([row for row in halves if row["row"] == name]) for name in names}
    text += [f"| mean | {' | '.join(cell(means[name]) for name in names)} |", ""]
    text += ["## Frequencies [Hz] and dampings [1/s], with standard errors", ""]
    text += [
        "Oscillations that are still 5 % of the largest at the end of what was fitted; relaxations are left out.",
        "",
    ]
    text += ["| take | first half | free from frame | whole take | free from frame |", "|---" * 5 + "|"]
    for row in decays:
        halves_ = [f"{poles(row[k].decay)} | {row[k].release}" for k in ("modes", "whole")]
        text.append(f"| {row['thing']} {row['take']} | {' | '.join(halves_)} |")
    others = [row for row in rows if row["seen"] == SEEN_OF_OTHERS]
    if others:
        text += ["", f"## One take tells of the others: {SEEN_OF_OTHERS} frames seen, the rest predicted", ""]
        text += [
            "| take | last frame seen, frozen | image modes of its own | told by the first take |",
            "|---" * 4 + "|",
        ]
        for thing, take in dict.fromkeys((row["thing"], row["take"]) for row in others):
            found = [cell(row) for row in others if (row["thing"], row["take"]) == (thing, take)]
            text.append(f"| {thing} {take} | {' | '.join(found)} |")
    (RESULTS / "motion.md").write_text("\n".join(text) + "\n")


def mean(rows: list[dict]) -> dict[str, float]:
    return {k: float(np.mean([row[k] for row in rows])) for k in ("psnr", "ssim", "ms_ssim", "vmaf")}


def cell(row: dict) -> str:
    digits = {"psnr": ".2f", "ssim": ".3f", "ms_ssim": ".3f", "vmaf": ".2f"}
    return " / ".join("–" if row[k] is None else format(row[k], d) for k, d in digits.items())


def poles(decay: Decay | None) -> str:
    """The oscillations that are left at the end, the largest first."""
    if decay is None:
        return "no motion"
    size = np.where(decay.frequency > 0, decay.amplitude(decay.end), 0)
    chosen = [j for j in np.argsort(-size) if size[j] > 0.05 * size.max()]
    f, d, f_error, d_error = decay.frequency, decay.damping, decay.frequency_error, decay.damping_error
    return "; ".join(f"{f[j]:.3f} ± {f_error[j]:.3f}, {d[j]:.2f} ± {d_error[j]:.2f}" for j in chosen)


def measured(modes: ImageModes, frames: torch.Tensor) -> np.ndarray:
    """The first signal in every frame, also of those that were not seen [px rms]."""
    u = flow(frames, reference=modes.reference)
    return signals(u, trust(frames, u, reference=modes.reference), modes.shape)[:, 0]


def plot(lines: dict[str, dict[str, list[float]]], decays: list[dict]) -> None:
    """PSNR per frame of the second half, a panel per take; below, the largest signal, measured and foretold."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * max(2, len(lines)), 5.6), layout="constrained")
    panels = np.atleast_2d(figure.subplots(2, max(2, len(lines)), sharey="row"))
    for k, ((title, curves), row) in enumerate(zip(lines.items(), decays)):
        modes, signal = row["modes"], row["measured"]
        every = np.arange(len(signal)) / modes.fps
        for name, line in curves.items():
            panels[0, k].plot(every[-len(line) :], line, lw=1, label=name)
        panels[0, k].set(title=title, xlabel="time [s]")
        panels[1, k].plot(every, signal, lw=0.8, color="0.5", label="measured")
        if modes.decay is not None:
            free = every[modes.release :]
            panels[1, k].plot(free, modes.decay.at(free)[:, 0], lw=1, color="C3", label="decay of the first half")
        panels[1, k].axvline(modes.reference / modes.fps, color="0.8", lw=0.8)
        panels[1, k].set(xlabel="time [s]")
    panels[0, 0].set_ylabel("PSNR [dB]")
    panels[0, 0].legend(fontsize=7, frameon=False)
    panels[1, 0].set_ylabel("first signal [px rms]")
    panels[1, 0].legend(fontsize=7, frameon=False)
    figure.savefig(RESULTS / "motion.png", dpi=80, bbox_inches="tight")


if __name__ == "__main__":
    main(sys.argv[1:])
