"""A hand pulls at a body, live: how far it follows, what is kept of it, and where there can be no hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from looked_at import run
from mpm_bodies import every_material

from physics3d.boundaries.half_space import HalfSpace
from physics3d.log import Log
from physics3d.materials.von_mises import VonMises
from physics3d.view.live import Live, scaled
from physics3d.world import World

LOOKED = run(frames=2)
TOP = int((LOOKED.body.position - torch.tensor([0.0, 0.0, 0.4])).norm(dim=1).argmin())
RECOVERING = [m for m in every_material() if m.recovers]


def live(world: World = LOOKED.world) -> Live:
    return Live.of(world, LOOKED.body, LOOKED.values, log=Log(None))


@pytest.fixture(scope="module")
def made() -> Live:
    return live()


def test_held_for_long_the_body_follows_the_hand(made):
    """The relaxed branch gives way further than the stiffness that the force is measured by: between 1 and
    (E + E_N)/E of the way, and all of it where the branch does not relax."""
    made.rest()
    # 1.4 Hz as long as the branch is stuck, 1.1 Hz relaxed, for which this is nearly critical: e^-7 is left of it
    made.change(stiffness=1.0, damping=13.0)
    made.grab(TOP)
    way = np.array([0.004, 0.0, 0.0])
    made.pull(way)
    for _ in range(15):
        made.advance(0.1)
    share = made.hold.share
    moved = share @ made.stepper.q
    E, mu_N = 2e4, 6e3
    softer = (E / 2.6 + mu_N) / (E / 2.6)
    # the fingertip is half a particle off the axis: a little of the softest direction is a twist
    assert 0.93 * way[0] < moved[0] < 1.02 * softer * way[0]
    made.let_go()
    for _ in range(15):
        made.advance(0.1)
    assert np.abs(made.stepper.particles()[0] - LOOKED.body.position).max() < 0.05 * way[0]  # it comes back


def test_what_is_kept_is_what_the_hand_did(made):
    made.rest()
    made.grab(TOP)
    total = np.zeros(3)
    for k in range(20):
        made.pull(np.array([1e-3 * k, -5e-4 * k, 0.0]))
        total += made.force * made.advance(0.05)
    made.let_go()
    made.advance(0.05)
    impulse = sum(p.duration * np.array(p.force) for p in made.record.impulses())
    np.testing.assert_allclose(impulse, total, rtol=1e-5, atol=1e-9)  # seven digits are written


def test_time_passes_by_the_clock_in_whole_steps(made):
    made.rest()
    begin, clock = made.stepper.time, 0.0
    for seconds in (0.003, 0.02, 0.05, 0.0, 0.041):
        clock += seconds
        made.advance(seconds)
        assert 0 <= clock - (made.stepper.time - begin) < made.stepper.dt
    made.advance(3.0)  # a long pause is not made up for
    assert made.stepper.time - begin < clock + 0.11


def test_a_pull_that_is_too_much_ends_and_says_so(made):
    made.rest()
    made.change(stiffness=1.0, damping=0.0)
    made.grab(TOP)
    made.pull(np.array([0.0, 0.0, -1e4]))
    for _ in range(20):
        made.advance(0.05)
        if made.trouble:
            break
    assert "too much" in made.trouble and made.hold is None and not made.stepper.q.any()
    made.grab(TOP)
    assert not made.trouble


def test_what_is_held_cannot_be_pulled(made):
    made.rest()
    made.grab(int(LOOKED.body.position[:, 2].argmin()))
    assert made.hold is None and "held" in made.trouble


def test_a_wall_that_is_reached_is_named():
    wall = HalfSpace(point=(0.07, 0.0, 0.0), normal=(-1.0, 0.0, 0.0), kind="slip")
    made = live(replace(LOOKED.world, boundaries=(*LOOKED.world.boundaries, wall)))
    made.particles()
    assert not made.trouble
    made.grab(TOP)
    made.pull(np.array([0.1, 0.0, 0.0]))
    for _ in range(10):
        made.advance(0.05)
        made.particles()
    assert "HalfSpace" in made.trouble and "not felt" in made.trouble


@pytest.mark.parametrize(
    "changes, reason",
    [
        (dict(boundaries=()), "nothing holds"),
        (dict(material=VonMises(), start=VonMises().example), "may flow"),
        (dict(boundaries=(HalfSpace(point=(0.0, 0.0, -0.1), normal=(0.0, 0.0, 1.0)),), gravity=(0, 0, -9.8)), "falls"),
    ],
    ids=["free", "plastic", "falling"],
)
def test_where_there_can_be_no_poke_the_reason_is_told(changes, reason):
    with pytest.raises(ValueError, match=reason) as told:
        live(replace(LOOKED.world, **changes))
    assert "\n" not in str(told.value)
    assert "world.solver" not in str(told.value)  # no other solver pokes


@pytest.mark.parametrize("material", RECOVERING, ids=str)
def test_stiffness_multiplies_every_energy(material, rng):
    """Energies are linear in the moduli, and nothing else of a material is one; stuck branches as well."""
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in material.example.items()}
    H = torch.from_numpy(0.1 * rng.normal(size=(5, 3, 3)))
    memory = material.initial_memory(5, torch.float64)
    one, three = (material.coefficients(v).expand(-1, 5) for v in (values, scaled(values, 3.0)))
    energy = material.energy(one, H, memory)
    torch.testing.assert_close(material.energy(three, H, memory), 3 * energy, rtol=1e-9, atol=0)  # round-off
    torch.testing.assert_close(material.wave_modulus(three), 3 * material.wave_modulus(one), rtol=1e-9, atol=0)
    assert (energy > 0).all()


def test_a_body_that_has_come_to_rest_costs_nothing_until_it_is_touched(made):
    made.rest()
    made.change(stiffness=1.0, damping=0.0)
    passed = [made.advance(0.05) for _ in range(40)]
    assert passed[0] > 0 and sum(passed) < 1.2 and passed[-1] == 0
    made.grab(TOP)
    assert made.advance(0.05) > 0
    made.let_go()
