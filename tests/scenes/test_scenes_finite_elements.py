"""Finite elements that move a twin: beams in closed form; and the file that keeps their answer."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skfem import MeshTet

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.scenes import finite_elements, reference_motion
from physics3d.scenes.carnation import CarnationTwin
from physics3d.world import World
from pipeline.fingerprint import fingerprint
from pipeline.settings import compose
from pipeline.stage import build
from pipeline.twin import handed_over

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "modes"))
from modes_bodies import section, timoshenko

YOUNG, POISSON, DENSITY = 1.5e5, 0.3, 300.0
THICK, LENGTH = 0.012, 0.12  # of a beam that stands on z = 0 [m]
CLAMP = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 0.0))
TIP = (0.0, 0.0, LENGTH)


def beam() -> finite_elements.Body:
    across, along = np.linspace(-THICK / 2, THICK / 2, 3), np.linspace(0, LENGTH, 25)
    return finite_elements.on(MeshTet.init_tensor(across, across, along), lambda x: x[:, 2] <= 1e-9)


def world(branch: float, relaxation: float) -> World:
    """A body whose branch is `branch` times as stiff as its elastic spring."""
    mu, K = YOUNG / (2 * (1 + POISSON)), YOUNG / (3 * (1 - 2 * POISSON))
    start = dict(
        youngs_modulus=YOUNG, poissons_ratio=POISSON, branch_shear_modulus=branch * mu, branch_bulk_modulus=branch * K,
        shear_relaxation_time=relaxation, bulk_relaxation_time=relaxation,
    )  # fmt: skip
    return World(
        material=Viscoelastic(), density=DENSITY, start=start, dx=0.01, gravity=(0.0, 0.0, 0.0), boundaries=(CLAMP,)
    )


def first(young: float) -> float:
    """Hz, by Timoshenko."""
    area, inertia, shear = section("square", THICK, POISSON)
    return timoshenko(LENGTH, area, inertia, young, POISSON, DENSITY, shear, free=False)[0]


def test_a_clamped_beam_has_the_frequencies_of_timoshenko():
    """The clamp also hinders the section from widening, which the beam does not know: 0.7 per cent. A stuck branch adds
    its own stiffness."""
    for branch in (1e-9, 0.5):
        found = finite_elements.frequencies(beam(), world(branch, 0.1), 2)
        expected = first((1 + branch) * YOUNG)
        assert found == pytest.approx([expected, expected], rel=0.01)


def test_a_beam_that_a_box_holds_in_the_middle_is_two_of_half_the_length():
    """Twice two directions; stubbier ones, whose clamp hinders the section more: 1.5 per cent."""
    body = replace(beam(), held=np.array([], int))
    nodes = body.basis.doflocs.T
    boxes = finite_elements._held(
        replace(world(1e-9, 0.1), boundaries=(FixedRegion(lower=(-1, -1, 0.0599), upper=(1, 1, 0.0601)),))
    )
    body = replace(body, held=np.flatnonzero(finite_elements._inside(boxes, nodes)))
    found = finite_elements.frequencies(body, world(1e-9, 0.1), 4)
    area, inertia, shear = section("square", THICK, POISSON)
    half = timoshenko(LENGTH / 2, area, inertia, YOUNG, POISSON, DENSITY, shear, free=False)[0]
    assert found == pytest.approx([half] * 4, rel=0.015)


@pytest.mark.parametrize("box", [False, True])
def test_a_push_is_spread_over_the_mass_it_takes_hold_of(box):
    """The whole force, at the middle of that part: of a beam's upper quarter."""
    body = beam()
    where = dict(lower=(-1.0, -1.0, 0.09), upper=(1.0, 1.0, 1.0)) if box else dict(centre=(0, 0, 1.09), radius=1.0)
    push = Impulse(force=(1.0, 2.0, 3.0), duration=0.1, **where)
    load = finite_elements._load(body, world(1e-9, 0.1), (push,))[1].reshape(-1, 3)
    np.testing.assert_allclose(load.sum(0), [1, 2, 3], rtol=1e-9)
    height = load[:, 0] @ body.basis.doflocs[2] / load[:, 0].sum()
    assert height == pytest.approx(0.105, abs=1e-4)  # functions of quadratic elements add up to the height itself


def test_a_beam_that_was_pushed_swings_as_an_oscillator_with_a_branch():
    """The first mode is x'' + w^2 x + g^2 int x' exp(-(t-s)/tau) ds = f, w and g those of spring and branch alone: here
    integrated to round-off. The second mode is 6.3 times as
    fast, so that a force on the tip moves it by 1/39 as much, and by twice that where it overshoots."""
    from scipy.integrate import solve_ivp

    branch, tau, frames, fps, duration = 0.5, 0.1, 24, 40.0, 0.1
    body = beam()
    push = Impulse(force=(2e-4, 0.0, 0.0), centre=TIP, radius=0.02, duration=duration)
    films = finite_elements.swing(body, world(branch, tau), (push,), frames=frames, fps=fps, steps=6, log=Log(None))
    tip = np.argmin(np.linalg.norm(body.basis.doflocs.T - np.array(TIP), axis=1))
    moved = films[:, tip, 0]
    w2 = (2 * math.pi * first(YOUNG)) ** 2

    def rates(t, y):  # displacement, speed, stretch of the branch's spring
        return [y[1], (t < duration) - w2 * (y[0] + branch * y[2]), y[1] - y[2] / tau]

    time = np.arange(frames) / fps
    exact = solve_ivp(rates, (0, time[-1]), [0, 0, 0], t_eval=time, max_step=1e-3, rtol=1e-8).y[0]
    scale = (moved @ exact) / (exact @ exact)
    assert scale > 0 and np.abs(moved - scale * exact).max() < 0.06 * np.abs(moved).max()


def test_what_lies_in_the_tetrahedra_is_carried_by_them():
    """A field that is quadratic is that of the elements themselves, and so is its gradient."""
    body = beam()
    X = body.basis.doflocs.T
    field = lambda x: np.stack([x[:, 0] * x[:, 2], x[:, 1] ** 2, x[:, 0] - x[:, 2] ** 2], 1)
    place = np.random.default_rng(0).uniform((-0.005, -0.005, 0.001), (0.005, 0.005, 0.119), (50, 3))
    x, F = finite_elements.carried(body, field(X)[None], place)
    a, b, c = place.T
    zero = 0 * a
    slope = np.stack(
        [np.stack([c, zero, a], 1), np.stack([zero, 2 * b, zero], 1), np.stack([1 + zero, zero, -2 * c], 1)], 1
    )
    np.testing.assert_allclose(x[0], place + field(place), atol=1e-12)
    np.testing.assert_allclose(F[0], np.eye(3) + slope, atol=1e-9)


@pytest.mark.parametrize("name", sorted(path.stem for path in reference_motion.FOLDER.glob("*.npz")))
def test_a_motion_that_is_kept_is_that_of_its_scene_as_it_is_and_of_no_other(name):
    """All frames that the scene asks for; what is held stays; a stiffer thing, or a thicker one, is moved otherwise."""
    if name == "handed_over":
        twin = handed_over()
    else:
        config, _ = compose([f"scene={name}"])
        twin = build(config["scene"]["source"], "cpu", "scene.source")
    world = twin.world() if isinstance(twin, CarnationTwin) else twin.world
    kept, pokes, solids = reference_motion.path_of(name), twin.pokes(), twin.solids()
    asked = dict(frames=twin.frames, fps=twin.fps)
    found = reference_motion.recorded(kept, world, pokes, solids, **asked)
    assert found is not None, f"the twin has changed since; make reference-motion SCENE={name}"
    moved, made = found
    assert "finite elements" in made
    for take in moved.values():
        hold = world.boundaries[0]
        still = ((take.place > np.array(hold.lower)) & (take.place < np.array(hold.upper) - 1e-6)).all(1)
        np.testing.assert_allclose(take.position[0], take.place, rtol=0, atol=1e-9)  # rounding
        assert np.abs(take.position - take.place)[:, still].max() < 2e-5  # of half precision
        assert np.abs(take.position - take.place).max() > 0.01
        assert np.linalg.det(take.deformation).min() > 0.5
    stiffer = replace(world, start=world.start | {"youngs_modulus": 1.01 * world.start["youngs_modulus"]})
    assert reference_motion.recorded(kept, stiffer, pokes, solids, **asked) is None
    harder = {
        role: tuple(replace(one, force=tuple(1.01 * f for f in one.force)) for one in poke)
        for role, poke in pokes.items()
    }
    assert reference_motion.recorded(kept, world, harder, solids, **asked) is None
    thicker = [replace(mesh, vertices=1.01 * mesh.vertices) for mesh in solids]
    assert reference_motion.recorded(kept, world, pokes, thicker, **asked) is None
    for timing in (dict(frames=10_000, fps=twin.fps), dict(frames=5, fps=0.7 * twin.fps)):
        assert reference_motion.recorded(kept, world, pokes, solids, **timing) is None


@pytest.mark.parametrize("name", ["carnation", "hat", "bread", "rubber"])
def test_a_twin_names_the_motion_it_would_take_if_it_were_there(name):
    """The pipeline remembers which files a source reads: one that is filed later must change what it computes."""
    config, _ = compose([f"scene={name}"])
    twin = build(config["scene"]["source"], "cpu", "scene.source")
    twin = replace(twin, **{"motion" if isinstance(twin, CarnationTwin) else "name": "unheard_of"})
    (file,) = twin.files()
    before, after = (fingerprint({"scene": name}, [], files=[("motion", Path(f))]) for f in (file, __file__))
    assert not Path(file).exists() and before != after


def test_a_seed_paints_and_scatters_petals_and_leaves_the_motion():
    """What deforms is the same."""
    twin = CarnationTwin(seed=3)
    kept = reference_motion.path_of("carnation")
    asked = dict(frames=twin.frames, fps=twin.fps)
    assert reference_motion.recorded(kept, twin.world(), twin.pokes(), twin.solids(), **asked) is not None


def test_points_that_are_kept_are_some_of_the_body_and_reach_all_of_it():
    """Of a cube: as many as may be, all of them points of it, no two of them as near as neighbours were, none far."""
    cube = np.random.default_rng(0).uniform(0, 1, (3 * reference_motion.MOST, 3)).astype(np.float32)
    kept = reference_motion.evenly(cube)
    assert len(kept) == reference_motion.MOST
    assert {tuple(row) for row in kept.tolist()} <= {tuple(row) for row in cube.tolist()}
    gap = reference_motion.MOST ** (-1 / 3)  # of a lattice of so many
    tree = cKDTree(kept)
    assert tree.query(kept, k=2)[0][:, 1].min() > 0.5 * gap and tree.query(cube)[0].max() < 1.5 * gap
    np.testing.assert_array_equal(reference_motion.evenly(cube[:10]), cube[:10])


def test_what_was_kept_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    twin = CarnationTwin()
    place, t = rng.uniform(0, 0.1, (40, 3)).astype(np.float32), np.arange(9)
    shapes, slopes = rng.normal(size=(3, 40, 3)), rng.normal(size=(3, 40, 3, 3))
    amplitude = 0.01 * np.stack([np.sin((k + 1) * t) for k in range(3)], 1)
    moved = reference_motion.Moved(
        place=place,
        position=place + np.einsum("tk,kpi->tpi", amplitude, shapes),
        deformation=np.eye(3) + np.einsum("tk,kpij->tpij", amplitude, slopes),
    )
    path = tmp_path / "thing.npz"
    asked = (twin.world(), {"learn": twin.pokes()["learn"]}, twin.solids())
    reference_motion.save(path, *asked, 30.0, {"learn": moved}, "by hand")
    found = reference_motion.recorded(path, *asked, frames=5, fps=15.0)
    assert found is not None
    again = found[0]["learn"]
    # half precision of three fields of up to 3 cm
    np.testing.assert_allclose(again.position, moved.position[::2], atol=1e-4)
    np.testing.assert_allclose(again.deformation, moved.deformation[::2], atol=1e-2)
