"""The simulate stage on a small body: its trajectory, its metrics and its picture."""

import json
from dataclasses import replace

import pytest
import torch
from small_scene import ELASTIC, POKE, bar, world

from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.body import Body
from physics3d.gaussians.embedding import embed
from physics3d.log import METRICS, Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.trajectory import Trajectory
from physics3d.world import World
from stages.simulate import Simulate

SPACING = 0.05
WORLD = World(
    material=NeoHookean(),
    density=1000.0,
    start=dict(youngs_modulus=1e4, poissons_ratio=0.3),
    dx=0.1,
    gravity=(0.0, 0.0, -9.81),
    boundaries=(HalfSpace(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0)),),
)


@pytest.fixture
def body() -> Body:
    axis = (torch.arange(4) + 0.5) * SPACING
    position = torch.cartesian_prod(axis, axis, axis)
    count = len(position)
    return Body(
        position=position,
        volume=torch.full((count,), SPACING**3),
        part=torch.zeros(count, dtype=torch.int32),
        interior=torch.ones(count, dtype=torch.bool),
        spacing=SPACING,
        embedding=embed(position[:8] + 0.01, torch.arange(8), position, SPACING),
    )


def test_a_density_that_was_learned_is_that_of_the_simulation(body):
    """As that of a world which says so; a push in newtons moves what is lighter farther."""
    poke = Impulse(force=(2.0, 0.0, 0.0), centre=(0.1, 0.1, 0.2), radius=0.1, duration=0.05)
    moved = lambda world, estimate: (
        Simulate(world=world, frames=4, fps=20.0, excitation=(poke,))(body, estimate, log=Log(None)).position
    )
    lighter = replace(WORLD, density=500.0)
    learned = moved(WORLD, replace(WORLD.estimate(), density=500.0))
    assert torch.equal(learned, moved(lighter, lighter.estimate()))
    assert float((learned - moved(WORLD, WORLD.estimate())).abs().max()) > 1e-3


def test_stage_gives_a_trajectory_that_survives_a_file_with_metrics_and_a_picture(body, tmp_path):
    poke = Impulse(force=(2.0, 0.0, 0.0), centre=(0.1, 0.1, 0.2), radius=0.1, duration=0.05)
    log = Log(tmp_path, name="simulate", quiet=True)
    trajectory = Simulate(world=WORLD, frames=6, fps=20.0, excitation=(poke,))(body, WORLD.estimate(), log=log)
    assert trajectory.position.shape == (6, 64, 3) and trajectory.deformation.shape == (6, 64, 3, 3)
    assert trajectory.fps == pytest.approx(20.0) and not trajectory.position.requires_grad
    assert float((trajectory.position[-1] - trajectory.rest_position).norm(dim=1).max()) > 1e-3
    trajectory.save(tmp_path)
    assert torch.equal(Trajectory.load(tmp_path).position, trajectory.position)
    metrics = [json.loads(line) for line in (tmp_path / METRICS).read_text().splitlines()]
    assert {m["step"] for m in metrics if m["name"] == "health/speed_max"} == set(range(6))
    mass = [m["value"] for m in metrics if m["name"] == "mass"]
    assert mass == [pytest.approx(1000.0 * 64 * SPACING**3, rel=1e-5)]  # volumes in float32
    assert (tmp_path / "previews" / "motion.png").stat().st_size > 10_000


def test_initial_velocity_of_the_estimate_is_used(body):
    world = replace(WORLD, gravity=(0.0, 0.0, 0.0), boundaries=())
    estimate = replace(world.estimate(), velocity=torch.tensor((0.3, 0.0, 0.0)))
    x = Simulate(world=world, frames=3, fps=10.0)(body, estimate, log=Log(None)).position
    # uniform motion, single precision
    expected = body.position + torch.tensor((0.06, 0.0, 0.0))
    torch.testing.assert_close(x[-1], expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("dx, word", [(0.3, r"smaller than a cell; take world.dx <= 0\.013 m"), (0.19, None)])
def test_a_body_smaller_than_a_cell_is_refused(body, dx, word):
    """0.2 m wide: 4 particles, 0.05 m apart. A fifteenth of that is 0.0133 m."""
    run = lambda: Simulate(world=replace(WORLD, dx=dx), frames=2, fps=100.0)(body, WORLD.estimate(), log=Log(None))
    if word is None:
        run()
    else:
        with pytest.raises(ValueError, match=word):
            run()


def test_a_force_that_nothing_takes_is_refused(body):
    shake = Impulse(acceleration_of_each=(1.0, 0.0, 0.0), nearest=3, centre=(0.0, 0.0, 0.0), duration=0.1)
    stage = Simulate(world=WORLD, frames=2, fps=100.0, excitation=(shake,), force={"x": 1.0, "y": 0.0, "z": 0.0})
    with pytest.raises(ValueError, match=r"simulate\.force is .* no impulse .* could replace"):
        stage(body, WORLD.estimate(), log=Log(None))


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_senseless_fps_is_refused(body, fps):
    with pytest.raises(ValueError, match=r"simulate\.fps is"):
        Simulate(world=WORLD, frames=3, fps=fps)(body, WORLD.estimate(), log=Log(None))


def test_the_motion_does_not_hang_on_where_learning_started():
    """A bar that is held by its foot and thousands of times as stiff as the configuration guessed: what holds it gives
    way no more for that."""
    _, body = bar()
    stiff = world(ELASTIC | {"youngs_modulus": 2e7})
    push = (replace(POKE[0], force=(300.0, 0.0, 0.0)),)
    found = []
    for guess in (2e7, 2e3):
        of = replace(world(ELASTIC | {"youngs_modulus": guess}), solver="modes")
        stage = Simulate(world=of, frames=12, fps=240.0, excitation=push)
        motion = stage(body, stiff.estimate(), log=Log(None))
        found.append(motion.position - motion.rest_position)
    assert float(found[0].norm(dim=2).max()) > 1e-3
    # the same numbers in another order of magnitude: round-off
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=1e-3 * float(found[0].abs().max()))
