"""The solver without a grid against closed forms and against finite elements.

    make bench-swaying   ->   docs/results/swaying.csv, swaying_must.csv, .md, .png, swaying_poke.png
    make bench-swaying ARGS="rows=beam,poke"   prints these alone, and leaves the page as it is

Beams: Timoshenko (transfer matrix), clamped along an axis and free where turned. Plate, L- and Y-shape: quadratic
hexahedra on a mesh that fits, by scikit-fem. The plant of the carnation twin: quadratic tetrahedra by scikit-fem on a
mesh by fTetWild (`pip install pytetwild pyvista`), or what three such meshes gave once, to half a per cent.
Bodies are filled as the pipeline fills them: a lattice of `spacing` through a closed surface. Times are processor time
of one thread, for the machine is shared.
"""

import contextlib
import csv
import importlib.util
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "modes"))
import swaying_motion
from machine import machine
from modes_bodies import row, section, timoshenko, turned_beam, world

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.filling.cells import solid_cells
from physics3d.log import Log
from physics3d.modes.rollout import Solver
from physics3d.scenes.flower import SOIL, plant

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
YOUNG, POISSON, DENSITY = 1.5e5, 0.3, 300.0
PLANT = [1.09, 1.09, 3.77, 9.5]  # of the tetrahedra, where fTetWild is missing [Hz]


def main(words: list[str]) -> None:
    options = dict(word.split("=", 1) for word in words)
    chosen = options["rows"].split(",") if "rows" in options else [*BODIES, *MOTIONS]
    torch.set_num_threads(1)
    rows: list[dict] = []
    must: list[swaying_motion.Row] = []
    for name in chosen:
        for found in BODIES[name]() if name in BODIES else ():
            print(found, flush=True)
            rows.append(found)
        for law in MOTIONS[name](rows) if name in MOTIONS else ():
            print(law, flush=True)
            must.append(law)
    if "rows" not in options:  # a page tells of all of them
        write(rows, [*of_frequencies(rows), *must])


def of_frequencies(rows: list[dict]) -> list[swaying_motion.Row]:
    """The bars for the largest error of the first frequencies, of the reduced model."""
    kinds = (("clamped square beam", 2.0), ("free", 2.0), ("clamped plate", 3.0), ("L-shape", 3.0), ("Y-shape", 3.0))
    found = []
    for kind, bar in (*kinds, ("the twin's plant", 5.0)):
        worst = [100 * r["error_reduced"] for r in rows if r["body"].startswith(kind)]
        if worst:
            found.append((f"{kind}: frequencies against {rows_truth(rows, kind)}", max(worst), bar, "%"))
    return found


def rows_truth(rows: list[dict], kind: str) -> str:
    return next(r["truth"] for r in rows if r["body"].startswith(kind))


def measured(body: str, truth: list[float], of: str, skip: int = 0, pair: bool = False, **more) -> dict:
    """A row: frequencies of the splines and of the reduced model against a truth [Hz]."""
    begin = time.process_time()
    solver = Solver.of(log=Log(None), **more)
    seconds = time.process_time() - begin
    full, reduced = (omega[skip:] / (2 * math.pi) for omega in (solver.model.exact_omega, solver.model.omega))
    if pair:  # both planes of bending have the same
        truth = [f for f in truth for _ in range(2)]
    n = len(truth)
    off = lambda found: max(abs(a / b - 1) for a, b in zip(found[:n], truth))
    return dict(
        body=body, truth=of, exact=" ".join(f"{f:.3g}" for f in truth), splines=" ".join(f"{f:.3g}" for f in full[:n]),
        reduced=" ".join(f"{f:.3g}" for f in reduced[:n]), error=off(full), error_reduced=off(reduced),
        fields=solver.model.count, points=len(solver.model.weight), seconds=seconds,
    )  # fmt: skip


def beams():
    """Clamped, along an axis, one particle across."""
    thick = 0.006
    for slender in (10, 30, 60):
        area, inertia, shear = section("square", thick, POISSON)
        truth = timoshenko(slender * thick, area, inertia, YOUNG, POISSON, DENSITY, shear, free=False)
        position, volume = row(slender, thick)
        yield measured(
            f"clamped square beam, L/h {slender}, one particle across", truth, "Timoshenko", pair=True,
            world=world(YOUNG, POISSON), position=position, volume=volume,
        )  # fmt: skip


def turned():
    thick, slender = 0.012, 20
    for shape in ("square", "round"):
        for degrees in (0, 30, 45):
            area, inertia, shear = section(shape, thick, POISSON)
            truth = timoshenko(slender * thick, area, inertia, YOUNG, POISSON, DENSITY, shear, free=True)
            position, volume, matter = turned_beam(slender * thick, thick, shape, degrees, 0.006, 0.37)
            yield measured(
                f"free {shape} beam, L/h {slender}, two particles across, turned by {degrees} degrees", truth,
                "Timoshenko", skip=6, pair=True, world=world(YOUNG, POISSON, boundaries=()), position=position,
                volume=volume, matter=matter,
            )  # fmt: skip


Solid = Callable[[np.ndarray], np.ndarray]  # points [n, 3] m -> which are inside


def boxes(name: str, size: tuple[float, float, float], solid: Solid, cells: tuple[int, int, int]):
    """What is `solid` of a box of this size [m], clamped at x = 0; the mesh of the truth has so many cells."""

    def inside(x: np.ndarray) -> np.ndarray:
        return ((x >= 0) & (x <= size)).all(1) & solid(x)

    truth = hexahedra(size, solid, cells)
    clamp = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.0, 1.0, 1.0))
    for spacing in (0.004, 0.006):
        corners = np.array([[0.0, 0.0, 0.0], size])
        position, volume, matter = solid_cells(inside, corners + np.array([[0.0], [0.3 * spacing]]), spacing)
        yield measured(
            f"{name}, spacing {1e3 * spacing:g} mm", truth, "hexahedra",
            world=world(YOUNG, POISSON, boundaries=(clamp,)), position=torch.from_numpy(position),
            volume=torch.from_numpy(volume), matter=matter,
        )  # fmt: skip


def poked() -> list[swaying_motion.Row]:
    found = swaying_motion.poke(*plant_solid())
    draw_poke(found)
    return swaying_motion.poked(found)


def whole(x: np.ndarray) -> np.ndarray:
    return np.ones(len(x), bool)


def angle(x: np.ndarray) -> np.ndarray:
    return (x[:, 0] <= 0.012) | (x[:, 2] <= 0.012)


def fork(x: np.ndarray) -> np.ndarray:
    stem = (x[:, 0] <= 0.048) & (x[:, 1] >= 0.036) & (x[:, 1] <= 0.048)
    bar = (x[:, 0] >= 0.048) & (x[:, 0] <= 0.060)
    prongs = (x[:, 0] >= 0.060) & ((x[:, 1] <= 0.012) | (x[:, 1] >= 0.072))
    return stem | bar | prongs


def plants():
    """The carnation twin's own solids."""
    inside, vertices = plant_solid()
    truth = tetrahedra(inside, vertices)
    clamp = FixedRegion(lower=(-0.1, -0.1, -0.1), upper=(0.1, 0.1, SOIL))
    for spacing in (0.004, 0.005, 0.006, 0.008):
        position, volume, matter = solid_cells(inside, vertices, spacing)
        yield measured(
            f"the twin's plant, spacing {1e3 * spacing:g} mm", truth, "tetrahedra",
            world=world(YOUNG, POISSON, boundaries=(clamp,)), position=torch.from_numpy(position),
            volume=torch.from_numpy(volume), matter=matter,
        )  # fmt: skip


def plant_solid() -> tuple[Solid, np.ndarray]:
    """(which points [m, 3] are inside one of the twin's solids, vertices of their surfaces)."""
    from physics3d.open3d_import import open3d

    o3d = open3d()
    _, solids = plant(0)
    scenes = []
    for mesh in solids:
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
        scenes.append(scene)

    def inside(x: np.ndarray) -> np.ndarray:
        query = o3d.core.Tensor(x.astype(np.float32))
        return np.any([s.compute_occupancy(query, nthreads=1).numpy() > 0.5 for s in scenes], axis=0)

    return inside, np.concatenate([mesh.vertices for mesh in solids]).astype(float)


BODIES = {
    "beam": beams,
    "turned": turned,
    "plate": lambda: boxes("clamped plate 120 x 60 x 6 mm", (0.12, 0.06, 0.006), whole, (20, 10, 1)),
    "L": lambda: boxes("L-shape, arms of 96 mm, 12 mm square", (0.096, 0.012, 0.096), angle, (16, 2, 16)),
    "Y": lambda: boxes("Y-shape of 96 mm, 12 mm square", (0.096, 0.084, 0.012), fork, (16, 14, 2)),
    "plant": plants,
}


MOTIONS: dict[str, Callable[[list[dict]], list[swaying_motion.Row]]] = {
    "spread": swaying_motion.spread,
    "bending": lambda rows: swaying_motion.bending(),
    "bar": lambda rows: swaying_motion.bar(),
    "energy": lambda rows: swaying_motion.energy(),
    "poke": lambda rows: poked(),
    "speed": lambda rows: swaying_motion.speed(*plant_solid()),
}


# --- finite elements by a library -------------------------------------------------------------------------------------


def hexahedra(size, solid: Solid, cells) -> list[float]:
    """First four frequencies [Hz] of what is solid of a box, clamped at x = 0: 27 nodes to a hexahedron."""
    from skfem import Basis, ElementHex2, ElementVector, MeshHex

    mesh = MeshHex.init_tensor(*(np.linspace(0, s, n + 1) for s, n in zip(size, cells)))
    mesh = mesh.restrict(np.flatnonzero(solid(mesh.p[:, mesh.t].mean(1).T)))
    return frequencies(Basis(mesh, ElementVector(ElementHex2())), lambda x: x[0] < 1e-9)


def tetrahedra(inside, vertices) -> list[float]:
    """First four frequencies [Hz] of the twin's plant above the soil: 10 nodes to a tetrahedron."""
    if importlib.util.find_spec("pytetwild") is None:
        return PLANT
    import pytetwild
    from skfem import Basis, ElementTetP2, ElementVector, MeshTet

    from physics3d.open3d_import import open3d

    o3d = open3d()
    _, solids = plant(0)
    v, f, n = [], [], 0
    for solid in solids:
        mesh = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(solid.vertices.astype(float)), o3d.utility.Vector3iVector(solid.faces)
        )
        mesh.remove_duplicated_vertices().remove_degenerate_triangles()
        v.append(np.asarray(mesh.vertices)), f.append(np.asarray(mesh.triangles) + n)
        n += len(v[-1])
    with tempfile.TemporaryDirectory() as notes, contextlib.chdir(notes):  # fTetWild leaves a file where it runs
        points, cells = pytetwild.tetrahedralize(
            np.concatenate(v), np.concatenate(f).astype(np.int32), edge_length_fac=0.03, optimize=True
        )[:2]
    middle = points[cells].mean(1)
    cells = cells[inside(middle) & (middle[:, 2] > SOIL - 0.004)]
    mesh = MeshTet(np.ascontiguousarray(points.T), np.ascontiguousarray(cells.T)).remove_unused_nodes()
    return frequencies(Basis(mesh, ElementVector(ElementTetP2())), lambda x: x[2] < SOIL)


def frequencies(basis, clamped) -> list[float]:
    """The lowest four [Hz]."""
    from scipy.sparse.linalg import eigsh
    from skfem import BilinearForm, condense
    from skfem.helpers import ddot, dot, eye, sym_grad, trace

    mu, lam = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))

    @BilinearForm
    def elastic(u, v, w):
        e = sym_grad(u)
        return ddot(2 * mu * e + lam * eye(trace(e), 3), sym_grad(v))

    @BilinearForm
    def inertia(u, v, w):
        return DENSITY * dot(u, v)

    held = basis.get_dofs(nodes=np.flatnonzero(clamped(basis.mesh.p))).flatten()
    held = np.unique(np.concatenate([held, np.flatnonzero(clamped(basis.doflocs))]))
    K, M, *_ = condense(elastic.assemble(basis), inertia.assemble(basis), D=held)
    found = eigsh(K.tocsc(), k=4, M=M.tocsc(), sigma=0.0, return_eigenvectors=False)
    return [float(f) for f in np.sqrt(np.sort(found)) / (2 * math.pi)]


# --- the page ---------------------------------------------------------------------------------------------------------


def write(rows: list[dict], must: list[swaying_motion.Row]) -> None:
    title = f"{machine('cpu')}, 1 thread"
    names = ("what", "measured", "bar", "unit")
    laws = [dict(zip(names, law)) for law in must]
    for name, table in (("swaying.csv", rows), ("swaying_must.csv", laws)):
        with (RESULTS / name).open("w", newline="") as file:
            file.write(f"# {title}\n")
            columns = csv.DictWriter(file, list(table[0]) if table else names)
            columns.writeheader()
            columns.writerows(table)
    if rows:
        draw(rows)
    lines = ["# Things that are held and sway: the solver without a grid", "", "Made by `make bench-swaying`.", ""]
    lines += [f"Machine: {title}. Shared with other work.", "", *__doc__.split("\n\n", 2)[2].strip().splitlines(), ""]
    lines += ["## What must hold", "", "| what | measured | bar | holds |", "|---|---|---|---|"]
    for what, measured, bar, unit in must:
        limit, holds = (f"{bar:.3g} {unit}", "yes" if measured <= bar else "**no**") if bar < math.inf else ("", "")
        lines.append(f"| {what} | {measured:.3g} {unit} | {limit} | {holds} |")
    lines += ["", *swaying_motion.__doc__.split("\n\n")[1].strip().splitlines(), ""]
    if (RESULTS / "swaying_poke.png").exists():
        lines += ["![error against run time](swaying_poke.png)", ""]
    lines += ["## Frequencies", "", "![errors](swaying.png)", ""]
    lines += ["| body | truth | exact [Hz] | splines | reduced | error | reduced | fields | points | to build [s] |"]
    lines += ["|---|---|---|---|---|---|---|---|---|---|"]
    for r in rows:
        numbers = [f"{100 * r['error']:.1f} %", f"{100 * r['error_reduced']:.1f} %", r["fields"], r["points"]]
        cells = [r["body"], r["truth"], r["exact"], r["splines"], r["reduced"], *numbers, f"{r['seconds']:.1f}"]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    lines += ["", "Errors are the largest of the frequencies in the row.", ""]
    (RESULTS / "swaying.md").write_text("\n".join(lines))


def draw_poke(found: list[swaying_motion.Poked]) -> None:
    """Error against run time, one line a solver."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axis = figure.subplots()
    for solver, mark in (("modes", "o-"), ("grid", "s-")):
        own = [one for one in found if one.solver == solver]
        axis.loglog([one.seconds for one in own], [100 * one.error for one in own], mark, label=solver)
        for one in own:
            axis.annotate(f" {1e3 * one.spacing:g} mm", (one.seconds, 100 * one.error), fontsize=7)
    axis.set(xlabel="processor time, all included [s]", ylabel="error of the displacement [%]")
    axis.set_title("the carnation twin's poke, against finite elements", fontsize=9)
    axis.legend()
    figure.savefig(RESULTS / "swaying_poke.png", dpi=100)


def draw(rows: list[dict]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.32 * len(rows) + 1.2), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(rows))
    for shift, name in ((-0.18, "error"), (0.18, "error_reduced")):
        label = {"error": "splines", "error_reduced": "reduced"}[name]
        axis.barh(place + shift, [100 * r[name] for r in rows], 0.34, label=label)
    axis.set_yticks(place, [r["body"] for r in rows], fontsize=7)
    axis.invert_yaxis()
    axis.set(xlabel="largest error of the frequencies [%]")
    axis.legend(fontsize=8)
    figure.savefig(RESULTS / "swaying.png", dpi=100)


if __name__ == "__main__":
    main(sys.argv[1:])
