"""Curves of all tests at once -> parameters, by Gauss-Newton from several starts.

    minimise sum_i mean_j ((measured_ij - predicted_ij)/scale_i)^2,   scale_i = root mean square of measured_i

so that every test counts alike, whatever its unit and its number of rows; the root of a test's share is its error. The
parameters are theta of `learning/fields.py` (logarithms); derivatives are exact (`materials/histories.py`), steps
those of a trust region within bounds (SciPy; Branch, Coleman and Li 1999).

Relaxation times start spread over the times that the tables span, in five ways, all moduli at the stiffness that the
curves show. Minima other than the best that explain the tests as well are told: two valleys. Where a parameter is not
determined, every interval is walked out to where the tests object (`profile.py`).

Bounds: moduli 1e-4 to 1e4 times the stiffness of the curves; relaxation times from a tenth of the shortest step to a
hundred times the longest test, beyond which nothing would tell them; K/mu of Poisson's ratio from 2/3 to 5000, nu 0 to
0.4999.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import optimize, stats

from physics3d.laboratory.interval import LEVEL, Interval, interval, widened
from physics3d.laboratory.prediction import Prediction, predict
from physics3d.laboratory.profile import ends
from physics3d.laboratory.tables import LabTest
from physics3d.learning.fields import GlobalField, is_poissons_ratio
from physics3d.log import Log
from physics3d.materials.base import AbstractMaterial

STARTS = {  # places of the relaxation times between the shortest step (0) and the longest test (1), on a log scale
    0: ((),),
    1: ((0.1,), (0.3,), (0.5,), (0.7,), (0.9,)),
    2: ((0.9, 0.1), (0.9, 0.5), (0.5, 0.1), (0.7, 0.3), (0.4, 0.6)),
    3: ((0.9, 0.5, 0.1), (0.7, 0.5, 0.3), (0.9, 0.7, 0.3), (0.7, 0.3, 0.1), (0.95, 0.8, 0.6)),
}
LOST = 10.0  # residual, in the scale of its test, of a row that no deformation could meet
LOOK, POLISH = 12, 100  # evaluations of a start, and of one that is among the best
MOST = 0.25  # of the sum of squares, that another answer may have beyond the best
RIVAL = 4.0  # times the least sum of squares: what a start may have after its first look


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Of one valley."""

    theta: Float[np.ndarray, " p"]
    values: dict[str, float]  # every parameter of the material, SI
    intervals: dict[str, tuple[float, float]]  # 90 %, of those that were fitted
    undetermined: tuple[str, ...]  # of these
    cost: float  # sum over tests of the squared error
    interval: Interval


@dataclass(frozen=True, kw_only=True)
class Fits:
    """The best fit and those in other valleys that explain the tests as well."""

    best: Fit
    others: tuple[Fit, ...]


def relative_error(test: LabTest, prediction: Prediction) -> float:
    """Root mean square of the residual over that of the measurement; infinite where the material failed."""
    if prediction.lost:
        return float("inf")
    off = np.linalg.norm(test.measured - prediction.measured)
    return float(off / np.linalg.norm(test.measured))


def fit(material: AbstractMaterial, field: GlobalField, tests: list[LabTest], *, log: Log) -> Fits:
    """Raises ValueError in one line if there are fewer rows than parameters, a parameter is of a kind that is not
    fitted, or no start can be loaded as the tests are."""
    count = len(field.names)
    rows = sum(len(test.time) for test in tests)
    if rows <= count:
        raise ValueError(f"{rows} rows for {count} parameters; give more rows, or fewer names in learn of the material")
    bounds = limits(field, tests)
    cache: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def both(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = theta.tobytes()
        if key not in cache:
            cache.clear()
            if allowed(material, field, theta):
                r, J = (np.concatenate(x) for x in residuals(tests, predict(material, field, theta, tests)))
            else:
                r, J = np.full(rows, LOST), np.zeros((rows, count))
            cache[key] = r, J
        return cache[key]

    def descend(theta: np.ndarray, evaluations: int) -> tuple[np.ndarray, float]:
        found = optimize.least_squares(
            lambda x: both(x)[0], theta, lambda x: both(x)[1], bounds=bounds, max_nfev=evaluations, x_scale=1.0
        )
        return found.x, 2 * found.cost

    looked = []
    for theta in starts(material, field, tests, bounds):
        if not allowed(material, field, theta) or any(p.lost for p in predict(material, field, theta, tests)):
            continue
        looked.append(descend(theta, LOOK))
        log.info(f"start {len(looked)}: error {100 * np.sqrt(looked[-1][1] / len(tests)):.3g} %")
    if not looked:
        raise ValueError(f"no start bears the loads of {', '.join(t.name for t in tests)}; look at units and signs")
    least = min(cost for _, cost in looked)
    polished = sorted((descend(x, POLISH) for x, cost in looked if cost <= RIVAL * least), key=lambda pair: pair[1])
    valleys = [_fit(material, field, x, cost, tests, bounds) for x, cost in polished]
    best = valleys[0]
    others: list[Fit] = []
    if best.undetermined:
        walked = ends(best.theta, bounds, lambda x: both(x)[0], lambda x: both(x)[1], as_good(best, 1))
        best = _named(field, best.theta, best.cost, widened(best.interval, *walked, bounds))
    for rival in valleys[1:]:
        if rival.cost <= as_good(best, count) and all(apart(known, rival) for known in (best, *others)):
            others.append(rival)
    return Fits(best=best, others=tuple(others))


def allowed(material: AbstractMaterial, field: GlobalField, theta: np.ndarray) -> bool:
    """Whether the parameters obey what the material asks of all of them together, as Yeoh's do."""
    try:
        material.check_parameters(field.parameters(torch.from_numpy(theta)))
    except ValueError:
        return False
    return True


def residuals(tests: list[LabTest], predictions: list[Prediction]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(predicted - measured in the scale of the test, its derivative), of each test; the squares of one add up to its
    squared error."""
    r, J = [], []
    for test, prediction in zip(tests, predictions):
        scale = np.linalg.norm(test.measured)
        if prediction.lost:
            r.append(np.full(len(test.time), LOST / np.sqrt(len(test.time))))
            J.append(np.zeros_like(prediction.slope))
        else:
            r.append((prediction.measured - test.measured) / scale)
            J.append(prediction.slope / scale)
    return r, J


def stiffness(tests: list[LabTest]) -> float:
    """Largest secant modulus of the curves, stress over strain by their root mean squares [Pa]."""
    return max(float(np.linalg.norm(t.stress) / np.linalg.norm(t.deformation - t.rest)) for t in tests)


def span_of_times(tests: list[LabTest]) -> tuple[float, float]:
    """(shortest step, longest test) [s]."""
    return min(np.diff(t.time).min() for t in tests), max(t.time[-1] - t.time[0] for t in tests)


def limits(field: GlobalField, tests: list[LabTest]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of theta."""
    modulus, (shortest, longest) = stiffness(tests), span_of_times(tests)
    lower, upper = [], []
    for group in field.groups:
        start, name = float(field.start[group[0]]), group[0]
        if is_poissons_ratio(name):
            start, low, high = 2 * (1 + start) / (3 * (1 - 2 * start)), 2 / 3, 5e3
        elif _is_time(name):
            low, high = 0.1 * shortest, 100 * longest
        elif name.rstrip("_23").endswith(("modulus", "stress")):
            low, high = 1e-4 * modulus, 1e4 * modulus
        else:
            raise ValueError(f"{name} is no modulus, stress, relaxation time or Poisson's ratio; take it out of learn")
        lower.append(np.log(low / start))
        upper.append(np.log(high / start))
    return np.array(lower), np.array(upper)


def starts(material: AbstractMaterial, field: GlobalField, tests: list[LabTest], bounds) -> list[np.ndarray]:
    """theta with relaxation times spread over the tables, all moduli scaled to what the curves show."""
    shortest, longest = span_of_times(tests)
    times = [i for i, group in enumerate(field.groups) if _is_time(group[0])]
    moduli = [i for i, g in enumerate(field.groups) if not _is_time(g[0]) and not is_poissons_ratio(g[0])]
    suffixes = list(dict.fromkeys(_suffix(field.groups[i][0]) for i in times))
    found = []
    for places in STARTS[len(suffixes)]:
        theta = np.zeros(len(field.groups))
        for i in times:
            place = places[suffixes.index(_suffix(field.groups[i][0]))]
            wanted = shortest * (longest / shortest) ** place
            theta[i] = np.log(wanted / float(field.start[field.groups[i][0]]))
        for i in moduli:
            theta[i] = np.log(stiffness(tests) / float(field.start[field.groups[i][0]])) - np.log(len(moduli))
        for _ in range(2 if moduli else 0):  # once more where the law is not linear
            if not allowed(material, field, theta):
                break
            predictions = predict(material, field, theta, tests)
            factors = [_softer(t, p) for t, p in zip(tests, predictions) if not p.lost]
            theta[moduli] += np.log(np.median(factors)) if factors else np.log(10)
        found.append(np.clip(theta, bounds[0] + 1e-6, bounds[1] - 1e-6))
    return found


def _softer(test: LabTest, prediction: Prediction) -> float:
    """By what the moduli have to be multiplied for the curve to have its size."""
    ratio = np.linalg.norm(test.measured) / max(float(np.linalg.norm(prediction.measured)), 1e-300)
    return float(ratio if test.control == "deformation" else 1 / ratio)


def _is_time(name: str) -> bool:
    return name.rstrip("_23").endswith("relaxation_time")


def _suffix(name: str) -> str:
    return name[-2:] if name.endswith(("_2", "_3")) else ""


def _fit(material, field: GlobalField, theta: np.ndarray, cost: float, tests: list[LabTest], bounds) -> Fit:
    r, J = residuals(tests, predict(material, field, theta, tests))
    # rows before anything happens agree whatever the material is, and would make the noise too small
    told = [np.any(j != 0, 1) for j in J]
    seen = [(a[k], j[k]) for a, j, k in zip(r, J, told) if k.any()]
    return _named(field, theta, cost, interval(theta, [a for a, _ in seen], [j for _, j in seen], bounds))


def _named(field: GlobalField, theta: np.ndarray, cost: float, found: Interval) -> Fit:
    ends = [_values(field, x) for x in (found.lower, found.upper)]
    intervals = {name: (ends[0][name], ends[1][name]) for group in field.groups for name in group}
    undetermined = tuple(n for group, told in zip(field.groups, found.determined) if not told for n in group)
    values = _values(field, theta)
    return Fit(theta=theta, values=values, intervals=intervals, undetermined=undetermined, cost=cost, interval=found)


def _values(field: GlobalField, theta: np.ndarray) -> dict[str, float]:
    return {name: float(value) for name, value in field.parameters(torch.from_numpy(theta)).items()}


def as_good(best: Fit, parameters: int) -> float:
    """The largest sum of squares that the tests, worth as many independent rows as they are, cannot tell from the
    best, so many parameters being free (F test, 90 %). At most a quarter more: where a law cannot follow a curve, its
    residuals are hardly worth a row, and any other would do."""
    left = freedom(best)
    return best.cost * (1 + min(parameters / left * float(stats.f.ppf(LEVEL, parameters, left)), MOST)) + 1e-20


def freedom(fit: Fit) -> float:
    """Independent rows that are left when the parameters are paid for."""
    return max(fit.interval.worth - len(fit.theta), 1.0)


def apart(one: Fit, other: Fit) -> bool:
    """Whether two fits are two answers: not the same with its branches in another order, nor two points of one flat
    valley."""

    def ordered(fit: Fit) -> list[list[float]]:
        """Logarithms of the ends, branches in the order of their relaxation times."""
        branches = [
            [n for n in fit.intervals if _suffix(n) == s and ("branch" in n or _is_time(n))] for s in ("", "_2", "_3")
        ]
        own = [n for n in fit.intervals if not any(n in b for b in branches)]

        def slowness(names: list[str]) -> float:
            return -max((fit.values[n] for n in names if _is_time(n)), default=0.0)

        names = own + list(itertools.chain(*sorted((b for b in branches if b), key=slowness)))
        found = []
        for n in names:
            # Poisson's ratio by what is missing to 1/2
            found.append(sorted(np.log(0.5 - v if is_poissons_ratio(n) else v) for v in fit.intervals[n]))
        return found

    margin = np.log(1.2)
    pairs = zip(ordered(one), ordered(other))
    return any(low_b > high_a + margin or high_b < low_a - margin for (low_a, high_a), (low_b, high_b) in pairs)
