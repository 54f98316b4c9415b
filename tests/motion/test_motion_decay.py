"""Damped oscillations fitted to signals written down in closed form."""

import numpy as np
import pytest
from clips import decaying

from physics3d.motion.decay import fit_decay, with_start
from physics3d.motion.release import free_decay

FPS, FRAMES = 30.0, 90
# (frequency [Hz], damping [1/s]) of what swings; the last but one pair is nearer than 1/3 s allows a Fourier transform
CASES = {
    "one": [(2.0, 0.5)],
    "two": [(2.3, 1.0), (3.1, 0.7)],
    "close": [(2.26, 0.6), (2.50, 0.8)],
    "harmonic": [(1.04, 0.1), (2.08, 0.2)],
}


def signal(poles, rng, *, noise, frames=FRAMES, signals=3):
    t = np.arange(frames) / FPS
    s = np.outer(np.ones(frames), rng.normal(size=signals))
    for f, d in poles:
        phase, size = rng.uniform(0, 2 * np.pi, signals), rng.uniform(1, 3, signals)
        s += np.exp(-d * t)[:, None] * size * np.cos(2 * np.pi * f * t[:, None] + phase)
    return s + noise * rng.normal(size=s.shape)


def nearest(decay, f):
    return int(np.abs(decay.frequency - f).argmin())


@pytest.mark.parametrize("poles", CASES.values(), ids=CASES)
def test_frequencies_and_dampings_come_back_within_their_errors(poles, rng):
    decay = fit_decay(signal(poles, rng, noise=0.05), FPS)
    assert (decay.frequency > 0).sum() == len(poles)
    for f, d in poles:
        j = nearest(decay, f)
        # four standard errors: one case in 16 000; the errors themselves are small against the difference of the poles
        assert abs(decay.frequency[j] - f) < 4 * decay.frequency_error[j] < 0.2
        assert abs(decay.damping[j] - d) < 4 * decay.damping_error[j] < 1.0


def test_standard_errors_are_the_scatter_of_repeated_fits():
    found = []
    for seed in range(30):
        # the same motion, other noise
        clean = signal(CASES["two"], np.random.default_rng(7), noise=0)
        noisy = clean + 0.1 * np.random.default_rng(seed).normal(size=clean.shape)
        decay = fit_decay(noisy, FPS)
        j = nearest(decay, 2.3)
        found.append((decay.frequency[j], decay.damping[j], decay.frequency_error[j], decay.damping_error[j]))
    f, d, f_error, d_error = np.array(found).T
    # the deviation of 30 draws is known to 13 %; three times that
    assert f.std(ddof=1) == pytest.approx(f_error.mean(), rel=0.4)
    assert d.std(ddof=1) == pytest.approx(d_error.mean(), rel=0.4)


def test_the_future_follows_from_the_past(rng):
    s = signal(CASES["two"], rng, noise=0.02, frames=2 * FRAMES)
    decay = fit_decay(s[:FRAMES], FPS)
    future = np.arange(FRAMES, 2 * FRAMES) / FPS
    # signals of size 1 decay to a few tenths; the noise is 0.02
    assert np.sqrt(((decay.at(future) - s[FRAMES:]) ** 2).mean()) < 0.04


def test_noise_alone_has_no_oscillation(rng):
    for _ in range(5):
        assert fit_decay(rng.normal(size=(FRAMES, 3)), FPS).main() is None


def test_what_creeps_back_is_no_oscillation(rng):
    t = np.arange(FRAMES)[:, None] / FPS
    s = np.exp(-1.5 * t) * np.array([2.0, -1.0, 0.5]) + 0.02 * rng.normal(size=(FRAMES, 3))
    decay = fit_decay(s, FPS)
    assert decay.main() is None and decay.damping[0] == pytest.approx(
        1.5, rel=0.05
    )  # 0.02/2 over 90 frames: one per cent


@pytest.mark.parametrize("seed", [27, 28, 38])
def test_a_slow_swing_is_no_creep_of_which_all_terms_are_one(seed):
    """Of 0.25 Hz a sixth of a period is seen, which t^2 exp(-r t) tells as well: three relaxations of one rate."""
    noise = 0.003 * np.random.default_rng(seed).normal(size=(20, 3))
    decay = fit_decay(
        decaying(np.arange(20) / FPS, frequency=0.25, phase=-1.2)[:, None] * [1.0, 0.1, 0.02] + noise, FPS
    )
    rates = np.sort(decay.damping[decay.frequency == 0])
    assert (np.diff(rates) > 0.1 * rates[1:]).all()


def test_a_start_keeps_frequencies_and_finds_the_amplitudes(rng):
    decay = fit_decay(signal(CASES["two"], rng, noise=0.02), FPS)
    other = signal(CASES["two"], rng, noise=0.0, frames=2 * FRAMES)
    started = with_start(decay, other[:30], FPS)
    assert (started.frequency == decay.frequency).all()
    error = started.at(np.arange(30, 90) / FPS) - other[30:90]
    assert np.sqrt((error**2).mean()) < 0.1  # frequencies are known to 0.1 %, over 3 s: a twentieth of a radian at most


@pytest.mark.parametrize("held", [0.0, 0.3, 0.6])
def test_the_release_is_where_a_hand_lets_go(held, rng):
    """The hand carries the thing about smoothly, at will, and lets go: from there on it is a decay."""
    frames = round(held * FPS)
    free = signal(CASES["two"], rng, noise=0.03)
    steps = np.cumsum(rng.normal(size=(frames + 1, 3)), 0)[::-1]
    hand = free[0] + steps[:frames] - steps[-1] if frames else free[:0]
    decay, release = free_decay(np.concatenate([hand, free]), FPS)
    assert abs(release - frames) <= 2  # a frame or two of the hand may look like the decay
    assert decay.frequency[nearest(decay, 2.3)] == pytest.approx(2.3, abs=0.03)


def test_too_few_frames_are_refused():
    with pytest.raises(ValueError, match="at least 8"):
        fit_decay(np.zeros((5, 2)), FPS)
    with pytest.raises(ValueError, match="finite"):
        fit_decay(np.full((20, 2), np.nan), FPS)
