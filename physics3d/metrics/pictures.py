"""Pictures of scores: space-time slices and curves over the frames. All return figures."""

from jaxtyping import UInt8
from torch import Tensor

from physics3d.pictures import space_time_slice


def slices(names: list[str], clips: list[UInt8[Tensor, "t h w 3"]], row: int, column: int, *, mark: int | None = None):
    """One row and one column of pixels of every clip against time; a line where frame `mark` begins."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3 * len(names), 5.2), layout="constrained")
    for i, (name, clip) in enumerate(zip(names, clips)):
        for k, (picture, what) in enumerate(
            (
                (space_time_slice(clip, row=row), f"row {row}: time down"),
                (space_time_slice(clip, column=column), f"column {column}: time right"),
            )
        ):
            axis = figure.add_subplot(2, len(names), 1 + i + k * len(names))
            axis.imshow(picture.numpy(), aspect="auto", interpolation="nearest")
            if mark is not None:
                (axis.axvline if k else axis.axhline)(mark - 0.5, color="red", lw=1)
            axis.set(title=f"{name}\n{what}" if k == 0 else what, xticks=[], yticks=[])
    return figure


def busiest(clip: UInt8[Tensor, "t h w 3"]) -> tuple[int, int]:
    """The row and the column of pixels that change most from the first frame."""
    moved = sum((frame.int() - clip[0].int()).abs().sum(2) for frame in clip)
    return int(moved.sum(1).argmax()), int(moved.sum(0).argmax())


def curves(values: dict[str, dict[str, list[float]]], fps: float, *, first: int):
    """Clip -> (measure -> value per frame): one panel per measure, frames counted from `first`, time in s."""
    from matplotlib.figure import Figure

    measures = next(iter(values.values()))
    figure = Figure(figsize=(5.5 * len(measures), 3.2), layout="constrained")
    for i, measure in enumerate(measures):
        axis = figure.add_subplot(1, len(measures), i + 1)
        for name, lines in values.items():
            line = lines[measure]
            axis.plot([(first + k) / fps for k in range(len(line))], line, lw=1.2, label=name)
        axis.set(xlabel="time [s]", title=measure)
        axis.legend(frameon=False, fontsize=8)
    return figure


def against_length(values: dict[str, dict[float, float]]):
    """Figure: PSNR [dB] of every prediction against the seconds of motion that it is made of."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    axis = figure.add_subplot()
    for name, points in values.items():
        axis.plot(list(points), list(points.values()), "o-", lw=1.2, label=name)
    axis.set(xlabel="of the motion that was seen [s]", ylabel="PSNR of what follows [dB]")
    axis.legend(frameon=False, fontsize=8)
    return figure
