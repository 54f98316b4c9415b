"""A body moved one step at a time: closed forms of a held beam that a hand pulls at."""

import math

import numpy as np
import pytest
import torch
from modes_bodies import DENSITY, row, section, timoshenko, world
from scipy.signal import find_peaks

from physics3d.log import Log
from physics3d.modes.rollout import Solver
from physics3d.modes.stepping import Stepper

YOUNG, POISSON, COUNT, EDGE = 1e5, 0.3, 20, 0.01
LENGTH = COUNT * EDGE
START = {"youngs_modulus": torch.tensor(YOUNG), "poissons_ratio": torch.tensor(POISSON)}


@pytest.fixture(scope="module")
def solver() -> Solver:
    position, volume = row(COUNT, EDGE)
    return Solver.of(world(YOUNG, POISSON, density=DENSITY), position, volume, log=Log(None))


def first_frequency(young: float = YOUNG) -> float:
    area, inertia, shear = section("square", EDGE, POISSON)
    return timoshenko(LENGTH, area, inertia, young, POISSON, DENSITY, shear, free=False)[0]


def tip(stepper: Stepper) -> float:
    return float((stepper.particles()[0] - stepper.solver.position)[-1, 2])


def pulled(stepper: Stepper, force: float) -> tuple[np.ndarray, float]:
    """(the share of a force on the last particle, where the tip is) after it has been pulled at for long."""
    end = np.zeros(COUNT)
    end[-1] = 1.0
    share = stepper.share(end)
    stepper.change(START, damping=2 * math.pi * first_frequency())  # half of critical
    for _ in range(160):  # four periods: e^-12 of the swing is left
        stepper.step(np.array([0.0, 0.0, force]), share)
    return share, tip(stepper)


def crossings(curve: np.ndarray, dt: float) -> np.ndarray:
    """Times at which it passes zero [s]."""
    k = np.flatnonzero(curve[:-1] * curve[1:] < 0)
    return (k + curve[k] / (curve[k] - curve[k + 1])) * dt


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_a_held_rod_swings_at_the_frequency_of_timoshenko(solver, times):
    """And at twice of it with four times the stiffness, changed while it is bent."""
    period = 1 / first_frequency(times * YOUNG)
    stepper = Stepper(solver, START, dt=period / 40)
    share, _ = pulled(stepper, 1e-4)
    stepper.change(START | {"youngs_modulus": times * START["youngs_modulus"]}, damping=0.0)
    curve = []
    for _ in range(120):
        stepper.step(np.zeros(3), share)
        curve.append(tip(stepper))
    half = np.diff(crossings(np.array(curve), stepper.dt)).mean()
    # the midpoint rule is late by (omega dt)^2/12 = 0.2 %; the model of one cube across by 1 % (test_modes_vibration)
    assert 2 * half == pytest.approx(period, rel=0.015)


def test_a_hand_bends_it_as_far_as_the_compliance_says(solver):
    """F L^3/(3 E I) + F L/(shear G A) at small forces."""
    area, inertia, shear = section("square", EDGE, POISSON)
    G, reach = YOUNG / (2 * (1 + POISSON)), LENGTH - EDGE / 2
    expected = reach**3 / (3 * YOUNG * inertia) + reach / (shear * G * area)
    stepper = Stepper(solver, START, dt=0.25 / first_frequency() / 10)
    share, moved = pulled(stepper, 1e-5)
    # the particle is as wide as the force, half a cell of a beam twenty long
    assert stepper.compliance(share) == pytest.approx(expected, rel=0.03)
    assert moved == pytest.approx(1e-5 * expected, rel=0.03)


def test_damping_takes_half_its_rate_from_the_amplitude(solver):
    """M a + c M v + K q = 0: q decays as exp(-c t/2)."""
    period = 1 / first_frequency()
    rate = 0.2 * 2 * math.pi / period
    stepper = Stepper(solver, START, dt=period / 40)
    share, _ = pulled(stepper, 1e-4)
    stepper.change(START, damping=rate)
    curve = []
    for _ in range(240):
        stepper.step(np.zeros(3), share)
        curve.append(tip(stepper))
    curve = np.abs(np.array(curve))
    peak = find_peaks(curve)[0]
    slope = np.polyfit(peak * stepper.dt, np.log(curve[peak]), 1)[0]
    # a peak is seen to half a step: low by (pi/40)^2/2 = 0.3 % of what falls to a fifth
    assert len(peak) > 8 and slope == pytest.approx(-rate / 2, rel=0.03)


def test_a_force_on_no_particle_is_refused(solver):
    with pytest.raises(ValueError, match="no particle"):
        Stepper(solver, START, dt=1e-3).share(np.zeros(COUNT))
