"""Figure of a filling: three cuts through the middle of the body, Gaussians under its particles, and where it ends by
guess, for no photograph shows that surface."""

import torch

from physics3d.filling.body import Body
from physics3d.gaussians.model import Gaussians


def slices(gaussians: Gaussians, label: torch.Tensor, body: Body):
    """Figure: three cuts two spacings thick through the middle of the body; Gaussians under its particles."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 5))
    middle = (body.position.amin(0) + body.position.amax(0)) / 2
    mean = gaussians.mean[label > 0]
    for k, panel in enumerate(figure.subplots(1, 3)):
        a, b = [i for i in range(3) if i != k]
        near = (mean[:, k] - middle[k]).abs() < body.spacing
        panel.scatter(mean[near, a], mean[near, b], s=2, color="0.7", label="Gaussians")
        near = (body.position[:, k] - middle[k]).abs() < body.spacing
        held = body.attached if body.attached is not None else torch.zeros_like(body.interior)
        for chosen, name, colour in (
            (body.interior & ~held, "interior", "tab:orange"),
            (~body.interior & ~held, "surface", "tab:blue"),
            (held, "held: touches what is static", "tab:red"),
        ):
            at = body.position[near & chosen]
            if len(at) or chosen is not held:
                panel.scatter(at[:, a], at[:, b], s=8, color=colour, label=name)
        if body.doubt is not None:
            guessed = body.doubt.position[~body.doubt.shown]
            at = guessed[(guessed[:, k] - middle[k]).abs() < body.spacing]
            if len(at):
                panel.scatter(at[:, a], at[:, b], s=14, marker="x", color="black", label="no photograph shows it")
        panel.set_aspect("equal")
        panel.set_xlim(body.position[:, a].min() - 2 * body.spacing, body.position[:, a].max() + 2 * body.spacing)
        panel.set_ylim(body.position[:, b].min() - 2 * body.spacing, body.position[:, b].max() + 2 * body.spacing)
        panel.set(title=f"{'xyz'[k]} = {middle[k]:.3f} m", xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
    named = {name: mark for panel in figure.axes for mark, name in zip(*panel.get_legend_handles_labels())}
    figure.axes[0].legend(named.values(), named.keys(), loc="upper left", fontsize=8)
    return figure
