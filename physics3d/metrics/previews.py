"""What one looks at after an evaluation: films side by side, sheets of frames, space-time slices, bars."""

import math

import torch
from torch import Tensor

from physics3d.log import Log
from physics3d.metrics.pictures import busiest, slices
from physics3d.metrics.scores import FROZEN, REFERENCE, UNITS, Scores, columns
from physics3d.pictures import contact_sheet, titled
from physics3d.video import write_mp4


def previews(rows: dict[str, list[Tensor]], fps: float, scores: Scores, log: Log) -> None:
    """What one looks at: films side by side, sheets of frames, space-time slices, bars."""
    shown = [name for name in rows if name != FROZEN]
    for camera in range(len(rows[REFERENCE])):
        clips = [rows[name][camera] for name in shown]
        suffix = f"_{camera}" if len(rows[REFERENCE]) > 1 else ""
        named = [titled(clip, name) for clip, name in zip(clips, shown)]
        write_mp4(log.path(f"previews/side_by_side{suffix}.mp4"), torch.cat(named, 2), fps)
        log.image(f"frames{suffix}", contact_sheet(torch.cat(named, 1), columns=8, count=8))  # one row per video
        log.image(f"slices{suffix}", slices(shown, clips, *busiest(rows[REFERENCE][camera])))
    log.image("bars", bars(scores))


def bars(scores: Scores):
    """A figure: one panel per metric, one bar per video."""
    from matplotlib.figure import Figure

    names = [n for n in columns(scores.values) if any(c.get(n) is not None for c in scores.values.values())]
    figure = Figure(figsize=(2.2 * len(names), 2.8), layout="constrained")
    for i, name in enumerate(names):
        axis = figure.add_subplot(1, len(names), i + 1)
        cells = {row: c.get(name) for row, c in scores.values.items()}
        known = {row: value for row, value in cells.items() if value is not None and math.isfinite(value)}
        axis.bar(range(len(known)), list(known.values()), color=[f"C{list(cells).index(row)}" for row in known])
        axis.set_title(UNITS.get(name, name), fontsize=9)
        axis.set_xticks(range(len(known)), list(known), rotation=60, ha="right", fontsize=8)
    return figure
