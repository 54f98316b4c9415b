"""Step by step with a force that is told as it goes: the same motion as a rollout that knew it beforehand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mpm_bodies import CUBE, CUBE_VOLUME, small_rollout, soft_world, tensors

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.mpm.stepping import Stepper

WORLD = soft_world(dt=5e-4, gravity=(0.0, 0.3, -1.0), damping=0.7)
WEIGHT = (CUBE[:, 0] > 0.1).numpy().astype(float)
MASS = WORLD.density * float(CUBE_VOLUME.sum())


def stepper(world=WORLD) -> Stepper:
    return Stepper(world, tensors(world.start), CUBE, CUBE_VOLUME, dt=0.02)


def test_it_goes_where_the_rollout_goes():
    world = replace(WORLD, boundaries=(FixedRegion(lower=(-1.0,) * 3, upper=(1.0, 1.0, 0.06)),))
    pushes = [
        Impulse(force=force, lower=(0.1, 0.0, 0.0), upper=(0.2, 0.2, 0.2), start=start, duration=0.02)
        for force, start in (((3.0, 0.0, 1.0), 0.0), ((-1.0, 2.0, 0.0), 0.04))
    ]
    whole = small_rollout(world, frames=5, excitation=tuple(pushes))
    one = stepper(world)
    one.push(WEIGHT)
    for k, force in enumerate([(3.0, 0.0, 1.0), (0.0, 0.0, 0.0), (-1.0, 2.0, 0.0), (0.0, 0.0, 0.0)]):
        one.step(np.array(force))
        x, F, _ = one.particles()
        # the force of a rollout begins half a substep earlier: its windows are those of the velocities
        torch.testing.assert_close(x, whole.position[k + 1], rtol=0, atol=1e-9 + 0.02 * float((x - CUBE).abs().max()))
        torch.testing.assert_close(F, whole.deformation[k + 1], rtol=0, atol=2e-3)
    assert float((x - CUBE).abs().max()) > 1e-3 and one.time == pytest.approx(0.08)


def test_the_whole_body_feels_its_mass_and_is_left_as_it_was():
    free = stepper(replace(WORLD, damping=0.0))
    free.push(np.ones(len(CUBE)))
    free.step(np.array([1.0, 0.0, 0.0]))
    before = [value.clone() for value in free.particles()]
    # a force acts for half a substep less than the step, as velocities are that much behind
    assert free.inertia() == pytest.approx(MASS, rel=0.03)
    assert all(torch.equal(a, b) for a, b in zip(before, free.particles(), strict=True))


def test_a_part_feels_more_than_itself_and_less_than_the_whole():
    one = stepper(replace(WORLD, damping=0.0))
    one.push(WEIGHT)
    assert 0.5 * MASS < one.inertia() < MASS


def test_a_force_on_nothing_is_refused():
    with pytest.raises(ValueError, match="weight above 0"):
        stepper().push(np.zeros(len(CUBE)))


def test_other_parameters_do_not_move_it():
    one = stepper()
    one.push(WEIGHT)
    for _ in range(2):
        one.step(np.array([4.0, 0.0, 0.0]))
    before = one.particles()[0].clone()
    one.change({**tensors(WORLD.start), "youngs_modulus": torch.tensor(3e4, dtype=torch.float64)}, damping=0.0)
    assert torch.equal(before, one.particles()[0])
    one.step(np.zeros(3))
    assert not torch.equal(before, one.particles()[0])
