"""Videos + reference -> scores, beside the two baselines that keep everyone honest: a frozen picture, the unlearned
material."""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Force, excited
from physics3d.log import Log
from physics3d.metrics.against import Reference
from physics3d.metrics.comparable import matched, same, shrink
from physics3d.metrics.parameters import parameter_errors
from physics3d.metrics.previews import previews
from physics3d.metrics.scores import FROZEN, REFERENCE, Scores
from physics3d.scenes.base import Capture
from physics3d.video import Video
from physics3d.world import Estimate

DIFFERENT = "the simulated excitation is not the one that was filmed: only the eye may compare"


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Scores videos against the take with role "evaluate", or against the held-out cameras of the one learned from."""

    excitation: tuple[AbstractBoundary, ...] | None = None  # what was simulated; None: what the take was excited by
    force: Force | None = None  # of its impulses, as in Simulate [N]

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
                if row == REFERENCE:
                    cells, why = reference.itself()
                else:
                    cells, _, why = reference.measure(clip)
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
