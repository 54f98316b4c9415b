"""Whatever the material and the step: right, or said to be wrong, or refused; and steps that fit the motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from modes_bodies import row, world
from swinging_beam import COUNT, EDGE, LENGTH, Case, closed_form, run, shape

from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.modes.dynamics import NotSolved
from physics3d.modes.rollout import Solver

MU = 1e5 / 2.6
CASES = {
    **{f"E {young:g}": Case(young=young) for young in (1e2, 1e6, 1e10)},
    "nu 0.499": Case(young=1e5, poisson=0.499),
    "viscosity 1e-2": Case(young=1e5, ratio=1.0, time=1e-2 / MU),
    "viscosity 1e3": Case(young=1e5, ratio=1.0, time=1e3 / MU),
    "viscosity 1e6": Case(young=1e5, ratio=1.0, time=1e6 / MU),
    "viscosity 1e6 in a tenth of a second": Case(young=1e5, ratio=1e7 / MU, time=0.1),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_beam_swings_as_it_should_or_it_is_said(case):
    """Automatic steps are right; of the user's own, from far too long to short ones, each that is wrong is said to be:
    `run` takes what is wrong in silence as failed."""
    right = run(case)
    assert right["outcome"] == "accurate", right
    found = {dt: run(replace(case, dt=dt)) for dt in (1e-4, 1e-2, 0.1)}
    assert not [r for r in found.values() if r["outcome"] == "FAILED"], found
    # two periods of a motion that is a fiftieth of a period late are within 10 %
    assert all("periods late" in r["detail"] for r in found.values() if r["outcome"] != "accurate"), found


@pytest.mark.parametrize("young", [1e3, 1e7, 1e9])
def test_steps_follow_a_material_that_the_basis_was_not_made_for(young):
    """As in learning, which starts far from where it ends."""
    found = run(Case(young=young, start=1e5))
    assert found["outcome"] == "accurate", found


def test_a_long_swing_keeps_time():
    """Forty periods, in frames as long as a period: with steps that are right for one, it would be a fourth of a
    period late at the end. Against the frequency of the linear problem, which knows no steps."""
    solver, velocity = thrown(speed=1e-3)
    omega = float(solver.model.omega[0])
    frame_dt = 2 * math.pi / omega * 0.98
    with torch.no_grad():
        motion = solver.rollout(solver.world.start, velocity=velocity, frames=41, frame_dt=frame_dt, log=Log(None))
    t = frame_dt * np.arange(41)
    exact = float(velocity[-1, 2]) * closed_form(t, omega, 0.0, 1.0)
    found = (motion.position - motion.rest_position)[:, -1, 2].numpy()
    # a fiftieth of a period late at the end is 0.13 of the amplitude
    np.testing.assert_allclose(found, exact, atol=0.15 * np.abs(exact).max())


def test_more_steps_than_are_allowed_are_refused():
    solver, velocity = thrown(speed=1e-3, max_substeps=50)
    period = 2 * math.pi / float(solver.model.omega[0])
    with pytest.raises(ValueError, match=r"max_substeps = 50; take a larger world\.dt"):
        solver.rollout(solver.world.start, velocity=velocity, frames=2, frame_dt=10 * period, log=Log(None))


def test_a_motion_that_gains_energy_is_refused():
    """A beam that is thrown, by ten steps to a period: these serve a small swing; of one half round itself the energy
    grows by half in two periods."""
    for speed, serves in ((0.01, True), (0.6, False)):
        solver, velocity = thrown(speed=speed, steps=10)
        timing = dict(velocity=velocity, frames=21, frame_dt=solver.world.dt, log=Log(None))
        if serves:
            energy = np.array(solver.rollout(solver.world.start, **timing).health["energy"])
            assert energy.max() < 1.05 * energy[0]
        else:
            with pytest.raises(NotSolved, match=r"frame \d+: the motion gains .* from nowhere .* take a weaker force"):
                solver.rollout(solver.world.start, **timing)


@pytest.mark.parametrize("speed", [1e-6, 1e-10, 1e-30])
def test_a_motion_below_rounding_is_no_gain_of_energy(speed):
    """What is small swings as what is large, in single precision too."""
    solver, velocity = thrown(speed=speed, precision="float32")
    period = 2 * math.pi / float(solver.model.omega[0])
    with torch.no_grad():
        motion = solver.rollout(solver.world.start, velocity=velocity, frames=9, frame_dt=period / 8, log=Log(None))
    end = motion.velocity[:, -1, 2].double().numpy() / speed
    # back and forth once; other modes have a few per cent of the speed of the end
    np.testing.assert_allclose(end, np.cos(2 * math.pi * np.arange(9) / 8), atol=0.15)


def thrown(*, speed: float, steps: int | None = None, **changes) -> tuple[Solver, torch.Tensor]:
    """A beam of the cases and the velocity of its first mode, that fast at the end [m/s]."""
    position, volume = row(COUNT, EDGE)
    body = world(1e5, 0.3, material=NeoHookean(), **changes)
    solver = Solver.of(body, position, volume, log=Log(None))
    if steps is not None:
        dt = 2 * math.pi / float(solver.model.omega[0]) / steps
        solver = replace(solver, world=replace(body, dt=dt))
    velocity = torch.zeros_like(position)
    velocity[:, 2] = speed * torch.from_numpy(shape(position[:, 0].numpy() / LENGTH))
    return solver, velocity
