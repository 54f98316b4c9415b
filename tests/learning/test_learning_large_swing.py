"""Large swings against equations of motion that were integrated in time."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physics3d.learning.large_swing import LargeSwing

F, D = 3.0, 0.7  # of small swings [Hz], [1/s]
OMEGA = 2 * np.pi * F


def integrated(force, t, start):
    """Place of a mass of 1 kg that is let go at `start`."""
    return solve_ivp(lambda _, y: [y[1], force(*y)], (0, t[-1]), [start, 0], t_eval=t, rtol=1e-10, atol=1e-12).y[0]


def drag(size):
    """c |v| v, which averaged takes 4/(3 pi) c omega A^2 from the amplitude (energy lost per period)."""
    c = 0.2
    return lambda x, v: -(OMEGA**2) * x - 2 * D * v - c * abs(v) * v, LargeSwing(
        sooner=4 / (3 * np.pi) * c * OMEGA * size / D, exponent=1.0, damping=D
    )


def softening(size):
    """A spring omega^2 (x - b x^3), whose frequency is lower by 3/8 b A^2 (Duffing)."""
    b = 0.2
    return lambda x, v: -(OMEGA**2) * (x - b * x**3) - 2 * D * v, LargeSwing(
        slower=3 / 8 * b * size**2, exponent=2.0, damping=D
    )


@pytest.mark.parametrize("kind", [drag, softening])
@pytest.mark.parametrize("size", [0.2, 0.7])
def test_drag_and_a_softening_spring_do_what_the_law_says(kind, size):
    """Averaging leaves terms of second order: d/omega, k and g d/omega, a few per cent, squared; and as much of the
    first harmonic as of the third, a fortieth of k."""
    force, law = kind(size)
    t = np.arange(0, 2.5, 1 / 60)
    x = integrated(force, t, size)
    basis = law.functions(np.array([F]), np.array([D]), t)[:, 0].T
    left = x - basis @ np.linalg.lstsq(basis, x, rcond=None)[0]
    linear = LargeSwing().functions(np.array([F]), np.array([D]), t)[:, 0].T
    wrong = x - linear @ np.linalg.lstsq(linear, x, rcond=None)[0]
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(x)
    assert size < 0.5 or np.linalg.norm(left) < 0.1 * np.linalg.norm(wrong)


def test_half_the_amplitude_goes_on_as_the_whole_does_from_where_it_is_half():
    law = LargeSwing(slower=0.1, sooner=1.5, exponent=1.0, damping=D)
    t = np.arange(0, 3, 1 / 30)
    whole = np.linalg.norm(law.functions(np.array([F]), np.array([D]), t)[:, 0], axis=0)
    at = np.interp(0.5, whole[::-1], t[::-1])
    later = np.linalg.norm(law.functions(np.array([F]), np.array([D]), t + at)[:, 0], axis=0)
    half = np.linalg.norm(law.of_amplitude(0.5).functions(np.array([F]), np.array([D]), t)[:, 0], axis=0)
    assert later == pytest.approx(0.5 * half, rel=1e-3)  # the instant is read off between frames
