"""Which inside test fills best: error against time on bodies of known shape, with noise, holes and missing caps.

    make bench-filling      ten minutes on one core; writes docs/results/filling.{csv,md,png} and filling_slices.png

Bodies are made of flat Gaussians, 1.5 mm wide; their centres lie off the surface by the noise. Particles are 6 mm
apart. Conditions: noise of 0.3 (clean), 1 and 2 mm; a tenth of the surface missing in ten patches (holes); the lowest
tenth of the body missing altogether (cap missing). IoU compares the solid that was found with the true one at 20 000
random points (rms 0.4 %). The vote is what much research code does: inside is where at least 85 % of 26 directions meet
a voxel of the surface.

These Gaussians lie where the surface is. Those of a fit do not: the last part reconstructs the carnation from its 40
photographs and fills it, without asking the photographs' cameras (the surface is then a deviation outside the
Gaussians' centres) and asking them (physics3d/filling/seen.py). Measured is its stem, without the leaves; labels are
those of the nearest mesh. A stem bends with its second moment of area, which goes with the fourth power of the radius.
It is filled with particles at several distances too: the first frequency of the plant, held below the soil, beside that
of its own solids, says what a learned stiffness hangs on (E goes with its square).
"""

import csv
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests")]

from analytic_bodies import annulus, box, cup, discs, petal, sphere, together, torus, wall
from labelled_twins import carnation

from benchmarks.machine import machine
from physics3d.filling.body import Body
from physics3d.filling.cells import solid_cells
from physics3d.filling.fill import fill
from physics3d.filling.solids import AbstractSolid, Poisson, WindingNumber
from physics3d.filling.surface import Surface, sample_surface
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.matter import Matter
from physics3d.modes.model import model
from physics3d.open3d_import import open3d
from physics3d.scenes.carnation import CarnationTwin
from physics3d.scenes.flower import STEM_TOP, plant, stem_curve
from physics3d.scenes.studio import Mesh
from physics3d.scenes.synthetic import particles
from stages.reconstruct import Reconstruct

RESULTS = Path(__file__).parents[1] / "docs/results"
SPACING, SEED = 0.006, 0
PETAL_THICKNESS = 0.001  # [m]
STEM_SPACING, STEM_FROM, SLICES = 0.006, 0.085, 6  # as conf/scene/carnation.yaml; from above the soil [m]
LEAVES_FROM = 0.017  # the axis, of a stem 25 mm thick [m]
SPACINGS = (0.0045, 0.006, 0.008, 0.010, 0.012)  # [m]
CONDITIONS = ("clean", "noise 1 mm", "noise 2 mm", "holes", "cap missing")
norm = np.linalg.norm
radius = lambda q: norm(q[:, :2], axis=1)


@dataclass(frozen=True, kw_only=True)
class Vote(AbstractSolid):
    share: float = 0.85  # of the directions

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda x: surface.enclosure.share(x) >= self.share


METHODS = {"Poisson": Poisson(), "winding number": WindingNumber(), "vote": Vote()}


@dataclass(frozen=True)
class Known:
    """A body: samples of its surface, and its signed distance or something of the same sign, negative inside."""

    surface: tuple[np.ndarray, np.ndarray]
    distance: Callable[[np.ndarray], np.ndarray]
    volume: float  # [m^3]


def bodies(rng: np.random.Generator) -> dict[str, Known]:
    drum = lambda q, r, h: np.maximum(radius(q) - r, np.abs(q[:, 2] - h / 2) - h / 2)
    ball = lambda q, r, x: norm(q - [x, 0, 0], axis=1) - r
    mug = lambda q: np.maximum(drum(q, 0.05, 0.1), -np.maximum(radius(q) - 0.036, 0.014 - q[:, 2]))
    pair = [(p + np.array([x, 0, 0]), n) for x in (-0.04, 0.04) for p, n in [sphere(5000, 0.04, rng)]]
    cake = together(wall(8000, 0.06, 0, 0.06, rng), annulus(4000, 0, 0.06, 0.06, rng))
    leaf, area = petal(8000, rng)
    return {
        "sphere": Known(sphere(8000, 0.05, rng), lambda q: ball(q, 0.05, 0), 4 / 3 * np.pi * 0.05**3),
        "torus": Known(
            torus(9000, 0.06, 0.025, rng),
            lambda q: np.hypot(radius(q) - 0.06, q[:, 2]) - 0.025,
            2 * np.pi**2 * 0.06 * 0.025**2,
        ),
        "box": Known(
            box(9000, (0.05, 0.04, 0.03), rng),
            lambda q: (np.abs(q) - [0.05, 0.04, 0.03]).max(1),
            8 * 0.05 * 0.04 * 0.03,
        ),
        "cup": Known(cup(0.05, 0.014, 0.1, rng), mug, np.pi * (0.05**2 * 0.1 - 0.036**2 * 0.086)),
        "cake without base": Known(cake, lambda q: drum(q, 0.06, 0.06), np.pi * 0.06**3),
        "two that touch": Known(
            together(*pair),
            lambda q: np.minimum(ball(q, 0.04, -0.04), ball(q, 0.04, 0.04)),
            2 * 4 / 3 * np.pi * 0.04**3,
        ),
        "petal": Known(leaf, lambda q: np.full(len(q), 1.0), area * PETAL_THICKNESS),
    }


def seen(known: Known, condition: str, rng: np.random.Generator) -> Gaussians:
    """The Gaussians that a reconstruction would give under this condition."""
    point, normal = known.surface
    keep = np.ones(len(point), bool)
    if condition == "holes":
        centre = point[rng.choice(len(point), 10, replace=False)]
        nearest = cKDTree(point).query(centre, k=len(point) // 100)[1]
        keep[nearest] = False
    elif condition == "cap missing":
        low, high = point[:, 2].min(), point[:, 2].max()
        keep = point[:, 2] > low + 0.1 * (high - low)
    noise = {"noise 1 mm": 0.001, "noise 2 mm": 0.002}.get(condition, 0.0003)
    return discs(point[keep], normal[keep], rng, noise=noise)


def filled(gaussians: Gaussians, solid: AbstractSolid, thin: bool) -> Body:
    return fill(
        gaussians,
        torch.ones(len(gaussians), dtype=torch.int32),
        spacing=SPACING,
        opacity=0.1,
        solid=solid,
        interior=True,
        sheet_thickness=PETAL_THICKNESS if thin else None,
        isolated="keep",
        drop_pieces_below=0.0,
        attach=False,
        cameras=(),
        log=Log(None),
    )


def measure(name: str, known: Known, condition: str, method: str) -> tuple[dict, np.ndarray]:
    """One row of the table, and the particles [p, 3]."""
    gaussians = seen(known, condition, np.random.default_rng(SEED + 1))
    thin = name == "petal"
    started = time.process_time()
    body = filled(gaussians, METHODS[method], thin)
    seconds = time.process_time() - started
    particle = body.position.double().numpy()
    rng = np.random.default_rng(SEED + 2)
    point = known.surface[0]
    q = rng.uniform(point.min(0) - 0.01, point.max(0) + 0.01, (20_000, 3))
    surface, _ = sample_surface(gaussians, SPACING)
    found, true = METHODS[method].inside(surface, SPACING)(q), known.distance(q) < 0
    distance = known.distance(particle) if not thin else cKDTree(point).query(particle)[0]
    apart = cKDTree(particle).query(particle, k=2)[0][:, 1] / SPACING
    deep = np.abs(known.distance(particle)) > 1.5 * SPACING if not thin else np.ones(len(particle), bool)
    row = dict(body=name, condition=condition, method=method, seconds=seconds, particles=len(particle))
    # of a petal nothing may be solid: the share of its particles that are not in its sheet takes the place of 1 - IoU
    row["iou"] = (found & true).sum() / (found | true).sum() if not thin else 1 - (distance > SPACING / 2).mean()
    row["volume_error"] = float(body.volume.double().sum()) / known.volume - 1
    row["outside"] = (distance > SPACING / 2).mean()
    row["apart"] = float(np.median(apart))
    row["closest"] = float(apart.min())
    row["per_cell"] = per_cell(particle[deep]) if deep.sum() > 50 and not thin else float("nan")
    print({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return row, particle


def stem() -> tuple[dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], dict[str, float]]:
    """(way -> heights [m], areas [m^2] and second moments of area [m^4] of the carnation's stem, along it; distance of
    the particles, or "its solids" -> first frequency [Hz] of the plant)."""
    twin = carnation(("plant",), views=40, width=320, seed=SEED, log=Log(None))
    fit = Reconstruct(iterations=1000, max_gaussians=12_000, seed=SEED)(twin.capture, log=Log(None))
    label = torch.from_numpy(twin.nearest_label(fit.mean.numpy())).int()

    def fitted(spacing: float, cameras: tuple[Camera, ...]) -> Body:
        started = time.process_time()
        body = fill(
            fit,
            label,
            spacing=spacing,
            opacity=0.1,
            solid=Poisson(),
            interior=True,
            sheet_thickness=0.002,
            isolated="keep",
            drop_pieces_below=0.0,
            attach=False,
            cameras=cameras,
            log=Log(None),
        )
        spent = time.process_time() - started
        print(f"stem, {1e3 * spacing:g} mm, {len(cameras)} cameras: {spent:.1f} s of processor time", flush=True)
        return body

    of = lambda body: (body.position.double().numpy(), body.volume.double().numpy())
    solids = plant(SEED)[1]
    found = {
        "truth": sections(*(a.astype(np.float64) for a in particles(solids, STEM_SPACING / 6, SEED))),
        "centres": sections(*of(fitted(STEM_SPACING, ()))),
        "cameras": sections(*of(fitted(STEM_SPACING, twin.capture.cameras))),
    }
    corners = np.concatenate([mesh.vertices for mesh in solids]).astype(np.float64)
    swings = {"its solids": first_frequency(*solid_cells(inside_of(solids), corners, SPACINGS[0]))}
    for spacing in SPACINGS:
        body = fitted(spacing, twin.capture.cameras)
        assert body.matter is not None
        swings[f"filled {1e3 * spacing:g} mm apart"] = first_frequency(*of(body), body.matter)
    return found, swings


def inside_of(solids: list[Mesh]) -> Callable[[np.ndarray], np.ndarray]:
    """Whether points [m, 3] are in any of closed meshes [m]."""
    o3d = open3d()
    scenes = [o3d.t.geometry.RaycastingScene(nthreads=1) for _ in solids]
    for scene, mesh in zip(scenes, solids):
        scene.add_triangles(*(o3d.core.Tensor(a) for a in (np.float32(mesh.vertices), np.uint32(mesh.faces))))
    occupied = lambda scene, x: scene.compute_occupancy(o3d.core.Tensor(np.float32(x)), nthreads=1, nsamples=3).numpy()
    return lambda x: np.any([occupied(scene, x) > 0.5 for scene in scenes], 0)


def first_frequency(x: np.ndarray, volume: np.ndarray, matter: Matter) -> float:
    """Of the carnation's plant, held below the soil, of its true material with dash-pots that are stuck [Hz]."""
    world = CarnationTwin().world()
    body = torch.from_numpy(x), torch.from_numpy(volume)
    parameters = {name: torch.as_tensor(value) for name, value in world.start.items()}
    built = model(world, *body, parameters=parameters, boundaries=world.boundaries, matter=matter, log=Log(None))
    return float(built.exact_omega[0] / (2 * np.pi))


def sections(x: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a body along z: middle of every slice, its area and the mean of its two second moments about its centre.

    A particle is a cube, whose own moment counts, and its volume is shared by the slices that it reaches into.
    """
    axis = stem_curve(np.linspace(0, 1, 200))[0]
    near = cKDTree(axis).query(x)[0] < LEAVES_FROM
    x, volume = x[near], volume[near]
    edges = np.linspace(STEM_FROM, STEM_TOP - 0.01, SLICES + 1)
    step, half = edges[1] - edges[0], np.cbrt(volume) / 2
    reach = np.minimum(edges[1:, None], x[:, 2] + half) - np.maximum(edges[:-1, None], x[:, 2] - half)
    share = volume * np.clip(reach, 0, None) / (2 * half) / step  # [slices, p] area [m^2]
    area = share.sum(1)
    centre = share @ x[:, :2] / area[:, None]
    apart = ((x[None, :, :2] - centre[:, None]) ** 2).mean(2) + half**2 / 3
    return (edges[1:] + edges[:-1]) / 2, area, (share * apart).sum(1)


def per_cell(particle: np.ndarray) -> float:
    """Particles in each cell of two spacings, mean over the cells whose 26 neighbours are occupied too."""
    cell, count = np.unique(np.floor(particle / (2 * SPACING) + 0.25).astype(int), axis=0, return_counts=True)
    tree = cKDTree(cell)
    inner = np.array([len(n) == 27 for n in tree.query_ball_point(cell, 1.1, p=np.inf)])
    return float(count[inner].mean()) if inner.any() else float("nan")


def main() -> None:
    rows, shown = [], {}
    for name, known in bodies(np.random.default_rng(SEED)).items():
        for condition in CONDITIONS:
            for method in METHODS:
                row, particle = measure(name, known, condition, method)
                rows.append(row)
                if condition == "cap missing":
                    shown[name, method] = known, particle
    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine('cpu')}, 1 thread, seed {SEED}"
    with (RESULTS / "filling.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    draw(rows, title)
    draw_slices(shown)
    tube, swings = stem()
    draw_stem(tube)
    (RESULTS / "filling.md").write_text(page(rows, tube, swings, title))


def draw(rows: list[dict], title: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.8), layout="constrained")
    figure.suptitle(title, fontsize=9)
    names, markers = list(dict.fromkeys(r["body"] for r in rows)), "osD^vP*"
    left, right = figure.subplots(1, 2)
    for i, method in enumerate(METHODS):
        for name, marker in zip(names, markers, strict=True):
            mine = [r for r in rows if r["method"] == method and r["body"] == name]
            style = dict(color=f"C{i}", alpha=0.7, marker=marker, linestyle="none")
            label = method if name == names[0] else None
            left.plot([r["seconds"] for r in mine], [max(1 - r["iou"], 1e-4) for r in mine], label=label, **style)
            right.plot([r["seconds"] for r in mine], [max(abs(r["volume_error"]), 1e-4) for r in mine], **style)
    for name, marker in zip(names, markers, strict=True):
        right.plot([], [], color="0.4", marker=marker, linestyle="none", label=name)
    left.axhline(0.05, color="0.5", linestyle=":", label="target, closed")
    left.axhline(0.10, color="0.5", linestyle="--", label="target, cap missing")
    right.axhline(0.03, color="0.5", linestyle=":", label="target")
    left.set(xscale="log", yscale="log", xlabel="processor time [s]", ylabel="1 - IoU")
    right.set(xscale="log", yscale="log", xlabel="processor time [s]", ylabel="relative error of the volume")
    for axis in (left, right):
        axis.grid(which="both", alpha=0.2)
        axis.legend(fontsize=7)
    figure.savefig(RESULTS / "filling.png", dpi=100)


def draw_slices(shown: dict) -> None:
    """Particles within half a spacing of the plane y = 0, and the outline of the true body."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(name for name, _ in shown))
    figure = Figure(figsize=(2.3 * len(names), 2.1 * len(METHODS)), layout="constrained")
    for axis, ((name, method), (known, particle)) in zip(
        figure.subplots(len(METHODS), len(names)).T.reshape(-1), shown.items(), strict=True
    ):
        low, high = known.surface[0].min(0) - 0.01, known.surface[0].max(0) + 0.01
        x, z = np.meshgrid(np.linspace(low[0], high[0], 200), np.linspace(low[2], high[2], 200))
        if name != "petal":
            value = known.distance(np.stack([x, 0 * x, z], -1).reshape(-1, 3)).reshape(x.shape)
            axis.contour(x, z, value, levels=[0], colors="k", linewidths=0.8)
        near = np.abs(particle[:, 1]) < SPACING / 2
        axis.scatter(particle[near, 0], particle[near, 2], s=5, color=f"C{list(METHODS).index(method)}")
        axis.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), xticks=[], yticks=[], aspect="equal")
        if method == next(iter(METHODS)):
            axis.set_title(name, fontsize=9)
        if name == names[0]:
            axis.set_ylabel(method, fontsize=9)
    figure.savefig(RESULTS / "filling_slices.png", dpi=80)


def draw_stem(found: dict) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    names = {"truth": "true", "centres": "filled, without cameras", "cameras": "filled, with cameras"}
    for axis, column, unit, what in zip(
        figure.subplots(1, 2), (1, 2), (1e6, 1e12), ("area [mm$^2$]", "second moment [mm$^4$]")
    ):
        for way, style in (("truth", "k-"), ("centres", "o--"), ("cameras", "s-")):
            axis.plot(1e3 * found[way][0], unit * found[way][column], style, label=names[way])
        axis.set(xlabel="height [mm]", ylabel=what, ylim=(0, None))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(RESULTS / "filling_stem.png", dpi=90)


def page(rows: list[dict], tube: dict, swings: dict[str, float], title: str) -> str:
    lines = ["# Filling: which inside test", "", f"Made by `make bench-filling`. Machine: {title}.", ""]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), "", "![error against time](filling.png)", ""]
    lines += ["Slices y = 0 with the lowest tenth of every body missing, true outline in black:", ""]
    lines += ["![slices](filling_slices.png)", "", "## What it shows", ""]
    lines += [f"- {sentence}" for sentence in findings(rows)]
    lines += ["", "## A reconstructed stem", "", "![stem](filling_stem.png)", ""]
    lines += ["| surface from | area, mean error | second moment, mean error | worst section |", "|---|---|---|---|"]
    for way in ("centres", "cameras"):
        area, moment = (tube[way][k] / tube["truth"][k] - 1 for k in (1, 2))
        worst = max(moment, key=abs)
        lines.append(f"| {way} | {100 * area.mean():+.1f} % | {100 * moment.mean():+.1f} % | {100 * worst:+.1f} % |")
    lines += ["", "## The same body, whatever the distance of its particles", ""]
    lines += ["| plant | first frequency | beside its solids | which is in E |", "|---|---|---|---|"]
    for name, f in swings.items():
        off = f / swings["its solids"] - 1
        lines.append(f"| {name} | {f:.3f} Hz | {100 * off:+.1f} % | {100 * ((1 + off) ** 2 - 1):+.1f} % |")
    lines += ["", "## Every run", ""]
    lines += ["Of the petal nothing may be solid: its IoU is the share of particles in its sheet.", ""]
    lines += ["| body | condition | method | IoU | volume error | outside | nearest neighbour | per cell | s |"]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    for r in rows:
        cell = "" if np.isnan(r["per_cell"]) else f"{r['per_cell']:.2f}"
        lines.append(
            f"| {r['body']} | {r['condition']} | {r['method']} | {r['iou']:.3f} | {100 * r['volume_error']:+.1f} % | "
            f"{100 * r['outside']:.1f} % | {r['apart']:.2f} ({r['closest']:.2f}) | {cell} | {r['seconds']:.2f} |"
        )
    lines += [
        "",
        "outside: particles farther than half a spacing outside; nearest neighbour: median (least), in spacings;",
    ]
    lines += ["per cell: particles in a cell of two spacings, inside."]
    return "\n".join(lines) + "\n"


def findings(rows: list[dict]) -> list[str]:
    sentences = []
    for method in METHODS:
        mine = [r for r in rows if r["method"] == method]
        closed = [r for r in mine if r["condition"] in ("clean", "noise 1 mm", "holes")]
        capless = [r for r in mine if r["condition"] == "cap missing"]
        right = sum(r["iou"] >= 0.95 and abs(r["volume_error"]) <= 0.03 for r in closed)
        open_ = sum(r["iou"] >= 0.90 for r in capless)
        worst = min(closed + capless, key=lambda r: r["iou"])
        sentences.append(
            f"{method}: {right} of {len(closed)} runs with noise up to 1 mm or holes have IoU >= 0.95 and a volume "
            f"within 3 %, {open_} of {len(capless)} without a cap IoU >= 0.90; worst of these {worst['iou']:.2f} "
            f"({worst['body']}, {worst['condition']}); median {np.median([r['seconds'] for r in mine]):.2f} s of "
            "processor time."
        )
    cell = [r["per_cell"] for r in rows if r["method"] == "Poisson" and not np.isnan(r["per_cell"])]
    sentences.append(
        f"Spacing (Poisson): {np.mean(cell):.2f} particles in a cell of two spacings inside the bodies "
        f"({min(cell):.2f} to {max(cell):.2f})."
    )
    return sentences


if __name__ == "__main__":
    main()
