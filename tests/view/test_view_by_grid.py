"""A hand pulls at what modes do not move: by the grid, at the size of the scene and at a reduced one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from looked_at import DX, run

from physics3d.boundaries.half_space import HalfSpace
from physics3d.log import Log
from physics3d.materials.newtonian import Newtonian
from physics3d.view import by_grid
from physics3d.view.coarse import coarser
from physics3d.view.live import Live

LOOKED = run(frames=2)
X = LOOKED.body.position.double()
TOP = int((X - torch.tensor([0.0, 0.0, 0.4])).norm(dim=1).argmin())
FLOOR = HalfSpace(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), kind="separate", friction=0.5)
G = 9.81
MASS = 300.0 * 0.1 * 0.1 * 0.4  # [kg]
HALVED = "halved"


@pytest.fixture(params=["as it is", HALVED])
def size(request, monkeypatch):
    """At a reduced size as well: so that half the cells are wanted."""
    monkeypatch.setattr(by_grid, "CELLS", 4)
    monkeypatch.setattr(by_grid, "RATE", 1e3 if request.param == HALVED else 1e9)
    return request.param


def live(**changes) -> Live:
    return Live.of(replace(LOOKED.world, **changes), LOOKED.body, LOOKED.values, log=Log(None))


def onwards(made: Live, seconds: float) -> None:
    """Whatever the clock says."""
    end = made.time + seconds - made.mover.dt / 2
    while made.time < end:
        made.advance(made.mover.dt)


def middle(made: Live) -> np.ndarray:
    return made.mover.particles()[0].mean(0).numpy()


def test_it_says_how_large_its_cells_are(size):
    made = live(boundaries=())
    assert f"cells of {100 if size == HALVED else 50} mm" in made.mover.how
    assert ("reduced" in made.mover.how) == (size == HALVED) == bool(made.mover.notes)


def test_what_is_let_go_falls(size):
    made = live(boundaries=(), gravity=(0.0, 0.0, -G))
    onwards(made, 0.25)
    fallen = X.mean(0).numpy() - middle(made)
    # symplectic steps in single precision: exact but for the place a float32 can say
    np.testing.assert_allclose(fallen, [0, 0, G * made.time**2 / 2], atol=1e-4)


def test_the_momentum_is_what_the_hand_gave(size):
    """Newton's second law: no wall, no gravity; the record is of the force that acted."""
    made = live(boundaries=())
    made.grab(TOP)
    given = np.zeros(3)
    for k in range(24):
        made.pull(np.array([0.004 * k, 0.0, -0.002 * k]))
        given += made.force * made.advance(made.mover.dt)
    v = made.mover.particles()[2].numpy()
    assert np.abs(given).max() > 0.05 * MASS  # it goes at 5 cm/s at least
    np.testing.assert_allclose(np.sum(made.record.forces, 0) * made.record.dt, given, rtol=1e-9)
    # velocities lag by half a substep, by which the force has not acted
    np.testing.assert_allclose(MASS * v.mean(0), given, atol=0.03 * np.abs(given).max())


def test_what_is_held_in_the_air_hangs_by_its_weight(size):
    """Lifted off the floor and held until it is at rest, the hand pulls with m g."""
    made = live(boundaries=(FLOOR,), gravity=(0.0, 0.0, -G))
    made.grab(TOP)
    made.change(stiffness=5.0, damping=8.0)  # at rest within a second
    made.pull(np.array([0.0, 0.0, 0.5]))
    onwards(made, 2.0)
    assert middle(made)[2] > X.mean(0)[2] + 0.2
    np.testing.assert_allclose(made.force, [0, 0, MASS * G], atol=0.05 * MASS * G)
    made.let_go()
    onwards(made, 1.0)
    assert abs(middle(made)[2] - X.mean(0)[2]) < 0.06 or middle(made)[2] < 0.2  # it stands, or lies


def test_what_stands_is_stressed_by_its_weight(size):
    """A bar on a floor carries rho g (h - z) at the height z; von Mises' of a uniaxial stress is that stress itself."""
    made = live(boundaries=(FLOOR,), gravity=(0.0, 0.0, -G))
    made.change(stiffness=5.0, damping=8.0)
    onwards(made, 1.5)
    found = made.stress(made.particles()[1])
    z = X[:, 2].numpy()
    middle_third = (z > 0.13) & (z < 0.27)  # away from the foot, which rubs, and from the top, where there is none
    expected = (300.0 * G * (0.4 - z))[middle_third].mean()
    # nodes reach half a cell of 5 or 10 cm around a bar of 10 cm: it is stiffer there, not more stressed in the mean
    assert found[middle_third].mean() == pytest.approx(expected, rel=0.15)


def test_what_flows_stays_where_it_was_drawn(size):
    honey = Newtonian()
    changes = dict(material=honey, start=honey.example, boundaries=(FLOOR,), gravity=(0.0, 0.0, 0.0))
    looked = replace(LOOKED.world, **changes)
    values = looked.estimate().parameters
    made = Live.of(looked, LOOKED.body, values, log=Log(None))
    made.grab(TOP)
    made.pull(np.array([0.06, 0.0, 0.0]))
    onwards(made, 0.4)
    made.let_go()
    onwards(made, 0.4)
    moved = made.mover.particles()[0][TOP] - X[TOP]
    assert moved[0] > 0.03 and made.stress(made.particles()[1]) is None


def test_what_is_held_cannot_be_pulled(size):
    beside = HalfSpace(point=(-0.049, 0.0, 0.0), normal=(1.0, 0.0, 0.0), kind="slip")
    made = live(boundaries=(*LOOKED.world.boundaries, beside))
    assert "grid" in made.mover.how  # it touches the wall
    made.grab(int(X[:, 2].argmin()))
    assert made.hold is None and "held" in made.trouble
    made.grab(TOP)
    assert made.hold is not None


def test_where_it_flies_too_far_it_is_put_to_rest_until_it_is_touched():
    made = live(boundaries=(), gravity=(0.0, 0.0, -500.0))
    for _ in range(400):
        made.advance(0.1)
        if made.trouble:
            break
    assert "put to rest" in made.trouble and made.advance(0.1) == 0
    np.testing.assert_allclose(middle(made), X.mean(0), atol=1e-6)


@pytest.mark.parametrize("factor", [1.0, 1.4, 2.0, 3.1])
def test_fewer_particles_have_the_same_mass_and_the_same_hand(factor, rng):
    """Total mass, first moment, what a force acts on; an affine motion comes back to the body's own particles."""
    body, world = LOOKED.body, LOOKED.world
    coarse = coarser(body, world, factor)
    volume = body.volume.double().numpy()
    assert (len(coarse.position) < len(X)) == (factor > 1)
    np.testing.assert_allclose(coarse.volume.sum(), volume.sum(), rtol=1e-12)
    np.testing.assert_allclose(coarse.volume @ coarse.position, volume @ X.numpy(), atol=1e-12)
    weight = rng.uniform(size=len(X))
    np.testing.assert_allclose(coarse.mean(weight) @ coarse.volume.numpy(), weight @ volume, rtol=1e-12)
    A, b = torch.eye(3, dtype=torch.float64) + 0.3 * torch.from_numpy(rng.normal(size=(3, 3))), torch.ones(3)
    x, F, _ = coarse.fine(
        coarse.position @ A.T + b, A.expand(len(coarse.position), 3, 3), torch.zeros_like(coarse.position)
    )
    np.testing.assert_allclose(x, X @ A.T + b, atol=2e-3 * DX)  # float32, where particles are carried at all
    np.testing.assert_allclose(F, A.expand(len(X), 3, 3), atol=1e-5)
