"""Videos + reference -> scores, beside the two baselines that keep everyone honest: a frozen picture, the unlearned
material."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.log import Log
from physics3d.metrics.against import Reference
from physics3d.metrics.pictures import busiest, slices
from physics3d.metrics.scores import Scores
from physics3d.scenes.base import Capture, Take
from physics3d.video import Video, contact_sheet, reduced, write_mp4
from physics3d.world import Estimate
from stages.simulate import excited

FROZEN, REFERENCE = "frozen first frame", "reference"
DIFFERENT = "the simulated excitation is not the one that was filmed: only the eye may compare"


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Scores videos against the take with role "evaluate", or against the held-out cameras of the one learned from."""

    excitation: tuple[AbstractBoundary, ...] | None = None  # what was simulated; None: what the take was excited by
    force: Mapping[str, float] | None = None  # of its impulses, as in Simulate [N]

    def __call__(
        self, capture: Capture, videos: dict[str, Video], estimates: dict[str, Estimate], *, log: Log
    ) -> Scores:
        """`videos`: name (learned, initial, ...) -> video, seen by the cameras to evaluate; `estimates` likewise.

        Raises ValueError if there is no reference, or videos and reference do not show the same cameras and instants.
        """
        take = capture.take("evaluate") or capture.take("learn")
        if take is None or not videos:
            raise ValueError(
                f"capture {capture.name} has {len(capture.takes)} takes and {len(videos)} videos; nothing to evaluate"
            )
        cameras = take.held_out_cameras or tuple(range(len(take.cameras)))
        comparable = self.excitation is None or same(excited(self.excitation, self.force), take.excitation)
        notes = {} if comparable else {"comparison": DIFFERENT}
        if capture.take("evaluate") is None and not take.held_out_cameras:
            notes["reference"] = "no take and no camera is held out: these are the frames that were learned from"
        clips = {name: matched(name, video, take, cameras) for name, video in videos.items()}
        count = min(len(clip) for row in clips.values() for clip in row)
        clips = {name: [clip[:count] for clip in row] for name, row in clips.items()}
        size = next(iter(clips.values()))[0].shape[1:3]
        references = [shrink(take.videos[i], clips, k, count) for k, i in enumerate(cameras)]
        rows = {REFERENCE: references, FROZEN: [r[:1].expand_as(r).contiguous() for r in references], **clips}
        log.info(
            f"{count} frames, {len(cameras)} camera(s), {size[1]} x {size[0]} px, against take {take.name}"
            + ("" if comparable else " (not comparable)")
        )
        values = self.measure(rows, take.fps, notes, log)
        parameters = parameter_errors(estimates, capture.truth)
        if capture.truth_source and parameters:
            notes["truth"] = capture.truth_source
        scores = Scores(values=values, parameters=parameters, notes=notes, comparable=comparable)
        scores.check()
        for table in (scores.values, scores.parameters):
            for row, cells in table.items():
                for name, value in cells.items():
                    if value is not None and math.isfinite(value):
                        log.metric(f"{row}/{name}", value)
        if log.folder is not None:
            previews(rows, take.fps, scores, log)
            log.path("scores.md").write_text(scores.markdown() + "\n")
        return scores

    def measure(
        self, rows: dict[str, list[Tensor]], fps: float, notes: dict[str, str], log: Log
    ) -> dict[str, dict[str, float | None]]:
        """Every row against the reference: means over cameras."""
        references = [Reference(clip, fps) for clip in rows[REFERENCE]]
        table: dict[str, dict[str, float | None]] = {}
        for row, clips in log.progress(list(rows.items()), "scoring"):
            per_camera = []
            for clip, reference in zip(clips, references):
                cells, why = reference.itself() if row == REFERENCE else reference.measure(clip)
                if why:
                    notes.setdefault(f"oscillation of {row}", why)
                per_camera.append(cells)
            table[row] = {}
            for name in per_camera[0]:
                known = [cells[name][0] for cells in per_camera if cells[name][0] is not None]
                table[row][name] = float(np.mean(known)) if known else None  # type: ignore[arg-type]
                for reason in {cells[name][1] for cells in per_camera} - {""}:
                    notes.setdefault(name, reason)
        return table


def same(simulated: tuple[AbstractBoundary, ...], filmed: tuple[AbstractBoundary, ...] | None) -> bool:
    """Whether both were set in motion alike, to a thousandth of every number; an unknown cause is like no other."""
    if filmed is None or [type(b) for b in simulated] != [type(b) for b in filmed]:
        return False
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for a, b in zip(simulated, filmed) for f in fields(a)]
    words = (str, type(None))
    return all(
        a == b if isinstance(a, words) or isinstance(b, words) else np.allclose(a, b, rtol=1e-3) for a, b in pairs
    )


def matched(name: str, video: Video, take: Take, cameras: tuple[int, ...]) -> list[Tensor]:
    """The clips of `video` in the order of `cameras`. Raises ValueError if they cannot be those of the take."""
    video.check()
    if len(video.frames) == len(cameras):
        clips = list(video.frames)
    elif len(video.frames) == len(take.cameras):
        clips = [video.frames[i] for i in cameras]
    else:
        raise ValueError(
            f"video {name} has {len(video.frames)} cameras, take {take.name} {len(take.cameras)} of which "
            f"{len(cameras)} are to be evaluated; render those cameras"
        )
    if abs(video.fps / take.fps - 1) > 0.01:
        raise ValueError(
            f"video {name} has {video.fps:g} frames per second, take {take.name} {take.fps:g}; "
            "set simulate.fps to the take's"
        )
    return clips


def shrink(reference: Tensor, clips: dict[str, list[Tensor]], index: int, count: int) -> Tensor:
    """The reference at the size of the clips, averaged over pixels; ValueError if their shapes disagree."""
    sizes = {tuple(row[index].shape[1:3]) for row in clips.values()}
    (h, w), own = next(iter(sizes)), tuple(reference.shape[1:3])
    if len(sizes) > 1 or h > own[0] or w > own[1] or abs(h * own[1] / (w * own[0]) - 1) > 0.02:
        raise ValueError(
            f"videos of {[f'{w} x {h}' for h, w in sizes]} px cannot be compared with a reference of {own[1]} x "
            f"{own[0]} px; render all at one scale <= 1 with the reference's camera"
        )
    return reduced(reference[:count], h, w)


def parameter_errors(estimates: dict[str, Estimate], truth: dict[str, float]) -> dict[str, dict[str, float | None]]:
    """ "learned: youngs_modulus" -> value, truth, error [%], ln(value/truth); means over particles of a field."""
    table: dict[str, dict[str, float | None]] = {}
    for parameter, true in truth.items():
        for row, estimate in estimates.items():
            if parameter in estimate.parameters:
                value = float(torch.as_tensor(estimate.parameters[parameter]).double().mean())
                positive = value > 0 and true > 0
                table[f"{row}: {parameter}"] = {
                    "value": value,
                    "truth": float(true),
                    "error_percent": 100 * (value - true) / abs(true) if true else None,
                    "log_ratio": math.log(value / true) if positive else None,
                }
    return table


def previews(rows: dict[str, list[Tensor]], fps: float, scores: Scores, log: Log) -> None:
    """What one looks at: films side by side, sheets of frames, space-time slices, bars."""
    shown = [name for name in rows if name != FROZEN]
    for camera in range(len(rows[REFERENCE])):
        clips = [rows[name][camera] for name in shown]
        suffix = f"_{camera}" if len(rows[REFERENCE]) > 1 else ""
        write_mp4(log.path(f"previews/side_by_side{suffix}.mp4"), torch.cat(clips, 2), fps)
        log.image(f"frames{suffix}", contact_sheet(torch.cat(clips, 1), columns=8, count=8))  # one row per video
        log.image(f"slices{suffix}", slices(shown, clips, *busiest(rows[REFERENCE][camera])))
    log.image("bars", bars(scores))


def bars(scores: Scores):
    """A figure: one panel per metric, one bar per video."""
    from matplotlib.figure import Figure

    from physics3d.metrics.scores import UNITS, columns

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
