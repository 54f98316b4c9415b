"""Which solver is taken, and what is said about it."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from modes_bodies import CLAMP, row, world

from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.boundaries.sequential_release import SequentialRelease
from physics3d.log import LINES, Log
from physics3d.materials.von_mises import VonMises
from physics3d.mpm.rollout import rollout
from physics3d.solver import motion_of

FALLS = (0.0, 0.0, -9.81)
PARAMETERS = {"youngs_modulus": torch.tensor(1e4), "poissons_ratio": torch.tensor(0.3)}


def floor(height: float) -> HalfSpace:
    return HalfSpace(point=(0.0, 0.0, height), normal=(0.0, 0.0, 1.0))


def elastic(**changes):
    return world(1e4, 0.3, **(dict(solver="auto") | changes))


def lines(folder: Path) -> list[str]:
    return [line.split(" s  ", 1)[1] for line in (folder / LINES).read_text().splitlines()]


PLASTIC = VonMises()
RELEASE = SequentialRelease(
    lower=(0.03, -1.0, -1.0), upper=(1.0, 1.0, 1.0), direction=(1.0, 0.0, 0.0), layers=2, interval=0.1
)
CASES = {
    "held, nothing near": (elastic(), "modes", "touches nothing"),
    "free, nothing near": (elastic(boundaries=(), gravity=FALLS), "modes", "touches nothing"),
    "held above a floor": (elastic(boundaries=(CLAMP, floor(-0.5)), gravity=FALLS), "modes", "touches nothing"),
    "asked for": (elastic(solver="grid"), "grid", "world.solver says so"),
    "falls on a floor": (elastic(boundaries=(floor(-0.1),), gravity=FALLS), "grid", "falls towards its HalfSpace"),
    "stands on a floor": (elastic(boundaries=(CLAMP, floor(-0.005))), "grid", "touches the HalfSpace"),
    "flows": (elastic(material=PLASTIC, start=PLASTIC.example), "grid", "VonMises"),
    "a boundary of nodes": (
        elastic(boundaries=(CLAMP, RELEASE)), "grid", "SequentialRelease"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_auto_takes_the_modes_where_nothing_needs_the_grid_and_says_why_in_a_line(case, tmp_path):
    asked, solver, why = CASES[case]
    motion = motion_of(asked, *row(6, 0.01), device="cpu", log=Log(tmp_path, quiet=True))
    assert (motion.modes is not None) == (solver == "modes")
    said = [line for line in lines(tmp_path) if line.startswith("solver:")]
    assert len(said) == 1 and said[0].startswith(f"solver: {solver}, for") and why in said[0]
    if solver == "grid" and asked.solver == "auto":
        with pytest.raises(ValueError, match=r"world\.solver is 'modes'"):
            motion_of(replace(asked, solver="modes"), *row(6, 0.01), device="cpu", log=Log(None))


def test_a_body_that_comes_to_touch_a_wall_is_moved_by_the_grid_and_this_is_said_once(tmp_path):
    """To the last digit: what takes over is the solver that would have been asked for."""
    position, volume = row(6, 0.01)
    near = elastic(boundaries=(CLAMP, floor(-0.008)), gravity=FALLS)
    motion = motion_of(near, position, volume, device="cpu", log=Log(tmp_path, quiet=True))
    assert motion.modes is not None
    for _ in range(2):
        found = motion(PARAMETERS, frames=4, frame_dt=0.02, log=Log(None))
    by_grid = rollout(near, PARAMETERS, position, volume, frames=4, frame_dt=0.02, device="cpu", log=Log(None))
    assert torch.equal(found.position, by_grid.position)
    timing = dict(velocity=None, frames=4, frame_dt=0.02)
    assert motion.passes_a_wall(PARAMETERS, **timing)
    stiff = PARAMETERS | {"youngs_modulus": torch.tensor(1e7)}  # it sags by a thousandth of that
    assert not motion.passes_a_wall(stiff, **timing)
    warned = [line for line in lines(tmp_path) if "the grid takes over" in line]
    assert len(warned) == 1 and "reaches the HalfSpace in frame" in warned[0]


def test_what_the_modes_cannot_find_is_said_once_and_without_a_remedy_that_is_taken_already(tmp_path):
    """A force of thousands of times the body's stiffness, in steps that may not be halved, at two moduli and so, as a
    rule, in two frames."""
    blow = Impulse(force=(0.0, 60.0, 0.0), centre=(0.055, 0.0, 0.0), radius=0.012, duration=0.1)
    asked = elastic(dt=0.02)
    motion = motion_of(asked, *row(6, 0.01), excitation=(blow,), device="cpu", log=Log(tmp_path, quiet=True))
    for modulus in (1e4, 2e4):
        with suppress(ValueError):  # the grid may refuse it too
            motion(PARAMETERS | {"youngs_modulus": torch.tensor(modulus)}, frames=4, frame_dt=0.02, log=Log(None))
    warned = [line for line in lines(tmp_path) if "the grid takes over" in line]
    assert len(warned) == 1 and "the modes find no motion (frame " in warned[0] and "take " not in warned[0]


def test_both_solvers_tell_the_same_of_a_poke():
    """A beam three particles across and its sway in a tenth of a second, one solver being the truth of the other."""
    x = (torch.arange(30, dtype=torch.float64) + 0.5) * 0.004
    y = (torch.arange(5, dtype=torch.float64) - 2) * 0.004
    position = torch.cartesian_prod(x, y, y)
    volume = torch.full((len(position),), 0.004**3, dtype=torch.float64)
    poke = Impulse(force=(0.0, 0.0, 0.03), centre=(0.118, 0.0, 0.0), radius=0.02, duration=0.05)
    timing = dict(frames=6, frame_dt=0.02, log=Log(None))
    moved = {}
    for solver in ("grid", "modes"):
        asked = world(1e5, 0.3, solver=solver, dx=0.008, precision="float32")
        body = position.float(), volume.float()
        motion = motion_of(asked, *body, excitation=(poke,), device="cpu", log=Log(None))
        end = motion(PARAMETERS | {"youngs_modulus": torch.tensor(1e5)}, **timing)
        moved[solver] = (end.position - end.rest_position).double()
    off = (moved["grid"] - moved["modes"]).norm() / moved["modes"].norm()
    # two and a half cells across are 4 % of a frequency on the grid, of 4 Hz: 0.1 rad of phase at the end
    assert 0 < float(off) < 0.1


def test_a_body_that_is_pushed_harder_moves_as_one_that_was_built_for_that_push():
    """... so learning asks what a larger force would do without building the body again; what is accelerated as a whole
    does not know of it. To 1e-6 of the motion: the same basis, found from loads of another length."""
    poke = Impulse(force=(0.0, 2e-4, 1e-4), centre=(0.055, 0.0, 0.0), radius=0.012, duration=0.1)
    shake = Impulse(acceleration_of_each=(0.0, 0.0, 1.0), lower=(0.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0), duration=0.1)
    of = lambda push: motion_of(elastic(), *row(6, 0.01), excitation=push, device="cpu", log=Log(None)).modes
    run = lambda solver: solver.rollout(PARAMETERS, frames=6, frame_dt=0.05, log=Log(None)).position
    harder = replace(poke, force=(0.0, 3 * 2e-4, 3 * 1e-4))
    once, built, derived = run(of((poke, shake))), run(of((harder, shake))), run(of((poke, shake)).pushed(3.0))
    moved = float((built - built[0]).norm(dim=2).max())
    assert float((derived - built).abs().max()) < 1e-6 * moved
    assert float((once - built).abs().max()) > 0.1 * moved
