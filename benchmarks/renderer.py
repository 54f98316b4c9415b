"""The renderer: what precision, cutoff and tile size do to error and time, and how cost grows.

    python benchmarks/renderer.py   ->   docs/results/renderer.csv, .png, .md

Error is the relative L2 distance of the picture, and of the gradient with respect to the means, from the float64 torch
twin with a cutoff of 1e-7 instead of 1/255 and blending to the end. Times are medians of wall-clock times, after a
warm-up that compiles; runs that are compared are interleaved.
"""

import csv
import importlib.util
import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from machine import machine

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.rasterize import rasterize
from physics3d.gaussians.splat import Numerics
from physics3d.gaussians.twin import rasterize_plainly
from physics3d.gaussians.with_gsplat import rasterize_with_gsplat

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
SEED = 0
PRECISIONS = ("float32", "float64")
CUTOFFS = (1 / 32, 1 / 255, 1 / 2048, 1e-5)
TILES = (8, 16, 32)
SMALL = (600, 112)  # Gaussians and side [px] that the twin can draw: it holds Gaussians x pixels
HEADLINE = ((50_000, 400, 400), (20_000, 320, 240), (5_000, 320, 240), (500, 320, 240))
COUNTS = (1_000, 4_000, 16_000, 64_000, 256_000)
WIDTHS = (1.0, 2.0, 4.0, 8.0)  # of 16 000 Gaussians, times the narrowest
COLUMNS = (
    "part", "what", "device", "gaussians", "width", "height", "precision", "cutoff", "tile", "touched",
    "forward_ms", "both_ms", "error", "gradient_error",
)  # fmt: skip


def main() -> None:
    torch.set_num_threads(1)
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = accuracy()
    for device in devices:
        rows += [size(device, "headline", *three) for three in HEADLINE]
    rows += [size("cpu", "count", n, 400, 400, width=math.sqrt(16_000 / n)) for n in COUNTS]
    rows += [size("cpu", "width", 16_000, 400, 400, width=width) for width in WIDTHS]
    rows += against("twin", "cpu", *SMALL, rasterize_plainly)
    if "cuda" in devices and importlib.util.find_spec("gsplat"):
        rows += against("gsplat", "cuda", *HEADLINE[0][:2], rasterize_with_gsplat)
    write(rows)


def scene(
    count: int, width: int, height: int, pixels: float, opacity: float = 1.0
) -> tuple[list[torch.Tensor], Camera]:
    """A ball of Gaussians, `pixels` wide (standard deviation), and a camera that sees it all."""
    generator = torch.Generator().manual_seed(SEED)
    rand = partial(torch.rand, generator=generator)
    mean = torch.randn(count, 3, generator=generator) * 0.3
    sigma = 3.0 * pixels / width * (0.5 + rand(count, 3))
    Q = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator)).Q
    covariance = Q @ torch.diag_embed(sigma.square()) @ Q.mT
    pose = look_at(torch.tensor([0.0, -3.0, 0.5]), torch.zeros(3))
    camera = Camera(width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2, world_to_camera=pose)
    return [mean, covariance, opacity * rand(count), rand(count, 3)], camera


def once(
    draw: Callable, arrays: list[torch.Tensor], camera: Camera, backward: bool
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Picture and, if asked, the gradient of its mean square with respect to the means."""
    inputs = [a.detach().requires_grad_(backward) for a in arrays]
    with torch.set_grad_enabled(backward):
        picture = draw(*inputs, camera, background=torch.ones(3).to(inputs[0])).color
    if backward:
        picture.square().mean().backward()
    if picture.is_cuda:
        torch.cuda.synchronize()
    return picture.detach(), inputs[0].grad


def timed(runs: list[Callable], seconds: float) -> list[float]:
    """Median time of each [ms], taken in turn for `seconds`, at least 3 times, after a warm-up."""
    times: list[list[float]] = [[] for _ in runs]
    for run in runs:
        run()
    end = time.perf_counter() + seconds
    while len(times[0]) < 3 or (time.perf_counter() < end and len(times[0]) < 100):
        for run, mine in zip(runs, times, strict=True):
            start = time.perf_counter()
            run()
            mine.append(1e3 * (time.perf_counter() - start))
    return [statistics.median(t) for t in times]


def report(**row) -> dict:
    print({k: (f"{v:.3g}" if isinstance(v, float) else v) for k, v in row.items()}, flush=True)
    return row


def accuracy() -> list[dict]:
    """All combinations, drawn in turn."""
    count, side = SMALL
    arrays, camera = scene(count, side, side, 3.0)
    exact = [a.double() for a in arrays]
    known, known_bar = once(
        partial(rasterize_plainly, numerics=Numerics(cutoff=1e-7, stop=0.0)), exact, camera, backward=True
    )
    choices = [Numerics(precision=p, cutoff=c, tile=t) for p in PRECISIONS for c in CUTOFFS for t in TILES]
    draws = [(partial(rasterize, numerics=n), exact if n.precision == "float64" else arrays) for n in choices]
    forward = timed([partial(once, draw, inputs, camera, False) for draw, inputs in draws], 5.0)
    both = timed([partial(once, draw, inputs, camera, True) for draw, inputs in draws], 8.0)
    distance = lambda a, b: float((a.double() - b).norm() / b.norm())
    rows = []
    for n, (draw, inputs), f, b in zip(choices, draws, forward, both, strict=True):
        picture, bar = once(draw, inputs, camera, True)
        errors = {"error": distance(picture, known), "gradient_error": distance(bar, known_bar)}
        given = {"precision": n.precision, "cutoff": n.cutoff, "tile": n.tile, "forward_ms": f, "both_ms": b}
        rows.append(report(part="accuracy", device="cpu", gaussians=count, width=side, height=side, **given, **errors))
    return rows


def size(device: str, part: str, count: int, width_px: int, height: int, width: float | None = None) -> dict:
    """One picture; `width` scales Gaussians of 1.2 px, and then they are faint, so that the light is not used up."""
    pixels = 1.8 * (50_000 / count) ** (1 / 3) * width_px / 400 if width is None else 1.2 * width
    arrays, camera = scene(count, width_px, height, pixels, 1.0 if width is None else 0.05)
    arrays = [a.to(device) for a in arrays]
    forward, both = timed([partial(once, rasterize, arrays, camera, b) for b in (False, True)], 2.0)
    return report(
        part=part, device=device, gaussians=count, width=width_px, height=height, touched=touched(arrays, camera),
        forward_ms=forward, both_ms=both,
    )  # fmt: skip


def touched(arrays: list[torch.Tensor], camera: Camera) -> int:
    """Pixels inside the cutoff's ellipses, over all Gaussians: 2 pi ln(255 o) sqrt(det S), without hidden ones."""
    mean, covariance, opacity, _ = (a.double().cpu() for a in arrays)
    M = camera.world_to_camera
    z = (mean @ M[:3, :3].T + M[:3, 3])[:, 2]
    J = (camera.fx / z)[:, None, None] * M[:2, :3]  # the ball is small: rays nearly parallel
    S = J @ covariance @ J.mT + 0.3 * torch.eye(2).double()
    return round(float((2 * math.pi * (255 * opacity).clamp_min(1).log() * torch.linalg.det(S).sqrt()).sum()))


def against(name: str, device: str, count: int, side: int, other: Callable) -> list[dict]:
    """The same scene by us and by `other`, in turn."""
    arrays, camera = scene(count, side, side, 3.0 if name == "twin" else 1.8)
    arrays = [a.to(device) for a in arrays]
    draws = {"ours": rasterize, name: other}
    forward = timed([partial(once, draw, arrays, camera, False) for draw in draws.values()], 4.0)
    both = timed([partial(once, draw, arrays, camera, True) for draw in draws.values()], 8.0)
    common = {"part": f"against {name}", "device": device, "gaussians": count, "width": side, "height": side}
    return [
        report(**common, what=what, forward_ms=f, both_ms=b) for what, f, b in zip(draws, forward, both, strict=True)
    ]


def write(rows: list[dict]) -> None:
    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine('cpu')}, seed {SEED}"
    with (RESULTS / "renderer.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        table.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    draw(rows, title)
    (RESULTS / "renderer.md").write_text(page(rows, title))


def draw(rows: list[dict], title: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.4), layout="constrained")
    figure.suptitle(title, fontsize=9)
    errors, counts, widths = figure.subplots(1, 3)
    for i, tile in enumerate(TILES):
        for precision in PRECISIONS:
            line = [r for r in rows if r["part"] == "accuracy" and (r["tile"], r["precision"]) == (tile, precision)]
            style = dict(color=f"C{i}", fillstyle="full" if precision == "float32" else "none", linewidth=0.8)
            label = f"tile {tile}, {precision}"
            errors.plot([r["both_ms"] for r in line], [r["error"] for r in line], "o-", label=label, **style)
            errors.plot([r["both_ms"] for r in line], [r["gradient_error"] for r in line], "s:", markersize=4, **style)
    line = [r for r in rows if r["part"] == "accuracy" and (r["tile"], r["precision"]) == (TILES[0], "float32")]
    for r in line:
        errors.annotate(
            f"1/{1 / r['cutoff']:.0f}",
            (r["both_ms"], r["error"]),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=7,
        )
    errors.set(xlabel="forward and backward [ms]", ylabel="relative L2 error", title="error: picture o-, gradient s:")
    for axis, part, over in ((counts, "count", "gaussians"), (widths, "width", "touched")):
        line = [r for r in rows if r["part"] == part]
        x = [r[over] for r in line]
        axis.plot(x, [r["forward_ms"] for r in line], "o-", label="forward")
        axis.plot(x, [r["both_ms"] for r in line], "s-", label="forward and backward")
        axis.plot(x, [line[-1]["both_ms"] * v / x[-1] for v in x], "k:", linewidth=0.8, label="linear")
    counts.set(xlabel="Gaussians, 400 x 400, the smaller the more", ylabel="[ms]", title="cost over Gaussians")
    widths.set(xlabel="pixels touched, 16 000 Gaussians", ylabel="[ms]", title="cost over pixels touched")
    for axis in (errors, counts, widths):
        axis.set(xscale="log", yscale="log")
        axis.grid(which="both", alpha=0.2)
        axis.legend(fontsize=7)
    figure.savefig(RESULTS / "renderer.png", dpi=110)


def page(rows: list[dict], title: str) -> str:
    """The results as a page. What it says of them is computed from them."""
    lines = ["# Renderer: error against time, and cost", "", f"Made by `make bench-renderer`. {title}.", ""]
    lines += ["Machines may be shared with other work: compare times within this page only.", ""]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), "", "![error and cost](renderer.png)", ""]
    lines += ["## What it shows", "", *(f"- {sentence}" for sentence in findings(rows)), ""]
    lines += [
        "## Pictures",
        "",
        "| device | Gaussians | pixels | forward [ms] | forward and backward [ms] |",
        "|---|---|---|---|---|",
    ]
    for r in rows:
        if r["part"] == "headline":
            pixels = f"{r['width']} x {r['height']}"
            lines.append(
                f"| {r['device']} | {r['gaussians']} | {pixels} | {r['forward_ms']:.1f} | {r['both_ms']:.1f} |"
            )
    lines += ["", "## Accuracy", "", "| precision | cutoff | tile | forward [ms] | both [ms] | picture | gradient |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for r in rows:
        if r["part"] == "accuracy":
            numbers = f"{r['forward_ms']:.2f} | {r['both_ms']:.2f} | {r['error']:.1e} | {r['gradient_error']:.1e}"
            lines.append(f"| {r['precision']} | 1/{1 / r['cutoff']:.0f} | {r['tile']} | {numbers} |")
    return "\n".join(lines) + "\n"


def findings(rows: list[dict]) -> list[str]:
    def one(precision: str, cutoff: float, tile: int = 16) -> dict:
        key = (precision, cutoff, tile)
        return next(r for r in rows if r["part"] == "accuracy" and (r["precision"], r["cutoff"], r["tile"]) == key)

    usual, coarse, fine = (one("float32", c) for c in (CUTOFFS[1], CUTOFFS[0], CUTOFFS[2]))
    sentences = [
        f"The cutoff rules the error: {coarse['error']:.1e} of the picture at 1/32, {usual['error']:.1e} at 1/255 (the "
        f"default), {fine['error']:.1e} at 1/2048; of the gradient {coarse['gradient_error']:.1e}, "
        f"{usual['gradient_error']:.1e}, {fine['gradient_error']:.1e}. 1/2048 costs "
        f"{fine['both_ms'] / usual['both_ms']:.2f} times the default."
    ]
    tight = [one(p, CUTOFFS[-1]) for p in PRECISIONS]
    sentences.append(
        f"At a cutoff of 1e-5 float32 has an error of {tight[0]['error']:.1e}, float64 one of {tight[1]['error']:.1e} "
        f"at {tight[1]['both_ms'] / tight[0]['both_ms']:.1f} times the time (both stop at a transmittance of 1e-4)."
    )
    by_tile = ", ".join(f"{one('float32', CUTOFFS[1], t)['both_ms']:.1f} ms at {t}" for t in TILES)
    sentences.append(f"The tile changes the time and not the picture: {by_tile} px.")
    for part, over in (("count", "gaussians"), ("width", "touched")):
        line = [r for r in rows if r["part"] == part]
        growth = math.log(line[-1]["both_ms"] / line[-2]["both_ms"]) / math.log(line[-1][over] / line[-2][over])
        what = "Gaussians" if part == "count" else "pixels touched"
        sentences.append(f"Cost grows as the {what} to the power {growth:.2f} (last two points, forward and backward).")
    sentences.append("A row of a tile is one wide operation, so narrow Gaussians cost as much as wider ones.")
    for name in ("twin", "gsplat"):
        pair = [r for r in rows if r["part"] == f"against {name}"]
        if pair:
            forward, both = (pair[1][k] / pair[0][k] for k in ("forward_ms", "both_ms"))
            what = "the torch twin in float32, one thread" if name == "twin" else "gsplat"
            sentences.append(
                f"{pair[0]['gaussians']} Gaussians, {pair[0]['width']} x {pair[0]['height']}: {forward:.3g} times as "
                f"fast as {what} forward, {both:.3g} times forward and backward."
            )
        else:
            sentences.append("Not compared with gsplat: there is none, or no CUDA device, on this machine.")
    return sentences


if __name__ == "__main__":
    main()
