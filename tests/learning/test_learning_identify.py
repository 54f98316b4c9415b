"""Modes read off a clip: a system of masses that is not the model, integrated in time."""

import numpy as np
import pytest
from scipy import linalg
from test_learning_free_motion import FPS, chain

from physics3d.learning.identify import another_take, identified
from physics3d.learning.seen_modes import Observed
from physics3d.log import Log
from physics3d.motion.decay import fit_decay

DAMPING = np.array([0.5, 0.8])  # [1/s]


def other_system(body):
    """Frequencies [Hz] and shapes of two modes of masses whose springs and hold are others than the model's."""
    n = len(body.mass)
    springs = np.zeros((n, n))
    for i, stiffness in enumerate(np.linspace(900.0, 150.0, n - 1)):
        springs[np.ix_([i, i + 1], [i, i + 1])] += stiffness * np.array([[1, -1], [-1, 1]])
    springs[0, 0] += 60.0  # a soft hold
    square, shape = linalg.eigh(springs, body.mass)
    return np.sqrt(square[:2]) / (2 * np.pi), shape[:, :2]


def swung(body, start, slowing, frames, rng, noise=0.02):
    """Places [t, m] of the masses. Modes whose frequency is lower by a share as the square of the first amplitude."""
    f, shape = other_system(body)
    fine = 40
    t = np.arange(frames * fine) / (FPS * fine)
    rate = f[:, None] * (1 - slowing * np.exp(-2 * DAMPING[0] * t))
    phase = 2 * np.pi * np.concatenate([np.zeros((2, 1)), np.cumsum(rate[:, :-1], 1) / (FPS * fine)], 1)
    q = (start[:, None] * np.exp(-DAMPING[:, None] * t) * np.cos(phase)).T[::fine] @ shape.T
    return q + noise / 5 * rng.standard_normal(q.shape)


def seen(places, reference):
    """Every mass is a pixel that moves by five times its place."""
    J, u = 5 * np.eye(places.shape[1]), 5 * (places - reference)
    return Observed(
        gram=np.tile(J.T @ J, (len(u), 1, 1)), right=u @ J, square=(u**2).sum(1), weight=np.full(len(u), 8.0), fps=FPS
    )


@pytest.mark.parametrize("slowing", [0.0, 0.06])
def test_oscillations_come_back_and_foretell_what_follows(slowing):
    body, rng = chain(zones=1), np.random.default_rng(0)
    f, _ = other_system(body)
    places = swung(body, np.array([0.2, 0.12]), slowing, 150, rng)
    half = places[:75]
    swing = identified(body, seen(half, half[-1]), fit_decay(half, FPS), reference=74 / FPS, log=Log(None))
    order = np.argsort(swing.modes.frequency)
    # frames of noise of a tenth of the second amplitude; what is likely beforehand draws the slowing a little to zero
    assert swing.modes.frequency[order] == pytest.approx(f, rel=0.01)
    assert swing.modes.damping[order] == pytest.approx(DAMPING, rel=0.2)
    assert swing.slowing == pytest.approx(slowing, abs=0.02)
    foretold = np.stack([swing.at(t / FPS) - swing.at(74 / FPS) for t in range(75, 150)])
    left = foretold - (places[75:] - half[-1])
    assert np.square(left).sum() < 0.05 * np.square(places[75:] - half[-1]).sum()


def test_another_take_has_its_own_start_and_rest():
    """Half a second of it tells both, and from the amplitude how much slower it is at first."""
    body, rng = chain(zones=1), np.random.default_rng(1)
    first = swung(body, np.array([0.2, 0.12]), 0.06, 75, rng)
    known = first[-1]
    swing = identified(body, seen(first, known), fit_decay(first, FPS), reference=74 / FPS, log=Log(None))
    rest = 0.03 * np.linspace(0, 1, len(known))
    places = rest + swung(body, np.array([-0.1, 0.1]), 0.06 / 4, 90, rng)
    other = another_take(body, seen(places[:15], known), swing.modes, swing.at(74 / FPS))
    foretold = np.stack([other.at(t / FPS) - other.at(14 / FPS) for t in range(15, 90)])
    left, moved = foretold - (places[15:] - places[14]), places[15:] - places[14]
    assert np.square(left).sum() < 0.1 * np.square(moved).sum()
    assert 0 < other.slowing < swing.slowing
