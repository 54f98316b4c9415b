"""Free decay: damped oscillations with common frequencies and dampings, fitted to several signals at once.

    s_k(t) = c_k + sum_j exp(-d_j t) (a_jk cos 2 pi f_j t + b_jk sin 2 pi f_j t) + sum_i e_ik exp(-r_i t)

f in Hz, d and r (relaxations: what creeps back without swinging) in 1/s, t from the first frame that is fitted.
Starting values are those of the matrix pencil (Hua and Sarkar 1990) on the Hankel matrices of all signals; two
frequencies nearer than 1/T come apart because a pencil is no Fourier transform. Terms are taken up one by one, the one
that explains most first, and after each all f, d, r are refined by variable projection (Golub and Pereyra 1973): c, a,
b, e are linear and solved inside. Terms stop where the Bayesian information criterion does.

Standard errors are those of least squares, from the residual, for errors that are independent from frame to frame.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

FASTEST = 15.0  # damping of what is still told from a jump [1/s]
APART = 0.1  # of its rate, that a relaxation is from the next
FLOOR = 0.01  # flow is not better than that: less is no misfit [px rms]


@dataclass(frozen=True, kw_only=True)
class Decay:
    """Terms sorted by frequency; relaxations have f = 0 and no sine."""

    start: float  # time of the first frame that was fitted, from which t counts [s]
    end: float  # ... and of the last [s]
    frequency: Float[np.ndarray, " j"]  # [Hz]
    damping: Float[np.ndarray, " j"]  # [1/s]
    frequency_error: Float[np.ndarray, " j"]  # standard error [Hz]; 0 for a relaxation
    damping_error: Float[np.ndarray, " j"]  # [1/s]
    constant: Float[np.ndarray, " k"]  # c
    cosine: Float[np.ndarray, "j k"]  # a, or e
    sine: Float[np.ndarray, "j k"]  # b
    linear_error: Float[np.ndarray, "j k"]  # standard error of the amplitude |a + i b|
    residual: float  # rms over frames and signals
    explained: float  # fraction of the variance of the signals

    def terms(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "j n k"]:
        """What each term does at times t [s], counted as `start` is."""
        tau = np.asarray(t, float)[None] - self.start
        decay = np.exp(-self.damping[:, None] * tau)
        angle = 2 * np.pi * self.frequency[:, None] * tau
        return (decay * np.cos(angle))[..., None] * self.cosine[:, None] + (decay * np.sin(angle))[
            ..., None
        ] * self.sine[:, None]

    def at(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
        """The signals at times t [s]."""
        return self.constant + self.terms(t).sum(0)

    def amplitude(self, t: float) -> Float[np.ndarray, " j"]:
        """|a + i b| exp(-d t) over all signals: how much of each term there is at time t [unit of the signals]."""
        size = np.sqrt((self.cosine**2 + self.sine**2).sum(1))
        return size * np.exp(-self.damping * (t - self.start))

    def gain(self) -> Float[np.ndarray, " j"]:
        """max(0, 1 - noise/amplitude^2) of each term: amplitude that is noise is left at zero."""
        power = (self.cosine**2 + self.sine**2).sum(1)
        return np.clip(1 - (self.linear_error**2).sum(1) / np.maximum(power, 1e-30), 0, 1)

    def main(self) -> int | None:
        """The oscillation with the largest amplitude in the middle of what was seen; None if nothing swings."""
        size = np.where(self.frequency > 0, self.amplitude((self.start + self.end) / 2), 0)
        return int(size.argmax()) if len(size) and size.max() > 0 else None


def fit_decay(signal: Float[np.ndarray, "n k"], fps: float, *, first: int = 0, most: int = 5) -> Decay:
    """The decay of frames `first` onward, of at most `most` terms; of none where noise is all there is.

    Raises ValueError for fewer than 8 frames or signals that are not finite.
    """
    s = np.asarray(signal, float)[first:]
    if len(s) < 8 or not np.isfinite(s).all():
        raise ValueError(f"{len(s)} frames of signal from frame {first}; a decay needs at least 8, all finite")
    t = np.arange(len(s)) / fps
    candidates = pencil(s, fps, 2 * most + 2)
    best = _solved(s, t, np.zeros((0, 2)), fps, first)
    best_cost, poles = _information(best, s), np.zeros((0, 2))
    for _ in range(min(most, (len(s) - 2) // 4)):
        tried = [np.vstack([poles, c]) for c in candidates if not (poles == c).all(1).any()]
        if not tried:
            break
        poles = min(tried, key=lambda p: _misfit(s, t, p))
        refined = _refined(s, t, poles)
        candidates = [c for c in candidates if not np.allclose(c, poles[-1])]
        if _merged(refined):
            poles = poles[:-1]
            continue
        found = _solved(s, t, refined, fps, first)
        cost = _information(found, s)
        poles = refined
        if cost < best_cost:
            best, best_cost = found, cost
        if found.residual <= FLOOR:
            break
    return best


def with_start(decay: Decay, signal: Float[np.ndarray, "n k"], fps: float, *, first: int = 0) -> Decay:
    """The same frequencies and dampings, with constant and amplitudes of another recording of the same thing."""
    s = np.asarray(signal, float)[first:]
    poles = np.stack([decay.frequency, decay.damping], 1)
    found = _solved(s, np.arange(len(s)) / fps, poles, fps, first)
    return replace(found, frequency_error=decay.frequency_error, damping_error=decay.damping_error)


def pencil(signal: Float[np.ndarray, "n k"], fps: float, order: int) -> list[tuple[float, float]]:
    """(frequency [Hz] or 0, damping [1/s]) of all signals together, by the matrix pencil with `order` poles."""
    n = len(signal)
    length = n // 2
    windows = np.lib.stride_tricks.sliding_window_view(signal - signal.mean(0), length + 1, axis=0)
    _, _, right = np.linalg.svd(windows.reshape(-1, length + 1), full_matrices=False)
    right = right[: min(order, length - 1, len(right))].T
    z = np.linalg.eigvals(np.linalg.lstsq(right[:-1], right[1:], rcond=None)[0])
    rate = np.log(z[np.abs(z) > 1e-6].astype(complex)) * fps
    lowest = 0.3 * fps / n
    found = []
    for s in rate[rate.imag >= 0]:
        f, d = s.imag / (2 * math.pi), -s.real
        if f < lowest:
            f = 0.0
        if f < 0.45 * fps and (d > fps / n or f > 0) and d < FASTEST:
            found.append((float(f), float(max(d, 0.0))))
    return [*found, (0.0, 3 * fps / n), (0.0, 10 * fps / n)]


def _basis(t: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """Columns: 1, then exp(-d t) cos and sin of every oscillation and exp(-d t) of every relaxation."""
    columns = [np.ones_like(t)]
    for f, d in poles:
        decay = np.exp(-d * t)
        columns.append(decay * np.cos(2 * np.pi * f * t))
        if f > 0:
            columns.append(decay * np.sin(2 * np.pi * f * t))
    return np.stack(columns, 1)


def _misfit(s: np.ndarray, t: np.ndarray, poles: np.ndarray) -> float:
    q, _ = np.linalg.qr(_basis(t, poles))
    return float((s**2).sum() - ((q.T @ s) ** 2).sum())


def _jacobian(s: np.ndarray, t: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """d residual/d (f of the oscillations, then d) [n k, m] by -P dB/dp B^+ s (Kaufman 1975)."""
    basis = _basis(t, poles)
    q, r = np.linalg.qr(basis)
    linear = np.linalg.lstsq(r, q.T @ s, rcond=None)[0]
    by_f, by_d, column = [], [], 1
    for f, _ in poles:
        if f > 0:
            a, b = linear[column], linear[column + 1]
            cosine, sine = basis[:, column, None], basis[:, column + 1, None]
            by_f.append(2 * np.pi * t[:, None] * (cosine * b - sine * a))
            by_d.append(-t[:, None] * (cosine * a + sine * b))
            column += 2
        else:
            by_d.append(-t[:, None] * basis[:, column, None] * linear[column])
            column += 1
    change = np.stack(by_f + by_d, -1).reshape(len(t), -1)
    return -(change - q @ (q.T @ change)).reshape(s.size, -1)


def _unpacked(x: np.ndarray, swings: np.ndarray) -> np.ndarray:
    """(f of the oscillations, then d) -> poles [j, 2]; a relaxation stays one."""
    f = np.zeros(len(swings))
    f[swings] = x[: swings.sum()]
    return np.stack([f, x[swings.sum() :]], 1)


def _refined(s: np.ndarray, t: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """f, d by variable projection from `poles`."""
    from scipy.optimize import least_squares

    swings, duration = poles[:, 0] > 0, float(t[-1])
    lower = np.concatenate([np.full(swings.sum(), 0.3 / duration), np.where(swings, 0.0, 1 / duration)])
    upper = np.concatenate([np.full(swings.sum(), 0.48 / t[1]), np.full(len(poles), 1.2 * FASTEST)])
    start = np.clip(np.concatenate([poles[swings, 0], poles[:, 1]]), lower + 1e-9, upper - 1e-9)

    def residual(x):
        q, _ = np.linalg.qr(_basis(t, _unpacked(x, swings)))
        return (s - q @ (q.T @ s)).ravel()

    def jacobian(x):
        return _jacobian(s, t, _unpacked(x, swings))

    done = least_squares(residual, start, jacobian, bounds=(lower, upper), x_scale=1 / duration, max_nfev=60)
    return _unpacked(done.x, swings)


def _merged(poles: np.ndarray) -> bool:
    """Whether two relaxations have come so near that they are the polynomial t exp(-r t): no creep, but a slow swing of
    which less than half is seen."""
    rates = np.sort(poles[poles[:, 0] == 0, 1])
    return bool((np.diff(rates) < APART * rates[1:]).any())


def _solved(s: np.ndarray, t: np.ndarray, poles: np.ndarray, fps: float, first: int) -> Decay:
    """Linear part and standard errors for given poles."""
    poles = poles[np.argsort(poles[:, 0], kind="stable")]
    basis = _basis(t, poles)
    linear = np.linalg.lstsq(basis, s, rcond=None)[0]
    residual = s - basis @ linear
    freedom = max(1, s.size - linear.size - 2 * len(poles))
    noise = max(float((residual**2).sum()) / freedom, 1e-30)
    cosine, sine = np.zeros((len(poles), s.shape[1])), np.zeros((len(poles), s.shape[1]))
    share = noise * np.diag(np.linalg.pinv(basis.T @ basis))
    error, row = np.zeros(len(poles)), 1
    for j, (f, _) in enumerate(poles):
        cosine[j] = linear[row]
        error[j] = share[row]
        if f > 0:
            sine[j] = linear[row + 1]
            error[j] += share[row + 1]
        row += 1 + (f > 0)
    errors = _pole_errors(s, t, poles, noise)
    variance = float(((s - s.mean(0)) ** 2).sum())
    return Decay(
        start=first / fps,
        end=(first + len(s) - 1) / fps,
        frequency=poles[:, 0],
        damping=poles[:, 1],
        frequency_error=errors[:, 0],
        damping_error=errors[:, 1],
        constant=linear[0],
        cosine=cosine,
        sine=sine,
        linear_error=np.repeat(np.sqrt(error)[:, None], s.shape[1], 1),
        residual=float(np.sqrt((residual**2).mean())),
        explained=1 - float((residual**2).sum()) / variance if variance > 0 else 0.0,
    )


def _pole_errors(s: np.ndarray, t: np.ndarray, poles: np.ndarray, noise: float) -> np.ndarray:
    """Standard errors of f and d [j, 2], for errors of variance `noise`."""
    if not len(poles):
        return np.zeros((0, 2))
    jacobian = _jacobian(s, t, poles)
    covariance = noise * np.linalg.pinv(jacobian.T @ jacobian)
    return _unpacked(np.sqrt(np.maximum(np.diag(covariance), 0)), poles[:, 0] > 0)


def _information(decay: Decay, s: np.ndarray) -> float:
    """Length of a description of the signals: n k ln(residual) + 1/2 (number of parameters) ln(n k)."""
    swings = decay.frequency > 0
    count = (1 + len(swings) + swings.sum()) * s.shape[1] + len(swings) + swings.sum()
    return s.size * math.log(max(decay.residual, FLOOR)) + 0.5 * count * math.log(s.size)
