"""A known force weighs what it moves: density and stiffness from one clip, where the density given is wrong."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import small_scene
import torch

from physics3d.boundaries.impulse import Impulse
from physics3d.learning.fields import GlobalField
from physics3d.learning.interval import Beyond
from physics3d.learning.linear import shown
from physics3d.learning.loss import Chain
from physics3d.learning.polish import polish
from physics3d.log import Log
from physics3d.priors.exemplar import Exemplar
from physics3d.world import World
from stages.learn import MATTERS

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


def test_what_is_known_of_the_density_counts_as_much_as_independent_pixels_say():
    """Pictures that are linear in theta, and tell the density as badly as it is known. By white noise of known size s
    what pictures alone say is shortened to sigma^2/(v^2 + sigma^2) of it, v^2 = s^2 (J^T J)^-1 (regression with a
    normal prior: Gelman et al. 2013, Bayesian Data Analysis, 14.8). Within a tenth: v is estimated, 60 draws, of which
    those count that are so far off that it matters."""
    sigma, s, size = 0.1, 0.05, (20, 16, 16, 3)
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64) for n in size[1:3]), indexing="ij")
    t = torch.linspace(0, 6, size[0], dtype=torch.float64)
    first = (torch.sin(t)[:, None, None] * torch.exp(-3 * (x**2 + y**2)))[..., None].expand(size)
    other = (torch.cos(t)[:, None, None] * x)[..., None].expand(size)
    J = torch.stack([first.flatten(), (0.9 * first + 0.012 * other).flatten()], 1)
    v = s * float(torch.linalg.inv(J.T @ J)[1, 1].sqrt())
    assert 0.7 < v / sigma < 1.4
    start = {name: torch.tensor(value) for name, value in small_scene.ELASTIC.items()}
    field = GlobalField(start=start, learn=("youngs_modulus",), density=TRUTH)
    stage = small_scene.learner(small_scene.ELASTIC, ("youngs_modulus",), stay=1e-6, beyond=Beyond(density=sigma))
    how: dict[str, Any] = dict(steps=4, seed=0, log=Log(None))
    generator, alone, together = torch.Generator().manual_seed(0), [], []
    for _ in range(60):
        noise = s * torch.randn(size, generator=generator, dtype=torch.float64)
        chain = Chain(
            simulate=lambda theta: theta, render=lambda theta, view, frames: (0.5 + (J @ theta).reshape(size))[frames],
            clips={0: 0.5 + noise}, prior=Exemplar(blur=(0.0,)),
        )  # fmt: skip
        theta, _ = polish(chain, field, field.zero(), stay=1e-6, **how)
        seen = shown(chain, field, theta, seed=0)
        stay = stage.firmer(chain, field, theta, seen, stage.said(field, seen, Log(None)))
        alone.append(float(theta[1]))
        together.append(float(polish(chain, field, theta, stay=stay, **how)[0][1]))
    said, answered = np.array(alone), np.array(together)
    far = np.abs(said) > MATTERS * (v**2 + sigma**2) / v**2
    kept = float((said * answered)[far].sum() / (said**2)[far].sum())
    assert kept == pytest.approx(sigma**2 / (v**2 + sigma**2), abs=0.1)
    assert float(np.std(alone)) == pytest.approx(v, rel=0.2)  # three of its own deviations
