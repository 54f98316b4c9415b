"""Recorded motions of unknown cause -> what comes next, beside what pictures say without physics.

Of the take that was learned from the second half is foretold, of the others all that follows their first half second
from the release on, in which only their start is sought. The prediction is by the modes of the body as the first take
shows them (`learning/identify.py`), and of the first take also by what a quarter and a half of what was seen of it
tell, so that one sees what a longer clip is worth; beside it stand still pictures, the image modes of what was seen,
what was seen played again, which no motion that is fitted to it without physics can better, and the motion of the
learned material alone, and of the material before it was learned, in modes that nothing has corrected.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from torch import Tensor

from physics3d.checks import Duration, require_fields
from physics3d.filling.body import Body
from physics3d.gaussians.model import Gaussians
from physics3d.learning.foretold import Moving, foretold, has_stopped
from physics3d.learning.free_body import material_of
from physics3d.learning.free_motion import Material, start
from physics3d.learning.identify import Swing
from physics3d.learning.unknown_cause import (
    LEAST,
    Seen,
    Swung,
    by_its_own_camera,
    first_take,
    frames_seen,
    other_take,
    swung,
)
from physics3d.log import Log
from physics3d.metrics.against import Lines, Reference
from physics3d.metrics.scores import REFERENCE, Scores
from physics3d.metrics.take_page import take_page
from physics3d.motion.carry import moved
from physics3d.motion.image_modes import image_modes
from physics3d.motion.stills import stills
from physics3d.scenes.base import Capture, Take
from physics3d.world import Estimate, World

SEEN, LEARNED, START, IMAGE = "modes as seen", "learned material", "material before", "image modes"
AGAIN = "what was seen, again"
SHORTER = (0.25, 0.5)  # of what is seen of the first take from the release on


@dataclass(frozen=True, kw_only=True)
class Foretell:
    """Foretells every take and scores it."""

    world: World
    told: Duration = 0.5  # of other takes, from the release on [s]
    zones: Annotated[int, Ge(1), Le(16)] = 4  # of stiffness, as in Learn

    def __call__(self, capture: Capture, gaussians: Gaussians, body: Body, estimate: Estimate, *, log: Log) -> Scores:
        """Rows are "take: prediction". Raises ValueError as `swung` does."""
        require_fields(self, "foretell")
        ready = swung(self.world, capture, gaussians, body, zones=self.zones, log=log)
        first = first_take(ready, log)
        learned = material_of(self.world, estimate, ready.reduced.zone)
        before = material_of(self.world, self.world.estimate(), ready.reduced.zone)
        take, swing, release, reference = ready.take, first.swing, first.release, first.reference
        scores: dict[str, dict[str, float | None]] = {}
        notes: dict[str, str] = {}
        seen = frames_seen(take)
        for j in range(len(swing.modes.frequency)):
            log.metric(f"frequency_{j}", float(swing.modes.frequency[j]))
            log.metric(f"damping_{j}", float(swing.modes.damping[j]))
        motions: dict[str, Moving] = {SEEN: swing}
        for name, material in ((LEARNED, learned), (START, before)):
            motions[name] = start(ready.reduced, material, first.window, reference=reference, large=swing.large)[0]
        pose = {name: None if reference is None else motion.at(reference) for name, motion in motions.items()}
        if has_stopped(ready.sight, swing, first.flow, first.weight, fps=take.fps, release=release):
            motions[SEEN] = _stopped(swing, take, notes, log)
        less = self.shorter(ready, release, log)
        scores |= self.judged(ready, take, motions, first.flow, less, release=release, seen=seen, notes=notes, log=log)
        for other in capture.takes:
            if other is not take:
                own = ready if other.posed is None else by_its_own_camera(ready, capture, other, gaussians, body, log)
                scores |= self.other(own, other, swing, {LEARNED: learned, START: before}, pose, notes, log)
        table = Scores(values=scores, notes=notes)
        table.check()
        for row, cells in scores.items():
            for measure, value in cells.items():
                if value is not None and math.isfinite(value):
                    log.metric(f"{row}/{measure}", value)
        if log.folder is not None:
            log.path("scores.md").write_text(table.markdown() + "\n")
        return table

    def other(
        self,
        ready: Swung,
        take: Take,
        first: Swing,
        materials: dict[str, Material],
        pose: dict[str, np.ndarray | None],
        notes: dict[str, str],
        log: Log,
    ) -> dict[str, dict[str, float | None]]:
        """A take that was not learned from: its start alone is sought, in what is told of it."""
        frames, release = take.videos[0], take.release
        seen = min(release + max(4, round(self.told * take.fps)), len(frames) - 8)
        if seen - release < 4:
            notes[take.name] = f"{len(frames)} frames, free from {release} on, are too few to be foretold"
            return {}
        known = {name: None if take.at_rest else place for name, place in pose.items()}
        told = other_take(ready, take, first.modes, known[SEEN], release=release, seen=seen)
        swing = told.swing
        if has_stopped(ready.sight, swing, told.flow, told.weight, fps=take.fps, release=release):
            swing = _stopped(swing, take, notes, log)
        motions: dict[str, Moving] = {SEEN: swing}
        for name, material in materials.items():
            motions[name] = start(ready.reduced, material, told.window, known=known[name], large=swing.large)[0]
        return self.judged(ready, take, motions, told.flow, [], release=release, seen=seen, notes=notes, log=log)

    def shorter(self, ready: Swung, release: int, log: Log) -> list[Seen]:
        """What shares of the frames seen of the first take tell, those that tell of a swing."""
        found: list[Seen] = []
        for share in log.progress(list(SHORTER), "looking at less of the clip"):
            count = release + round(share * (frames_seen(ready.take) - release))
            told = f"the first {(count - release) / ready.take.fps:.2g} s of the motion"
            if count - release < LEAST:
                log.info(f"{told} are {count - release} frames: too few to foretell by")
                continue
            try:
                found.append(first_take(replace(ready, take=replace(ready.take, seen=count)), log.hushed()))
            except ValueError as why:
                log.info(f"{told} do not foretell it: {why}")
        return found

    def judged(
        self,
        ready: Swung,
        take: Take,
        motions: dict[str, Moving],
        flow: np.ndarray,
        less: list[Seen],
        *,
        release: int,
        seen: int,
        notes: dict[str, str],
        log: Log,
    ) -> dict[str, dict[str, float | None]]:
        """Measures and the page of what follows frame `seen` - 1; `flow` of the frames up to it. `less`: what shorter
        looks tell of the same frames."""
        frames, fps = take.videos[0], take.fps
        future = frames[seen:]
        times = (np.arange(release, len(frames)) - release) / fps
        at, times = times[: seen - release], times[seen - release :]
        swing = motions[SEEN]
        assert isinstance(swing, Swing)
        clips: dict[str, Tensor] = {
            name: foretold(frames[release:seen], ready.sight, motion, flow[release:], at=at, times=times)
            for name, motion in motions.items()
        }
        clips[IMAGE] = image_modes(frames[:seen], fps).frames(range(seen, len(frames)))
        clips[AGAIN] = frames[release + np.arange(len(future)) % (seen - release)]
        clips |= stills(frames, seen=seen)
        length = {SEEN: {len(at) / fps: SEEN}, IMAGE: {len(at) / fps: IMAGE}}  # s that were seen -> what it foretells
        for look in less:
            count, after = len(look.flow), (np.arange(len(frames)) - look.release) / fps
            few, seconds = frames[look.release : count], (count - release) / fps
            mine = foretold(
                few,
                ready.sight,
                look.swing,
                look.flow[look.release :],
                at=after[look.release : count],
                times=after[seen:],
            )
            images = image_modes(frames[:count], fps).frames(range(seen, len(frames)))
            for name, clip in ((SEEN, mine), (IMAGE, images)):
                length[name][seconds] = f"{name}, of {seconds:.2g} s"
                clips[length[name][seconds]] = clip
        measured = Reference(future, fps, thing=moved(ready.sight.thing, flow[-1]))
        found = {REFERENCE: _plain(measured.itself()[0], take.name, notes)}
        lines: dict[str, Lines] = {}
        for name, clip in log.progress(list(clips.items()), f"scoring {take.name}"):
            cells, lines[name], _ = measured.measure(clip)
            found[name] = _plain(cells, take.name, notes)
        said = [_swings(swing)] + [
            f"{about}: {why}" for about, why in notes.items() if about.startswith(f"{take.name}: ")
        ]
        by_length: dict[str, dict[float, float]] = {
            name: {seconds: float(found[row]["psnr"] or math.nan) for seconds, row in sorted(rows.items())}
            for name, rows in length.items()
            if less
        }
        of_less = {row for rows in length.values() for row in rows.values()} - length.keys()
        lines = {name: line for name, line in lines.items() if name not in of_less}  # few enough to tell apart
        take_page(
            take.name, frames, fps, clips, found, lines,
            by_length=by_length, seen=seen, said=said, best=SEEN, bar=IMAGE, log=log,
        )  # fmt: skip
        return {f"{take.name}: {name}": cells for name, cells in found.items()}


def _stopped(swing: Swing, take: Take, notes: dict[str, str], log: Log) -> Swing:
    why = "the thing has come to rest in what was seen: the last frame of it is foretold"
    notes[f"{take.name}: {SEEN}"] = why
    log.info(f"{take.name}: {why}")
    return swing.stopped()


def _swings(swing: Swing) -> str:
    pairs = sorted(zip(swing.modes.frequency, swing.modes.damping))
    return "modes as the first take shows them: " + ", ".join(f"{f:.3g} Hz (damping {d:.2g} 1/s)" for f, d in pairs)


def _plain(cells, name: str, notes: dict[str, str]) -> dict[str, float | None]:
    for measure, (_, why) in cells.items():
        if why:
            notes.setdefault(f"{name}: {measure}", why)
    return {measure: value for measure, (value, _) in cells.items()}
