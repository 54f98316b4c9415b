"""A known force weighs what it moves: density and stiffness from one clip, where the density given is wrong."""

from dataclasses import replace

import pytest
import small_scene
import torch

from physics3d.boundaries.impulse import Impulse
from physics3d.learning.fields import GlobalField
from physics3d.learning.interval import Beyond
from physics3d.log import Log
from physics3d.world import World

TRUTH = 300.0  # [kg/m^3], of small_scene.world


def learned(given: float, *, excitation=small_scene.POKE, **widths):
    """(what is found, truth of the parameters) of a bar whose density is said to be `given`."""
    clip = small_scene.capture(small_scene.ELASTIC, solver="modes")
    clip = replace(clip, takes=(replace(clip.takes[0], excitation=excitation),))
    start = small_scene.ELASTIC | {"youngs_modulus": 1.3 * small_scene.ELASTIC["youngs_modulus"]}
    stage = small_scene.learner(
        start, ("youngs_modulus",), steps=0, polish=10, stay=0.002, solver="modes",
        beyond=Beyond(**{"surface": 0.02, "modes": 0.02, "length": 0.0, "force": 0.0} | widths),
    )  # fmt: skip
    stage = replace(stage, world=replace(stage.world, density=given))
    return stage(clip, *small_scene.bar(), log=Log(None))


@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_density_and_stiffness_are_found_where_the_density_given_is_wrong(wrong):
    """Within 3 %: eight bits of colour, and the pull to the density that was given. Believing it costs E
    more than that, though the clip has less than one swing."""
    found = learned(wrong * TRUTH, density=0.2)
    E = small_scene.ELASTIC["youngs_modulus"]
    assert found.density == pytest.approx(TRUTH, rel=0.03)
    assert float(found.parameters["youngs_modulus"]) == pytest.approx(E, rel=0.03)
    for name, true in (("density", TRUTH), ("youngs_modulus", E)):
        assert found.intervals[name].low < true < found.intervals[name].high and found.intervals[name].determined
    believed = learned(wrong * TRUTH, density=0.0)
    assert believed.density is None and "density" not in believed.intervals
    assert abs(float(believed.parameters["youngs_modulus"]) / E - 1) > 0.04


def test_what_is_pushed_by_an_acceleration_cannot_be_weighed():
    force = small_scene.POKE[0]
    shaken = Impulse(
        acceleration_of_each=(1.0, 0.0, 0.0), centre=force.centre, radius=force.radius, duration=force.duration
    )
    assert learned(TRUTH, excitation=(shaken,), density=0.2).density is None


@pytest.mark.parametrize("solver, equal", [("grid", 1e-6), ("modes", 2e-3)])
def test_a_chain_moves_a_heavier_body_as_a_world_of_that_density_does(solver, equal):
    """One scales stress and force, the other has the mass. On the grid substeps are the same; modes are stepped in
    time by steps that the world's own frequencies ask for, which are others."""
    world = small_scene.world(small_scene.DAMPED, precision="float64", solver=solver)
    clip, heavier = small_scene.capture(small_scene.DAMPED), torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)

    def moved(world: World, theta: torch.Tensor, density: float | None) -> torch.Tensor:
        field = GlobalField(
            start=world.estimate().parameters,
            learn=("youngs_modulus", "branch_shear_modulus"),
            density=density,
        )
        with torch.no_grad():
            return small_scene.bar_chain(world, field, clip, 8).simulate(theta).position

    by_chain = moved(world, heavier, TRUTH)
    by_world = moved(replace(world, density=TRUTH * float(heavier[2].exp())), heavier[:2], None)
    same = moved(world, heavier[:2], None)
    swing = float((by_world - by_world[0]).abs().max())
    assert float((by_chain - by_world).abs().max()) < equal * swing
    assert float((same - by_world).abs().max()) > 0.05 * swing  # the density counts
