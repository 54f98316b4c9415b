"""Scores of any two videos: make score REAL=clip.mp4 PRED=clip.mp4 [OUT=folder], by way of the environment.

The first half of the real clip counts as seen. On the second, PRED stands beside pictures that do not move, made from
what was seen; the motion is also compared over the whole clip. Table on the terminal; score.md and pictures in OUT, or
in a folder beside PRED. Exit codes: 0 done, 1 the clips cannot be compared, 2 REAL or PRED is not given, 130 Ctrl-C.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.filed import one_line
from pipeline.places import folder_to_fill, place
from pipeline.settings import SettingsError

USAGE = "make score REAL=<clip> PRED=<clip> [OUT=<folder>]: any two videos of one motion, from the same camera"
SHOWN = 8  # frames


def main(environment: Mapping[str, str]) -> int:
    return one_line(lambda: scored(environment), lambda text: print(text, file=sys.stderr), "there is no score.md")


def scored(environment: Mapping[str, str]) -> None:
    """Raises SettingsError for what is not given, else as `score`."""
    real, predicted = place(environment, "REAL"), place(environment, "PRED")
    if real is None or predicted is None:
        raise SettingsError(f"{'REAL' if real is None else 'PRED'} is not given; {USAGE}")
    score(real, predicted, folder_to_fill(environment, predicted.absolute().parent / f"{predicted.stem}_score"))


def score(real: Path, predicted: Path, folder: Path) -> None:
    """Raises ValueError or RuntimeError in one line if the two cannot be compared, or the real one does not move."""
    import torch
    from rich.console import Console

    from physics3d.log import Log
    from physics3d.metrics.against import Reference
    from physics3d.metrics.pair import paired
    from physics3d.metrics.pictures import busiest, curves, slices
    from physics3d.metrics.scores import Scores
    from physics3d.motion.clip import read_clip
    from physics3d.motion.stills import stills
    from physics3d.pictures import contact_sheet, difference, evenly, titled

    pair = paired(read_clip(real), read_clip(predicted))
    whole = Reference(pair.real, pair.fps)
    if whole.where is None:
        raise ValueError(f"{real.name}: nothing moves in it (less than half a pixel); there is no motion to score")
    seen = len(pair.real) // 2
    half = Reference(pair.real[seen:], pair.fps)
    notes = {str(i + 1): note for i, note in enumerate(pair.notes)}
    clips = {"prediction": pair.predicted[seen:], **stills(pair.real, seen=seen)}
    measured = {name: half.measure(clip) for name, clip in clips.items()}
    second = {"real": half.itself()[0]} | {name: cells for name, (cells, _, _) in measured.items()}
    all_of_it = {"real": whole.itself()[0], "prediction": whole.motion(pair.predicted)[0]}
    tables = [
        (title, Scores(values={name: plain(cells, title, notes) for name, cells in rows.items()}))
        for title, rows in (("second half", second), ("motion over the whole clip", all_of_it))
    ]

    log = Log(folder, quiet=True)
    done = log.path("score.md")
    done.unlink(missing_ok=True)  # it is written last: whoever finds it finds everything
    text = [f"# {predicted.name} against {real.name}", ""]
    text += [f"{len(pair.real)} frames at {pair.fps:g} fps, {pair.real.shape[2]} x {pair.real.shape[1]} px; the first"]
    text[-1] += f" {seen} count as seen."
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 160)
    console.print(text[-1], markup=False)
    for title, scores in tables:
        scores.check()
        console.print(f"\n{title}", markup=False)
        console.print(*scores.tables())
        text += ["", f"## {title.capitalize()}", "", scores.markdown()]
    for note in notes.values():
        console.print(note, markup=False)
    text += ["", *(f"- {note}" for note in notes.values())]
    lines = {name: of_frames for name, (_, of_frames, _) in measured.items()}
    log.image("curves", curves(lines, pair.fps, first=seen))
    log.image("slices", slices(["real", "prediction"], [pair.real, pair.predicted], *busiest(pair.real)))
    a, b = evenly(pair.real, SHOWN), evenly(pair.predicted, SHOWN)
    named = {"real": a, "prediction": b, "difference": difference(a, b)}
    strips = [titled(few, name) for name, few in named.items()]
    log.image("frames", contact_sheet(torch.cat(strips, 1), columns=SHOWN, count=SHOWN))
    pictures = (("frames", "real, prediction, difference"), ("curves", "per frame"), ("slices", "space-time slices"))
    text += ["", *(f"![{what}](previews/{name}.png)" for name, what in pictures)]
    done.write_text("\n".join(text) + "\n")
    console.print(f"written   {done} and {folder / 'previews'}", markup=False)


def plain(cells, title: str, notes: dict[str, str]) -> dict[str, float | None]:
    """Numbers alone; why one is missing goes to the notes."""
    for name, (_, why) in cells.items():
        if why:
            notes.setdefault(f"{title} {name}", f"{name} ({title}): {why}")
    return {name: value for name, (value, _) in cells.items()}


if __name__ == "__main__":
    sys.exit(main(os.environ))
