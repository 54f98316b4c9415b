"""Figure of a learning: every parameter and the loss against the step, beside the truth where it is known."""

from physics3d.scenes.base import Capture


def curves(capture: Capture, history: dict[str, list[float]]):
    """A figure: every parameter against the step, the truth dashed where it is known, and the loss."""
    from matplotlib.figure import Figure

    names = [name for name in history if name != "gradient"]
    figure = Figure(figsize=(3.2 * max(1, len(names)), 2.8), layout="constrained")
    for i, name in enumerate(names):
        axis = figure.add_subplot(1, len(names), i + 1)
        axis.plot(history[name], lw=1.5)
        if name in capture.truth:
            axis.axhline(capture.truth[name], ls="--", color="0.4", label="truth")
            axis.legend(frameon=False)
        if max(history[name]) > 5 * min(history[name]) > 0:
            axis.set_yscale("log")
        axis.set(title=name, xlabel="step")
    return figure
