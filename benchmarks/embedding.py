"""Gaussians carried by few particles, against simulating every Gaussian: error, time, and what a cut shows.

    make bench-embedding        a minute on one core; writes docs/results/embedding.{csv,md,png} and embedding_cut.png

A soft bar (0.1 x 0.1 x 0.3 m, neo-Hookean, E = 20 kPa, cells of 25 mm) is held at its foot and swings about its axis
(twist, about a quarter turn at its head), or is poked. It is made of 12 288 Gaussians, 64 in a cell. Reference: every
Gaussian is a particle. Against it: particles on a lattice, 1, 8, 27 or 64 in a cell of the same grid ("simulated"), or
1 or 8 of the reference's own particles in a cell ("map alone": no other simulation, only the map). They carry the
Gaussians by the map of `gaussians/carry.py` (third order), or by the plain mean of their affine motions,
x_g = sum_j w_j (x_j + F_j (X_g - X_j)). Positions are compared relative to the displacement (rms over Gaussians and
frames), covariances relative to their own norm, pictures by PSNR over frames.
"""

import csv
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests")]

from analytic_bodies import discs, sphere

from benchmarks.machine import machine
from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.fill import fill
from physics3d.filling.solids import Poisson
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.carry import carry
from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.embedding import Embedding, embed
from physics3d.gaussians.interior import Interior, paint
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import rasterize
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import C0, sh_color
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout
from physics3d.trajectory import Trajectory
from physics3d.world import World

RESULTS = Path(__file__).parents[1] / "docs/results"
SEED, DX, CELLS = 0, 0.025, (4, 4, 12)
FRAMES, SECONDS = 11, 0.4
WHITE = (1.0, 1.0, 1.0)
PER_SIDE = (1, 2, 3, 4)  # particles along the side of a cell
MOTIONS: dict[str, tuple[float, tuple[AbstractBoundary, ...]]] = {  # spin of the head at the start [rad/s], excitation
    "twist": (40.0, ()),
    "poke": (0.0, (Impulse(force=(4.0, 0.0, 0.0), centre=(-0.05, 0.0, 0.26), radius=0.05, start=0.0, duration=0.15),)),
}


def lattice(per_side: int, jitter: float, rng: np.random.Generator) -> torch.Tensor:
    axes = [(np.arange(c * per_side) + 0.5) * DX / per_side for c in CELLS]
    X = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    X += jitter * DX / per_side * rng.uniform(-0.5, 0.5, X.shape) - np.array([0.05, 0.05, 0.0])
    return torch.from_numpy(X).float()


def coloured(X: torch.Tensor) -> Gaussians:
    n = len(X)
    stripes = torch.sin(150 * X).sign()
    return Gaussians(
        mean=X,
        log_scale=torch.tensor([0.004, 0.004, 0.0025]).log().expand(n, 3).contiguous(),
        quaternion=torch.randn(n, 4, generator=torch.Generator().manual_seed(SEED)),
        opacity_logit=torch.full((n,), 1.5),
        sh=(0.3 * stripes / C0)[:, None],
    )


def simulate(X: torch.Tensor, per_side: int, motion: str) -> tuple[Trajectory, float]:
    """Trajectory and its processor time [s]."""
    spin, excitation = MOTIONS[motion]
    start = {"youngs_modulus": 2e4, "poissons_ratio": 0.3}
    world = World(
        material=NeoHookean(),
        density=300.0,
        start=start,
        dx=DX,
        gravity=(0.0, 0.0, 0.0),
        boundaries=(FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 0.026)),),
    )
    volume = torch.full((len(X),), (DX / per_side) ** 3)
    parameters = {name: torch.tensor(value) for name, value in start.items()}
    velocity = spin * X[:, 2:] / 0.3 * torch.stack([-X[:, 1], X[:, 0], torch.zeros(len(X))], 1)
    more = dict(
        velocity=velocity,
        excitation=excitation,
        frames=FRAMES,
        frame_dt=SECONDS / (FRAMES - 1),
        threads=1,
        log=Log(None),
    )
    started = time.process_time()
    with torch.no_grad():
        trajectory = rollout(world, parameters, X, volume, **more)
    return trajectory, time.process_time() - started


def plain(gaussians: Gaussians, tied: Embedding, X, x, F):
    """The blend of affine motions with weights of the bell alone."""
    near = tied.neighbours
    spacing = float(np.median(cKDTree(X.numpy()).query(X.numpy(), k=2)[0][:, 1]))
    way = gaussians.mean[:, None] - X[near]
    w = torch.softmax(-0.5 * (way.norm(dim=2) / spacing) ** 2, 1)
    mean = torch.einsum("gk,gki->gi", w, x[near] + torch.einsum("gkij,gkj->gki", F[near], way))
    F_g = torch.einsum("gk,gkij->gij", w, F[near])
    return mean, F_g @ gaussians.covariance() @ F_g.mT, None


def picture(mean, covariance, gaussians: Gaussians) -> torch.Tensor:
    pose = look_at(torch.tensor([0.28, -0.36, 0.25]), torch.tensor([0.0, 0.0, 0.15]))
    camera = Camera(width=200, height=240, fx=280, fy=280, cx=100, cy=120, world_to_camera=pose)
    with torch.no_grad():
        return rasterize(
            mean, covariance, gaussians.opacity, sh_color(gaussians.sh, mean), camera, background=WHITE
        ).color


def compare(motion: str) -> tuple[list[dict], list[np.ndarray]]:
    """Rows of the table, and pictures of the last frame: reference, then 8 in a cell with either map."""
    rng = np.random.default_rng(SEED)
    X_g = lattice(4, 0.6, rng)
    gaussians = coloured(X_g)
    simulate(lattice(1, 0.0, rng), 1, motion)  # compiles
    reference, full_time = simulate(X_g, 4, motion)
    covariance = gaussians.covariance()
    exact = [(x, F @ covariance @ F.mT) for x, F in zip(reference.position, reference.deformation, strict=True)]
    pictures = [picture(x, S, gaussians) for x, S in exact]
    moved = torch.stack([x - X_g for x, _ in exact]).square().sum(2).mean().sqrt()
    first = dict(motion=motion, kind="reference", map="every Gaussian a particle", per_cell=64, spacing=DX / 4)
    rows = [first | dict(position=0.0, covariance=0.0, psnr=math.inf, simulation=full_time, carrying=0.0)]
    farthest = int((reference.position - X_g).square().sum((1, 2)).argmax())
    shown = [pictures[farthest]]
    runs = []
    for per_side in PER_SIDE:
        X = lattice(per_side, 0.0, rng)
        runs.append(("simulated", per_side, X, *simulate(X, per_side, motion)))
    for per_side in (1, 2):  # the reference's own particles, a few of them: the error of the map alone
        _, nearest = cKDTree(X_g.numpy()).query(lattice(per_side, 0.0, rng).numpy())
        some = replace(
            reference,
            rest_position=X_g[nearest],
            position=reference.position[:, nearest],
            deformation=reference.deformation[:, nearest],
        )
        runs.append(("map alone", per_side, X_g[nearest], some, 0.0))
    for kind, per_side, X, trajectory, seconds in runs:
        tied = embed(X_g, torch.arange(len(X_g)), X, DX / per_side)
        for name, function in (("third order", carry), ("affine mean", plain)):
            started = time.process_time()
            found = [
                function(gaussians, tied, X, x, F)[:2]
                for x, F in zip(trajectory.position, trajectory.deformation, strict=True)
            ]
            carrying = time.process_time() - started
            pairs = list(zip(found, exact, strict=True))
            off = torch.stack([a - b for (a, _), (b, _) in pairs]).square().sum(2).mean().sqrt()
            shape = [(a - b).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1) for (_, a), (_, b) in pairs[1:]]
            drawn = [picture(x, S, gaussians) for x, S in found]
            error = torch.stack([(a - b).square().mean() for a, b in zip(drawn[1:], pictures[1:], strict=True)]).mean()
            row = dict(motion=motion, kind=kind, map=name, per_cell=per_side**3, spacing=DX / per_side)
            row |= dict(position=float(off / moved), covariance=float(torch.stack(shape).mean()))
            row |= dict(psnr=float(-10 * error.log10()), simulation=seconds, carrying=carrying)
            rows.append(row)
            if kind == "simulated" and per_side == 2:
                shown.append(drawn[farthest])
            print({k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return rows, [(p.clamp(0, 1) * 255).byte().numpy() for p in shown]


def cut_ball() -> tuple[dict, np.ndarray]:
    """What the inside changes in pictures of the whole ball; pictures of a cut one: without it, with it, painted."""
    rng = np.random.default_rng(SEED)
    point, normal = sphere(6000, 0.05, rng)
    ball = discs(point, normal, rng, sigma=0.0022)
    around, down = np.arctan2(point[:, 1], point[:, 0]), np.arccos(point[:, 2] / 0.05)
    dark = (np.floor(down / np.pi * 6) + np.floor((around + np.pi) / (2 * np.pi) * 10)) % 2 == 0
    colour = np.where(dark[:, None], [0.8, 0.25, 0.15], [0.85, 0.75, 0.5])
    ball = Gaussians(**(vars(ball) | {"sh": torch.tensor((colour - 0.5) / C0).float()[:, None]}))
    body = fill(
        ball, torch.ones(len(ball), dtype=torch.int32), spacing=0.004, opacity=0.1, solid=Poisson(), interior=True,
        sheet_thickness=None, isolated="keep", drop_pieces_below=0.0, attach=False, cameras=(), log=Log(None),
    )  # fmt: skip
    X, still = body.position, torch.eye(3).expand(len(body.position), 3, 3)
    cameras = [camera((0.25 * math.cos(a), 0.25 * math.sin(a), 0.1)) for a in np.arange(8) * math.pi / 4]
    plain_inside = Interior.of(ball, X, body.interior, body.spacing)
    assert plain_inside is not None
    painted = paint(plain_inside, ball, cameras[::2], background=WHITE, steps=32, log=Log(None))
    measured: dict[str, float] = {"inner": len(plain_inside.particle), "particles": len(X)}
    draw = lambda x, view, inside: render_deformed(
        ball, body.embedding, X, x, still, view, background=WHITE, interior=inside
    )
    apart = X + torch.where(X[:, :1] > 0, 0.12, 0.0) * torch.tensor([1.0, 0.6, 0.0])
    view = camera((0.22, -0.16, 0.08))
    pictures = []
    with torch.no_grad():
        at_rest = [draw(X, c, plain_inside).color - draw(X, c, None).color for c in cameras]
        measured["at_rest"] = 255 * float(torch.stack(at_rest).abs().max())
        for name, inside in (("all_drawn", plain_inside), ("all_painted", painted)):
            both = {n: torch.cat([getattr(ball, n), getattr(inside.gaussians, n)]) for n in vars(ball)}
            change = torch.stack(
                [
                    render(Gaussians(**both), c, background=WHITE).color - render(ball, c, background=WHITE).color
                    for c in cameras[1::2]  # not those that were painted on
                ]
            )
            measured[name] = 255 * float(change.abs().mean())
        for seen in (None, plain_inside, painted):
            pictures.append((draw(apart, view, seen).color.clamp(0, 1) * 255).byte().numpy())
    return measured, np.concatenate(pictures, 1)


def camera(place: tuple[float, float, float]) -> Camera:
    pose = look_at(torch.tensor(place), torch.tensor([0.02, 0.02, 0.0]))
    return Camera(width=320, height=240, fx=330, fy=330, cx=160, cy=120, world_to_camera=pose)


def main() -> None:
    rows, pictures = [], []
    for motion in MOTIONS:
        more, shown = compare(motion)
        rows += more
        pictures.append(np.concatenate(shown, 1))
    inside, cut = cut_ball()
    print(inside)
    RESULTS.mkdir(parents=True, exist_ok=True)
    title = f"{machine('cpu')}, 1 thread, seed {SEED}"
    with (RESULTS / "embedding.csv").open("w", newline="") as file:
        file.write(f"# {title}\n")
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    draw(rows, np.concatenate(pictures, 0), title)
    from PIL import Image

    Image.fromarray(cut).save(RESULTS / "embedding_cut.png")
    (RESULTS / "embedding.md").write_text(page(rows, inside, title))


def draw(rows: list[dict], pictures: np.ndarray, title: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.4), layout="constrained")
    figure.suptitle(title, fontsize=9)
    *panels, seen = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.2))
    styles = {("simulated", "third order"): "o-", ("simulated", "affine mean"): "s--"}
    styles |= {("map alone", "third order"): "o:", ("map alone", "affine mean"): "s:"}
    for i, motion in enumerate(MOTIONS):
        for (kind, name), style in styles.items():
            mine = [r for r in rows if (r["motion"], r["kind"], r["map"]) == (motion, kind, name)]
            fill_style = "full" if kind == "simulated" else "none"
            for panel, quantity in zip(panels, ("position", "covariance"), strict=False):
                panel.plot(
                    [1e3 * r["spacing"] for r in mine], [r[quantity] for r in mine], style, color=f"C{i}",
                    fillstyle=fill_style, label=f"{motion}, {kind}, {name}",
                )  # fmt: skip
            if kind == "simulated":
                total = [r["simulation"] + r["carrying"] for r in mine]
                panels[2].plot(total, [r["psnr"] for r in mine], style, color=f"C{i}")
        full = next(r for r in rows if r["motion"] == motion and r["kind"] == "reference")
        panels[2].axvline(full["simulation"], color=f"C{i}", linestyle=":", label=f"{motion}: every Gaussian simulated")
    for panel, what in zip(panels, ("error of positions", "error of covariances"), strict=False):
        panel.set(xscale="log", yscale="log", xlabel="particle spacing [mm]", ylabel=what)
        panel.legend(fontsize=6)
    panels[2].set(xscale="log", xlabel="simulation + carrying, processor time [s]", ylabel="PSNR of the pictures [dB]")
    panels[2].legend(fontsize=7)
    for panel in panels:
        panel.grid(which="both", alpha=0.2)
        panel.xaxis.set_minor_formatter("")
    for panel in panels[:2]:
        panel.set_xticks([6, 8, 12, 25], labels=["6", "8", "12", "25"])
    panels[2].set_xticks([0.3, 0.5, 1, 2], labels=["0.3", "0.5", "1", "2"])
    seen.imshow(pictures)
    seen.set_axis_off()
    seen.set_title("every Gaussian | 8 per cell | affine mean", fontsize=8)
    figure.savefig(RESULTS / "embedding.png", dpi=100)


def page(rows: list[dict], inside: dict, title: str) -> str:
    lines = [
        "# Embedding: Gaussians carried by particles",
        "",
        f"Made by `make bench-embedding`. Machine: {title}.",
        "",
    ]
    lines += [*__doc__.split("\n\n", 2)[2].strip().splitlines(), "", "![error and time](embedding.png)", ""]
    lines += ["## What it shows", ""]
    for motion in MOTIONS:

        def find(kind: str, name: str, motion: str = motion) -> dict:
            return next(
                r
                for r in rows
                if (r["motion"], r["kind"], r["map"]) == (motion, kind, name)
                and (kind == "reference" or r["per_cell"] == 8)
            )

        full, ours = find("reference", "every Gaussian a particle"), find("simulated", "third order")
        alone, old = find("map alone", "third order"), find("map alone", "affine mean")
        total = ours["simulation"] + ours["carrying"]
        lines += [
            f"- {motion}: the map alone, from an eighth of the reference's own particles, puts positions "
            f"{100 * alone['position']:.2g} % off (affine mean {100 * old['position']:.2g} %), covariances "
            f"{100 * alone['covariance']:.2g} % ({100 * old['covariance']:.2g} %), pictures at {alone['psnr']:.1f} dB "
            f"({old['psnr']:.1f} dB).",
            f"- {motion}, 8 particles per cell simulated in place of 64: {100 * ours['position']:.2g} %, "
            f"{100 * ours['covariance']:.2g} %, {ours['psnr']:.1f} dB, most of it because fewer particles move "
            f"differently; {total:.2g} s instead of {full['simulation']:.2g} s, {full['simulation'] / total:.1f} times "
            "less.",
        ]
    lines += [
        "",
        "| motion | particles | map | per cell | spacing [mm] | positions | covariances | PSNR [dB] | simulation [s] "
        "| carrying [s] |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r['motion']} | {r['kind']} | {r['map']} | {r['per_cell']} | {1e3 * r['spacing']:.3g} | "
            f"{r['position']:.2e} | "
            f"{r['covariance']:.2e} | {r['psnr']:.1f} | {r['simulation']:.2f} | {r['carrying']:.3f} |"
        )
    lines += [
        "",
        "## The inside",
        "",
        f"A ball of flat Gaussians is filled with {inside['particles']} particles, {inside['inner']} of them inner,",
        "and cut in two: drawn without its inside, with it, and with colours painted on the views (L_Fill, 32 steps).",
        "",
        "![cut ball](embedding_cut.png)",
        "",
        f"- At rest the pictures with and without the inside differ by {inside['at_rest']:.3g} grey levels.",
        f"- If all of it were drawn at rest, views not painted on would change by {inside['all_drawn']:.2f} of 255 in "
        f"the mean, "
        f"{inside['all_painted']:.2f} after painting.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
