"""What distillation from the small video model finds, where the answer is known: rows of the laboratory of priors.

    python benchmarks/priors_tiny.py [weights=folder] [sections=landscape,gradient,distil,must,plain] [twins=3]
                                     [draws=8] [steps=60] [estimator=stratified] [range=0]

The model was trained on films of stems whose ln E is normal around ln MODE (`physics3d/scenes/stems.py`), so that is
where E has to be pulled, from wherever it starts. Twins are of forms that it has not seen. theta = ln(E/MODE).

    landscape   the denoising loss of the clip of theta, the same noise for all theta: is there one valley, and where
    gradient    dL/dtheta of single draws by every estimator and range of noise: its mean (does it point to 0, from
                how far), where it vanishes (bias), its deviation there in units of theta, seconds for a draw
    distil      Adam down that gradient from a factor 4 above and below, through modes, renderer and model
    must        the same by one estimator on all twins, moved by the project's own solver with large rotations, after
                a search over five factors by the denoising loss, as learning does it; plain: without the search

Writes docs/results/priors_tiny.csv and .png, and prints the rows.
"""

import csv
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physics3d.log import Log
from physics3d.modes.rollout import Solver
from physics3d.priors.base import AbstractPrior
from physics3d.priors.distillation import denoising_loss, distillation_loss, still_code
from physics3d.priors.estimators.base import AbstractEstimator
from physics3d.priors.estimators.moving_minus_still import MovingMinusStill
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.priors.estimators.stratified import Stratified
from physics3d.priors.tiny_video import TinyVideo
from physics3d.scenes.stems import FPS, FRAMES, MODE, SPEED, Look, Poke, Stem, Swaying, film

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
UNSEEN = 20_000  # number of the first form: training takes 0, 1, ..., its own check 10000, ...
SEED = 0
FAR = math.log(4.0)
SPAN = 5.0  # of the search: factors of a half to 2 from a start that is 4 off would land on the answer
GRID = np.linspace(-1.75, 1.75, 29)
STEP = 0.02  # of the central differences of a clip
RANGES = ((1.0, 5.0), (3.0, 30.0), (10.0, 60.0))  # of sigma/alpha
ESTIMATORS: dict[str, AbstractEstimator] = {
    "sds": ScoreDistillation(),
    "moving_minus_still": MovingMinusStill(),
    "stratified": Stratified(of=ScoreDistillation(), levels=4),
    "stratified_difference": Stratified(of=MovingMinusStill(), levels=4),
}
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Twin:
    """A stem that the model has not seen, and its usual poke, in the plane of the picture or nearly."""

    name: str
    stem: Stem
    poke: Poke
    look: Look
    swaying: Swaying

    @classmethod
    def number(cls, k: int) -> "Twin":
        rng = np.random.default_rng((SEED, UNSEEN + k))
        form = Stem.draw_form(rng)
        stem, look = form.draw_size(rng), Look.draw(rng)
        # the side is drawn; the strength is the median
        poke = replace(Poke.draw(rng), speed=SPEED)
        return cls(name=f"twin {k}", stem=stem, poke=poke, look=look, swaying=Swaying.of(form, log=Log(None)))

    def clip(self, theta: float | torch.Tensor) -> torch.Tensor:
        """[t, h, w, 3], differentiable in theta, by the closed form that made the films of the training."""
        modulus = MODE * torch.exp(torch.as_tensor(theta, dtype=torch.float64))
        return film(self.stem, self.look, *self.swaying.move(self.stem, self.poke, modulus=modulus))

    def solver(self) -> Solver:
        """The project's own solver of the same body, with large rotations."""
        return Solver.of(
            self.stem.world(),
            self.stem.cubes_at()[0],
            self.stem.volumes(),
            excitation=(self.poke.impulse(self.stem),),
            modes=6,
            points=80,
            log=Log(None),
        )

    def solved(self, solver: Solver, theta: torch.Tensor) -> torch.Tensor:
        """The clip by that solver."""
        start = {name: torch.tensor(value, dtype=torch.float64) for name, value in self.stem.world().start.items()}
        moved = solver.rollout(
            start | {"youngs_modulus": MODE * torch.exp(theta)}, frames=FRAMES, frame_dt=1 / FPS, log=Log(None)
        )
        return film(self.stem, self.look, moved.position.double(), moved.deformation.double())


# a twin and a range of noise -> a prior of that range and what it is told
PriorOf = Callable[[Twin, tuple[float, float]], tuple[AbstractPrior, Any]]


def landscape(twins: list[Twin], draws: int, prior_of: PriorOf) -> list[Row]:
    """The valley of the denoising loss of each twin and range: where it is lowest, and what lies above it."""
    rows, repeats = [], max(1, draws // 8)
    for twin in twins:
        clips = [twin.clip(theta).detach() for theta in GRID]
        for span in RANGES:
            prior, condition = prior_of(twin, span)
            loss = np.zeros(len(GRID))
            for k in range(repeats):
                loss += [
                    denoising_loss(prior, clip, condition, generator=torch.Generator().manual_seed(k)) for clip in clips
                ]
            still = clips[0][:1].expand_as(clips[0])
            unmoved = sum(
                denoising_loss(prior, still, condition, generator=torch.Generator().manual_seed(k))
                for k in range(repeats)
            )
            best = int(loss.argmin())
            rows.append(
                dict(
                    section="landscape",
                    twin=twin.name,
                    range=f"{span[0]:g}-{span[1]:g}",
                    lowest=lowest(GRID, loss),
                    valleys=int(((np.diff(loss)[:-1] < 0) & (np.diff(loss)[1:] > 0)).sum()),
                    rise_below=over(loss[0], loss[best]),
                    rise_above=over(loss[-1], loss[best]),
                    still=over(unmoved, loss[best]),
                    curve=loss.tolist(),
                )
            )
    return rows


def gradients(twins: list[Twin], draws: int, prior_of: PriorOf) -> Iterator[Row]:
    """dL/dtheta of single draws along the grid: mean, zero, spread, time."""
    for twin in twins:
        prior, _ = prior_of(twin, RANGES[0])
        code = lambda theta, twin=twin, prior=prior: prior.encode(twin.clip(theta).detach())
        at = GRID[::2]
        z = [code(theta) for theta in at]
        slope = [(code(theta + STEP) - code(theta - STEP)) / (2 * STEP) for theta in at]
        s0 = still_code(prior, twin.clip(0.0).detach())
        for span in RANGES:
            prior, condition = prior_of(twin, span)
            for name, estimator in ESTIMATORS.items():
                # a stratified draw is eight: as much work for each
                count = draws if name in ("sds", "moving_minus_still") else max(3, draws // 8)
                begin, found = time.process_time(), np.zeros((count, len(at)))
                for k in range(count):
                    for i in range(len(at)):
                        with torch.no_grad():
                            targets = estimator.targets(
                                prior, z[i], lambda s0=s0: s0, condition, torch.Generator().manual_seed(k)
                            )
                        pulls = [t.weight * float(((z[i] - t.code) * slope[i]).sum()) for t in targets]
                        found[k, i] = sum(pulls) / len(pulls)
                seconds = (time.process_time() - begin) / (count * len(at))
                yield dict(
                    section="gradient",
                    twin=twin.name,
                    range=f"{span[0]:g}-{span[1]:g}",
                    estimator=name,
                    draws=count,
                    seconds=seconds,
                    **read_gradient(at, found),
                )


def tiny(weights: str | None) -> PriorOf:
    """The small video model, told the first picture of the twin."""

    def prior_of(twin: Twin, span: tuple[float, float]) -> tuple[AbstractPrior, Any]:
        prior = TinyVideo(weights=weights, ratio=span)
        return prior, prior.condition(twin.clip(0.0).detach()[0], ())

    return prior_of


def read_gradient(theta: np.ndarray, found: np.ndarray) -> Row:
    """Of gradients [draws, theta]: the zero nearest to 0 that descent goes to, and how well single draws see it."""
    mean, deviation = found.mean(0), found.std(0, ddof=1)
    zeros = crossings(theta, mean)
    middle = int(np.abs(theta).argmin())
    row = dict(
        mean_low=float(mean[int(np.abs(theta + FAR).argmin())]),
        mean_mode=float(mean[middle]),
        mean_high=float(mean[int(np.abs(theta - FAR).argmin())]),
        deviation_mode=float(deviation[middle]),
        zeros=len(zeros),
        curve=mean.tolist(),
    )
    if not zeros:
        return row | dict(bias=math.nan, spread=math.nan, low=math.nan, high=math.nan)
    bias, slope = min(zeros, key=lambda zero: abs(zero[0]))
    first_above = int(np.searchsorted(theta, bias))
    # the basin: as far as the mean gradient keeps its sign on either side
    low, high = first_above - 1, first_above
    while low > 0 and mean[low - 1] < 0:
        low -= 1
    while high < len(theta) - 1 and mean[high + 1] > 0:
        high += 1
    spread = deviation[middle] / slope  # of theta, by one draw
    return row | dict(bias=float(bias), spread=float(spread), low=float(theta[low]), high=float(theta[high]))


def crossings(theta: np.ndarray, mean: np.ndarray) -> list[tuple[float, float]]:
    """(place, slope) of every zero that descent goes to: a mean gradient that is negative on its left and positive on
    its right. That of an exact denoiser may vanish on the grid itself, there and on no other place."""
    found = []
    for left, right in pairwise(np.flatnonzero(mean)):
        if not mean[left] < 0 < mean[right]:
            continue
        slope = (mean[right] - mean[left]) / (theta[right] - theta[left])
        on_grid = theta[left + 1 : right]
        place = on_grid.mean() if len(on_grid) else theta[left] - mean[left] / slope
        found.append((float(place), float(slope)))
    return found


def distil(
    twins: list[Twin],
    steps: int,
    prior_of: PriorOf,
    *,
    chosen: list[tuple[str, tuple[float, float]]],
    by: str,
    searched: bool = False,
) -> Iterator[Row]:
    """Adam from a factor 4 above and below; `by` is "closed form" or "solver". With `searched` it begins, as learning
    does, at the best of a few factors on the start, by the denoising loss."""
    for name, span in chosen:
        for twin in twins:
            prior, condition = prior_of(twin, span)
            solver = twin.solver() if by == "solver" else None
            for start in (-FAR, FAR):
                begin = time.monotonic(), time.process_time()
                first = search(prior, condition, twin, solver, start) if searched else start
                course = descend(prior, condition, ESTIMATORS[name], twin, solver, first, steps)
                theta = float(np.mean(course[-max(1, steps // 4) :]))
                yield dict(
                    section="distil",
                    by=f"{by}, after a search" if searched else by,
                    twin=twin.name,
                    range=f"{span[0]:g}-{span[1]:g}",
                    estimator=name,
                    start=math.exp(start),
                    found=math.exp(theta),
                    bias=theta,
                    spread=float(np.std(course[-max(1, steps // 4) :])),
                    seconds=time.monotonic() - begin[0],
                    processor_seconds=time.process_time() - begin[1],
                    curve=course,
                )


def search(prior: AbstractPrior, condition: Any, twin: Twin, solver: Solver | None, start: float) -> float:
    """The best of five factors from 1/SPAN to SPAN on the start, all with the same noise."""
    found = {}
    for theta in start + np.linspace(-math.log(SPAN), math.log(SPAN), 5):
        here = torch.tensor(theta, dtype=torch.float64)
        with torch.no_grad():
            clip = twin.clip(here) if solver is None else twin.solved(solver, here)
        found[float(theta)] = denoising_loss(prior, clip, condition, generator=torch.Generator().manual_seed(SEED))
    return min(found, key=lambda theta: found[theta])


def descend(
    prior: AbstractPrior,
    condition: Any,
    estimator: AbstractEstimator,
    twin: Twin,
    solver: Solver | None,
    start: float,
    steps: int,
) -> list[float]:
    """theta at every step."""
    theta = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([theta], lr=0.15, betas=(0.8, 0.95))
    generator = torch.Generator().manual_seed(SEED)
    course = []
    for step in range(steps):
        adam.param_groups[0]["lr"] = 0.15 * (0.55 + 0.45 * math.cos(math.pi * step / steps))
        clip = twin.clip(theta) if solver is None else twin.solved(solver, theta)
        adam.zero_grad()
        distillation_loss(prior, estimator, clip, condition, generator=generator).backward()
        adam.step()
        with torch.no_grad():
            theta.clamp_(-3.0, 3.0)
        course.append(float(theta.detach()))
    return course


def over(loss: float, best: float) -> float:
    """So many times the best, which an exact denoiser may bring to 0."""
    return float(loss / best) if best > 0 else math.inf


def lowest(x: np.ndarray, y: np.ndarray) -> float:
    """Of the parabola through the lowest value and its neighbours."""
    i = min(max(int(y.argmin()), 1), len(x) - 2)
    below, here, above = y[i - 1 : i + 2]
    return float(x[i] + 0.5 * (x[1] - x[0]) * (below - above) / max(below - 2 * here + above, 1e-30))


def draw_rows(rows: list[Row], path: Path) -> None:
    """Landscapes, mean gradients and courses of the first twin."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    first = next((row["twin"] for row in rows), None)
    for row in rows:
        if row["twin"] != first:
            continue
        curve = np.array(row["curve"])
        if row["section"] == "landscape":
            axes[0].plot(GRID, curve / curve.min(), label=f"sigma/alpha {row['range']}")
        elif row["section"] == "gradient" and row["range"] == "3-30":
            axes[1].plot(GRID[::2], curve / np.abs(curve).max(), label=row["estimator"])
        elif row["section"] == "distil":
            axes[2].plot(curve, label=f"{row['estimator']} {row['range']}" if row["start"] > 1 else None, lw=1)
    titles = ("denoising loss / lowest", "mean gradient / largest", "theta at each step")
    for axis, title in zip(axes, titles):
        axis.set(title=title)
        axis.axvline(0, color="0.7", lw=0.8) if axis is not axes[2] else axis.axhline(0, color="0.7", lw=0.8)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(frameon=False, fontsize="small")
    axes[0].set(xlabel="theta = ln(E/mode)", yscale="log")
    axes[1].set(xlabel="theta = ln(E/mode)")
    axes[1].axhline(0, color="0.7", lw=0.8)
    axes[2].set(xlabel="step")
    figure.savefig(path, dpi=110)


def rows_of(options: dict[str, str]) -> list[Row]:
    """All rows that were asked for; printed as they come."""
    weights, draws = options.get("weights"), int(options.get("draws", 8))
    twins = [Twin.number(k) for k in range(int(options.get("twins", 3)))]
    sections = options.get("sections", "landscape,gradient,distil,must,plain").split(",")
    steps = int(options.get("steps", 60))
    best = (options.get("estimator", "stratified"), RANGES[int(options.get("range", 0))])
    rows: list[Row] = []

    def told(found: Any) -> None:
        for row in found:
            print({k: (round(v, 3) if isinstance(v, float) else v) for k, v in row.items() if k != "curve"}, flush=True)
            rows.append(row)

    prior_of = tiny(weights)
    if "landscape" in sections:
        told(landscape(twins, draws, prior_of))
    if "gradient" in sections:
        told(gradients(twins, draws, prior_of))
    if "distil" in sections:
        every = [(name, RANGES[1]) for name in ESTIMATORS]
        told(distil(twins[:1], steps, prior_of, chosen=every, by="closed form"))
    if "must" in sections:
        told(distil(twins, steps, prior_of, chosen=[best], by="solver", searched=True))
    if "plain" in sections:
        told(distil(twins, steps, prior_of, chosen=[best], by="solver"))
    return rows


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    torch.set_num_threads(1)
    rows = rows_of(options)
    RESULTS.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "curve"))
    with (RESULTS / "priors_tiny.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, columns, extrasaction="ignore", restval="")
        table.writeheader()
        table.writerows(rows)
    draw_rows(rows, RESULTS / "priors_tiny.png")


if __name__ == "__main__":
    main(sys.argv[1:])
