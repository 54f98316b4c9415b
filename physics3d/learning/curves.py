"""Figure of a learning, from the first trial to the result: every parameter and the loss against the step."""

from typing import Any

from physics3d.learning.course import WAYS
from physics3d.scenes.base import Capture
from physics3d.truth import truth_of
from physics3d.world import Estimate

GAIN = 5.0  # a curve that spans more than this factor, with its interval, is drawn in the logarithm


def curves(capture: Capture, learned: Estimate):
    """Trials of the search as dots, descent and polish as lines, the result with its interval, and the truth dashed
    where it is known."""
    from matplotlib.figure import Figure

    history = learned.history
    names = [name for name in history if name != "way"]
    figure = Figure(figsize=(3.2 * max(1, len(names)), 2.8), layout="constrained")
    for i, name in enumerate(names):
        axis = figure.add_subplot(1, len(names), i + 1)
        for number, way in enumerate(WAYS):
            steps = [step for step, which in enumerate(history["way"]) if which == number]
            style: dict[str, Any] = (
                dict(ls="", marker=".") if way == "search" else dict(lw=1.5, marker="." if len(steps) == 1 else "")
            )
            if steps:
                axis.plot(steps, [history[name][step] for step in steps], label=way, **style)
        last, drawn = len(history["way"]) - 1, list(history[name])
        if name in learned.intervals:
            found = learned.intervals[name]
            drawn += [found.low, found.high]
            axis.vlines(last, found.low, found.high, color="0.2", lw=1.0, label="90 %")
        axis.plot(last, history[name][-1], "o", color="0.2", ms=4)
        true = truth_of(name, capture.truth)
        if true is not None:
            axis.axhline(true, ls="--", color="0.4", label="truth")
        if i == 0 or true is not None:
            axis.legend(frameon=False, fontsize="small")
        if max(drawn) > GAIN * min(drawn) > 0:
            axis.set_yscale("log")
        axis.set(title=name, xlabel="step")
    return figure
