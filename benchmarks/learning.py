"""Is what is learned the truth, and is it within its interval? Bodies with known material, over and over.

    make bench-learning [ARGS="scenes=carnation,cup cameras=1 seeds=0,1 parts=bodies,told,shapes,handed,ways workers=2"]
        ->   docs/results/learning.md, .csv, .png
    make bench-learning ARGS="cameras=3 parts=bodies"      the quick form: 20 minutes of processor time

Every run has a body and a material of its own (`learning_twins.py`), and starts a factor 10 off in stiffness and 5 in
the relaxation time, with noise on every pixel and a density that is wrong by about 10 %, which is learned besides, for
the push is known. It goes through the stages of the pipeline from the filling on: fill, learn, simulate and render the
push that was held out. The Gaussians are the twin's own, on its true surface, for reconstruction is slow; what is
filled into them swings up to 2 % too fast, the hat 4 % too slowly, and `learn.beyond.surface` is 0.05 here. Every run
is in the table, the best and the worst. Then come other bodies by three cameras, of which size and push are told
wrongly as well, by as much as intervals allow for. Then the surface is taken away, and reconstructed from photographs,
with the width of the default profile; and other truth that the learner was handed, one thing at a time. Last, what
error costs in time: fewer particles, frames or pixels, the grid, a field of stiffness, other ways down.

A run that is done stands in the .csv and is not done again, so this may be stopped at any time; remove the file to
begin anew. Times are processor time of one thread, for the machine is shared.
"""

import csv
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from learning_page import write
from learning_twins import DENSITY, FORCE, LENGTH, Twin, drawn, photographed, told_wrongly, twin_source

from physics3d.log import Log
from physics3d.metrics.image import psnr
from physics3d.world import World
from pipeline.hired import end_with_hirer
from pipeline.settings import compose
from pipeline.stage import build
from stages.fill import Fill
from stages.learn import Learn
from stages.render import Render
from stages.simulate import Simulate

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
SCENES = "carnation,cup,cord,hat,towel,jelly,cake"
WORDS = (
    "learn.search=9",  # over 16 times stiffer and softer: the start is a factor 10 off
    "learn.search_span=16.0",
    "learn.steps=0",
    "learn.polish=8",
    "learn.views_per_step=0",
    "learn.image_scale=1.0",
)
SHOWN = "carnation"  # whose truth is taken away, with three cameras
SURFACE = 0.05  # width of the stiffness by the filling: its frequencies are 0 to 4 % off
WRONG = 1.1  # density and force as given, of the true ones, where they are taken away
PARTS = ("bodies", "told", "shapes", "handed", "ways")  # of the benchmark: the 21 runs, and the tables below them
TOLD = "size and push"  # what is taken away where all that is assumed is wrong
TOLD_SEEDS = (1, 2, 3, 4)  # of other bodies than those of the first table
TOLD_BY = "half the frames"  # a third of the time, and the same answer
SHAPE = "shape"  # what is taken away where the surface is reconstructed
PHOTOGRAPHED = ("reconstruct.iterations=600", "reconstruct.max_gaussians=6000", "reconstruct.longest_side=240")
HANDED = ("nothing", "density", "force", "poissons_ratio", "tie of times", "ratio of mu to K", "all of these")


@dataclass(frozen=True, kw_only=True)
class Way:
    """How learning differs from what is usual here."""

    spacing: float = 1.0  # of particles, and of cells, times as wide
    frames: float = 1.0  # share of them
    solver: str = "auto"
    learn: dict[str, Any] = field(default_factory=dict)  # fields of the stage

    def of(self, learn: Learn) -> Learn:
        world: World = replace(learn.world, dx=self.spacing * learn.world.dx, solver=self.solver)
        assert learn.frames is not None
        return replace(learn, world=world, frames=round(self.frames * (learn.frames - 1)) + 1, **self.learn)


WAYS = {
    "particles 1.5 times as far apart": Way(spacing=1.5),
    "particles twice as far apart": Way(spacing=2.0),
    "half the frames": Way(frames=0.5),
    "a quarter of the frames": Way(frames=0.25),
    "pictures half as large": Way(learn={"image_scale": 0.5}),
    "by the grid": Way(solver="grid"),
    "a field of stiffness, 4 nodes": Way(learn={"nodes": 4}),
    "no search": Way(learn={"search": 0}),
    "the search alone": Way(learn={"polish": 0, "steps": 0}),
    "search, 15 steps of Adam, no polish": Way(learn={"polish": 0, "steps": 15}),
}
NAMED = {
    "E": "youngs_modulus", "mu": "branch_shear_modulus", "tau": "shear_relaxation_time", "nu": "poissons_ratio",
    "rho": "density",
}  # fmt: skip
COLUMNS = (
    "scene", "cameras", "seed", "taken", "moved_by", "particles", "density",
    *(f"{name}{of}" for name in NAMED for of in ("", "_start", "_found", "_low", "_high")),
    "still", "psnr", "seconds", "failed",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Run:
    """One body, and what of its truth the learner is not handed besides the material, or one of `WAYS`; "": a density
    that is drawn."""

    scene: str
    cameras: int
    seed: int
    taken: str = ""

    @property
    def key(self) -> tuple[str, ...]:
        return (self.scene, str(self.cameras), str(self.seed), self.taken)


def key(row: dict[str, str]) -> tuple[str, ...]:
    """`Run.key` of a row."""
    return tuple(row[name] for name in ("scene", "cameras", "seed", "taken"))


def main(words: list[str]) -> None:
    usual = {"scenes": SCENES, "cameras": "3,1,11", "seeds": "0", "parts": ",".join(PARTS), "workers": "2"}
    options = usual | dict(word.split("=", 1) for word in words)
    if unknown := options.keys() - usual.keys():
        raise SystemExit(f"error: {', '.join(unknown)} means nothing here; there are {', '.join(usual)}")
    if unknown := set(options["parts"].split(",")) - set(PARTS):
        raise SystemExit(f"error: parts={options['parts']}: there are {', '.join(PARTS)}")
    table = RESULTS / "learning.csv"
    rows = read(table)
    done = set(map(key, rows))
    every = list(runs(options))
    order = {run.key: i for i, run in enumerate(every)}
    place = lambda row: order.get(key(row), len(order))
    left = [run for run in every if run.key not in done]
    with tempfile.TemporaryDirectory(prefix="physics3d_learning_") as notes:
        log = Log(Path(notes), name="bench-learning")
        with ProcessPoolExecutor(
            int(options["workers"]), mp_context=get_context("spawn"), initializer=end_with_hirer
        ) as pool:
            found = as_completed([pool.submit(tried, run) for run in left])
            for one in log.progress(found, "runs", total=len(every), done=len(every) - len(left)):
                row = {name: "" for name in COLUMNS} | one.result()
                rows.append({name: f"{v:.5g}" if isinstance(v, float) else str(v) for name, v in row.items()})
                keep(table, rows)
                write(sorted(rows, key=place), RESULTS, len(every))
                log.info(", ".join(f"{name} {rows[-1][name]}" for name in COLUMNS if rows[-1][name]))
    write(sorted(rows, key=place), RESULTS, len(every))


def runs(options: dict[str, str]) -> Iterator[Run]:
    """The number of cameras changes slowly, so that a table that is not full has all scenes."""
    scenes, seeds, parts = (options[name].split(",") for name in ("scenes", "seeds", "parts"))
    for seed in seeds if "bodies" in parts else ():
        for cameras in options["cameras"].split(","):
            for scene in scenes:
                yield Run(scene=scene, cameras=int(cameras), seed=int(seed))
    for seed in TOLD_SEEDS if "told" in parts else ():
        for scene in scenes:
            yield Run(scene=scene, cameras=3, seed=seed, taken=TOLD)
    for seed in seeds if "shapes" in parts else ():
        for scene in scenes:
            yield Run(scene=scene, cameras=3, seed=int(seed), taken=SHAPE)
    for part, ways in (("handed", HANDED), ("ways", WAYS)):
        for taken in ways if part in parts and SHOWN in scenes else ():
            yield Run(scene=SHOWN, cameras=3, seed=0, taken=taken)


def tried(run: Run) -> dict[str, Any]:
    """Its row; a run that raises an error is one as well."""
    torch.set_num_threads(1)
    told = dict(scene=run.scene, cameras=run.cameras, seed=run.seed, taken=run.taken)
    try:
        return told | learned(run)
    except ValueError as error:
        return told | dict(failed=str(error).replace("\n", " "))


def learned(run: Run) -> dict[str, Any]:
    """Draw the body, learn from its films, and foretell the push that was held out. Raises ValueError as stages do."""
    config, _ = compose([f"scene={run.scene}", *WORDS, *PHOTOGRAPHED])
    of = lambda name, config=config: build(config[name], "cpu", name)
    source = twin_source(build(config["scene"]["source"], "cpu", "scene.source"), run.scene)
    twin = drawn(run.scene, source, of("world"), cameras=run.cameras, seed=run.seed, log=Log(None))
    if run.taken == TOLD:
        twin = told_wrongly(twin, cameras=run.cameras, seed=run.seed)
    capture, gaussians, fill, learn = twin.capture, twin.capture.gaussians, of("fill"), of("learn")
    assert isinstance(fill, Fill) and isinstance(learn, Learn) and gaussians is not None
    frames = len(capture.takes[0].videos[0])
    beyond = replace(learn.beyond, surface=SURFACE, density=DENSITY, length=0.0)
    learn = replace(learn, world=twin.given, frames=frames, beyond=beyond, guess_widths={})
    way = WAYS.get(run.taken, Way())
    began = time.process_time()
    if run.taken == SHAPE:
        capture = photographed(twin, source, run.seed)
        gaussians = of("reconstruct")(capture, log=Log(None))
        learn = replace(learn, beyond=replace(beyond, surface=of("learn").beyond.surface))
    elif run.taken == TOLD:
        learn = WAYS[TOLD_BY].of(replace(learn, beyond=replace(beyond, length=LENGTH, force=FORCE)))
    elif run.taken in WAYS:
        learn = way.of(without(HANDED[0], learn, twin))
    elif run.taken:
        learn = without(run.taken, learn, twin)
        capture = replace(
            capture, takes=tuple(replace(take, excitation=pushed(run.taken, take.excitation)) for take in capture.takes)
        )
    body = replace(fill, spacing=way.spacing * twin.spacing)(capture, gaussians, None, log=Log(None))
    estimate = learn(capture, gaussians, body, log=Log(None))
    seconds = time.process_time() - began
    take = capture.take("evaluate")
    assert take is not None
    simulate = Simulate(world=learn.world, frames=frames, fps=take.fps, excitation=take.excitation or ())
    motion = simulate(body, estimate, log=Log(None))
    with tempfile.TemporaryDirectory(prefix="physics3d_learning_") as notes:  # a film is kept in a folder
        seen = Render(interior=False)(capture, gaussians, body, motion, log=Log(Path(notes), quiet=True)).frames[0]
    real, density = take.videos[0], lambda world: {"density": world.density}
    start, truth = learn.world.start | density(learn.world), twin.world.start | density(twin.world)
    row = dict(
        moved_by=twin.moved_by, particles=len(body.position), density=learn.world.density / twin.world.density,
        still=psnr(real[:1].expand_as(real).contiguous(), real), psnr=psnr(seen, real), seconds=seconds,
    )  # fmt: skip
    for short, name in NAMED.items():
        if found := estimate.intervals.get(name):
            value = estimate.numbers[name]
            row |= {
                short: truth[name],
                f"{short}_start": start[name],
                f"{short}_found": value,
                f"{short}_low": found.low,
                f"{short}_high": found.high,
            }
    return row


def without(taken: str, learn: Learn, twin: Twin) -> Learn:
    """The learner who is handed all of the truth but this."""
    every = taken == HANDED[-1]
    gone = lambda name: every or taken == name
    beyond = replace(learn.beyond, density=DENSITY if gone("density") else 0.0, force=DENSITY if gone("force") else 0.0)
    world: World = replace(learn.world, density=twin.world.density * (WRONG if gone("density") else 1.0))
    names, ties = learn.learn, learn.ties
    if gone("poissons_ratio"):
        names = (*names, "poissons_ratio")
        world = replace(world, start=world.start | {"poissons_ratio": world.start["poissons_ratio"] - 0.1})
    if gone("tie of times"):
        ties = tuple(tie for tie in ties if "shear_relaxation_time" not in tie)
    if gone("ratio of mu to K"):
        ties = tuple(tie for tie in ties if "branch_shear_modulus" not in tie)
    return replace(learn, world=world, learn=names, ties=ties, beyond=beyond)


def pushed(taken: str, excitation: Any) -> Any:
    """The push as the learner is told of it."""
    if taken not in ("force", HANDED[-1]):
        return excitation
    return tuple(replace(one, force=tuple(WRONG * f for f in one.force)) for one in excitation)


def read(table: Path) -> list[dict[str, str]]:
    """The runs that are done."""
    if not table.exists():
        return []
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def keep(table: Path, rows: list[dict[str, str]]) -> None:
    """All of them, or as it was."""
    half = table.with_suffix(".part")
    with half.open("w", newline="") as file:
        out = csv.DictWriter(file, COLUMNS)
        out.writeheader()
        out.writerows(rows)
    half.replace(table)


if __name__ == "__main__":
    main(sys.argv[1:])
