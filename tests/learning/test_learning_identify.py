"""Modes read off a clip: a system of masses that is not the model, integrated in time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg
from test_learning_free_motion import FPS, chain

from physics3d.learning.foretold import has_stopped
from physics3d.learning.identify import another_take, identified
from physics3d.learning.seen_modes import Observed, Sight
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


def swung(body, start, slowing, frames, rng, noise=0.02, rubbing=0.0, power=2):
    """Places [t, m] of the masses, integrated step by step. The frequency of the modes is lower by a share, and their
    damping higher, as a power of the first amplitude is."""
    f, shape = other_system(body)
    fine = 400
    size, fall, phase, q = 1.0, np.zeros(2), np.zeros(2), []
    for i in range(frames * fine):
        if i % fine == 0:
            q.append(start * np.exp(-fall) * np.cos(phase))
        rate = DAMPING * (1 + rubbing * size**power)
        phase += 2 * np.pi * f * (1 - slowing * size**power) / (FPS * fine)
        fall += rate / (FPS * fine)
        size *= 1 - rate[0] / (FPS * fine)
    q = np.stack(q) @ shape.T
    return q + noise / 5 * rng.standard_normal(q.shape)


def observed(places, reference):
    """Every mass is a pixel that moves by five times its place."""
    J, u = 5 * np.eye(places.shape[1]), 5 * (places - reference)
    return Observed(
        gram=np.tile(J.T @ J, (len(u), 1, 1)), right=u @ J, square=(u**2).sum(1), weight=np.full(len(u), 8.0), fps=FPS
    )


@pytest.mark.parametrize("slowing, rubbing, power", [(0.0, 0.0, 1), (0.06, 0.0, 2), (0.06, 1.0, 2), (0.06, 1.0, 1)])
def test_oscillations_come_back_and_foretell_what_follows(slowing, rubbing, power):
    body, rng = chain(zones=1), np.random.default_rng(0)
    f, _ = other_system(body)
    places = swung(body, np.array([0.2, 0.12]), slowing, 150, rng, rubbing=rubbing, power=power)
    half = places[:75]
    swing = identified(body, observed(half, half[-1]), fit_decay(half, FPS), reference=74 / FPS)
    order = np.argsort(swing.modes.frequency)
    # frames of noise of a tenth of the second amplitude; what is likely beforehand draws the slowing a little to zero
    assert swing.modes.frequency[order] == pytest.approx(f, rel=0.01)
    assert swing.modes.damping[order] == pytest.approx(DAMPING, rel=0.2)
    assert swing.large.slower == pytest.approx(slowing, abs=0.02)
    assert swing.large.sooner == pytest.approx(rubbing, abs=0.5)
    foretold = np.stack([swing.at(t / FPS) - swing.at(74 / FPS) for t in range(75, 150)])
    left = foretold - (places[75:] - half[-1])
    assert np.square(left).sum() < 0.05 * np.square(places[75:] - half[-1]).sum()


@pytest.mark.parametrize("creep", [-0.1, 0.0, 0.1])
def test_what_creeps_back_is_no_damping_of_small_swings(creep):
    """A swing about a place that a dash-pot gives back, twelve times faster than the swing dies out: in two and a half
    periods it looks as if large swings were damped less than small ones, or more. To a tenth."""
    body = chain(zones=1)
    f, shape = other_system(body)
    t = np.arange(int(2.5 * FPS / f[0])) / FPS
    q = np.exp(-t) * np.cos(2 * np.pi * f[0] * t) + creep * np.exp(-12 * t)
    places = q[:, None] * shape[:, 0]
    swing = identified(body, observed(places, places[-1]), fit_decay(places, FPS), reference=t[-1])
    assert swing.large.sooner >= 0
    assert swing.modes.damping[0] == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("damping", [0.1, 0.5])
def test_what_a_camera_sees_in_part_is_damped_as_it_is(damping):
    """One mode, half of whose motion shows: a camera that saw all would see ten pixels per metre, not five. What is
    unseen costs the same whatever the damping, so that none is preferred. Noise is a thousandth of the motion. To a
    tenth, or the amplitude at the end to a twentieth."""
    body, rng = chain(zones=1), np.random.default_rng(0)
    f, shape = other_system(body)
    t = np.arange(75) / FPS
    places = (np.exp(-damping * t) * np.cos(2 * np.pi * f[0] * t))[:, None] * shape[:, 0]
    places += 1e-3 * rng.standard_normal(places.shape)
    seen = replace(observed(places, places[-1]), weight=np.full(len(t), 8.0 * 10**2 / body.scale**2))
    swing = identified(body, seen, fit_decay(places, FPS), reference=74 / FPS)
    assert swing.modes.damping[0] == pytest.approx(damping, rel=0.1, abs=0.05 / t[-1])


def test_another_take_has_its_own_start_and_rest():
    """Half a second of it tells both, and from the amplitude how much slower it is at first."""
    body, rng = chain(zones=1), np.random.default_rng(1)
    first = swung(body, np.array([0.2, 0.12]), 0.06, 75, rng)
    known = first[-1]
    swing = identified(body, observed(first, known), fit_decay(first, FPS), reference=74 / FPS)
    rest = 0.03 * np.linspace(0, 1, len(known))
    places = rest + swung(body, np.array([-0.1, 0.1]), 0.06 / 4, 90, rng)
    other = another_take(body, observed(places[:15], known), swing.modes, swing.at(74 / FPS))
    foretold = np.stack([other.at(t / FPS) - other.at(14 / FPS) for t in range(15, 90)])
    left, moved = foretold - (places[15:] - places[14]), places[15:] - places[14]
    assert np.square(left).sum() < 0.1 * np.square(moved).sum()
    assert 0 < other.large.slower < swing.large.slower


@pytest.mark.parametrize("damping", [0.6, 1.0, 1.4])
def test_a_take_that_is_damped_otherwise_says_so_as_far_as_it_is_seen(damping):
    """One and a half periods of it are seen, with frames of noise of a hundredth of its motion; what takes usually
    differ by draws it to the first take, and less than half of the way."""
    body, rng = chain(zones=1), np.random.default_rng(2)
    f, shape = other_system(body)
    drawn = lambda f, d, n: (
        (np.exp(-d * np.arange(n) / FPS) * np.cos(2 * np.pi * f * np.arange(n) / FPS))[:, None] * (0.2 * shape[:, 0])
    )
    noisy = lambda q: q + 0.01 * q.std() * rng.standard_normal(q.shape)
    first = noisy(drawn(f[0], 1.0, 75))
    swing = identified(body, observed(first, first[-1]), fit_decay(first, FPS), reference=74 / FPS)
    seen = round(1.5 * FPS / f[0])
    places = noisy(drawn(1.02 * f[0], damping, seen))
    other = another_take(body, observed(places, first[-1]), swing.modes, swing.at(74 / FPS))
    assert other.modes.frequency[0] == pytest.approx(1.02 * f[0], rel=0.01)
    assert abs(other.modes.damping[0] - damping) <= max(0.1, abs(1.0 - damping) / 2)


def test_another_take_that_tells_nothing_is_as_the_first():
    body, rng = chain(zones=1), np.random.default_rng(3)
    first = swung(body, np.array([0.2, 0.12]), 0.0, 75, rng)
    swing = identified(body, observed(first, first[-1]), fit_decay(first, FPS), reference=74 / FPS)
    still = 0.004 * rng.standard_normal((15, len(body.mass)))
    other = another_take(body, observed(still, first[-1]), swing.modes, swing.at(74 / FPS))
    assert other.modes.damping == pytest.approx(swing.modes.damping, rel=0.1)
    assert other.modes.frequency == pytest.approx(swing.modes.frequency, rel=0.01)


def told_of(body, places, seen):
    """(whether it is taken for stopped, what is foretold from the last of `seen` frames on), every mass a pixel."""
    known, pixels = places[seen - 1], len(body.mass)
    flow = np.stack([5 * (places[:seen] - known), np.zeros((seen, pixels))], -1)[:, None]
    decay = fit_decay(places[:seen], FPS)
    swing = identified(body, observed(places[:seen], known), decay, reference=(seen - 1) / FPS)
    stopped = has_stopped(sight_of(pixels), swing, flow, np.ones((seen, pixels)), fps=FPS, release=0)
    final = swing.stopped() if stopped else swing
    end = final.at((seen - 1) / FPS)
    return stopped, np.stack([final.at(t / FPS) - end for t in range(seen, len(places))])


def sight_of(pixels):
    J = np.zeros((pixels, 2, pixels))
    J[:, 0] = 5 * np.eye(pixels)
    pixel = np.stack([np.zeros(pixels, int), np.arange(pixels)], 1)
    return Sight(thing=np.ones((1, pixels), bool), pixel=pixel, jacobian=J)


@pytest.mark.parametrize("phase", [0.0, 1.5])
@pytest.mark.parametrize("end", [35, 55, 63])
def test_what_has_come_to_rest_stays_there(phase, end):
    """Dry friction stops a swing at one instant, which no sum of decays does. Twelve frames of rest are seen at least;
    half a period is five."""
    body, rng = chain(zones=1), np.random.default_rng(end)
    f, shape = other_system(body)
    t = np.arange(150)
    swing = 0.2 * np.maximum(0, 1 - t / end) * np.cos(2 * np.pi * f[0] * t / FPS + phase)
    clean = swing[:, None] * shape[:, 0]
    stopped, foretold = told_of(body, clean + 0.002 * np.abs(clean).max() * rng.standard_normal(clean.shape), 75)
    # or its decay has died out by itself, to less than the noise: 0.002 of the largest place, at 5 px/m
    assert (stopped and not foretold.any()) or np.abs(foretold).max() < 5 * 0.002 * np.abs(clean).max()


@pytest.mark.parametrize("seen", range(60, 80, 4))
def test_what_still_swings_is_not_taken_for_stopped(seen):
    """Whatever the phase in which the last frame catches it, a turn included."""
    body, rng = chain(zones=1), np.random.default_rng(seen)
    places = swung(body, np.array([0.2, 0.12]), 0.06, 150, rng, noise=0.1)
    stopped, foretold = told_of(body, places, seen)
    moved = places[seen:] - places[seen - 1]
    assert not stopped and np.square(foretold - moved).sum() < 0.5 * np.square(moved).sum()
