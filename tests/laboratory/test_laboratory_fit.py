"""Parameters come back from curves of closed forms, with intervals that are true.

Standard linear solid in small shear, G the long-term modulus, g that of the branch, T its relaxation time:

    step strain e       tau = e (G + g e^(-t/T))
    step stress s       gamma = s/G (1 - g/(G + g) e^(-t/R)),   R = T (G + g)/G
    e sin(w t), t -> oo tau = e (G' sin(w t) + G'' cos(w t)),   G' = G + g x^2/(1 + x^2), G'' = g x/(1 + x^2), x = w T
"""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import optimize, signal

from physics3d.laboratory.fit import fit, limits
from physics3d.laboratory.interval import interval
from physics3d.laboratory.prediction import predict
from physics3d.laboratory.tables import LabTest
from physics3d.learning.fields import GlobalField
from physics3d.log import Log
from physics3d.materials.mooney_rivlin import MooneyRivlin
from physics3d.materials.viscoelastic import Viscoelastic

LONG, BRANCH, TIME = 4e4, 6e4, 0.7  # G, g [Pa], T [s]
SLS = GlobalField(
    start={
        n: torch.tensor(v, dtype=torch.float64)
        for n, v in {
            "youngs_modulus": 5e4,
            "poissons_ratio": 0.3,
            "branch_shear_modulus": 1e4,
            "branch_bulk_modulus": 2.2e4,
            "shear_relaxation_time": 0.05,
            "bulk_relaxation_time": 0.05,
        }.items()
    },
    learn=("youngs_modulus", "branch_shear_modulus", "shear_relaxation_time"),
    ties=(("branch_shear_modulus", "branch_bulk_modulus"), ("shear_relaxation_time", "bulk_relaxation_time")),
)
TRUTH = {"youngs_modulus": LONG * 2.6, "branch_shear_modulus": BRANCH, "shear_relaxation_time": TIME}
SMALL = 1e-3  # shear: quadratic terms are a thousandth of the noise


def shear(name, time, deformation, stress, *, control="deformation", lead=1e-12):
    return LabTest(
        name=name, kind="shear", control=control, lead=lead, time=time, deformation=deformation, stress=stress
    )


def relaxation(lead=1e-12):
    time = np.geomspace(1e-2, 20, 40)
    return shear("relaxation", time, np.full(40, SMALL), SMALL * (LONG + BRANCH * np.exp(-time / TIME)), lead=lead)


def closed_forms() -> list[LabTest]:
    t = np.geomspace(1e-2, 20, 40)
    step = relaxation()
    # its first row is where the step has been held for a hundredth of a second
    step = dataclasses.replace(
        step,
        time=np.concatenate([[0], t]),
        deformation=np.full(41, SMALL),
        stress=np.concatenate([[SMALL * (LONG + BRANCH)], step.stress]),
    )
    slow = TIME * (LONG + BRANCH) / LONG
    t = np.concatenate([[0], t])
    creep = SMALL * (1 - BRANCH / (LONG + BRANCH) * np.exp(-t / slow))
    # its transient belongs to the closed form too: Laplace transform of a sine that starts at 0
    w = 3.0
    x, time = w * TIME, np.linspace(0, 6, 181)
    storage, loss = LONG + BRANCH * x**2 / (1 + x**2), BRANCH * x / (1 + x**2)
    wave = SMALL * (storage * np.sin(w * time) + loss * (np.cos(w * time) - np.exp(-time / TIME)))
    return [
        step,
        shear("creep", t, creep, np.full(len(t), SMALL * LONG), control="stress"),
        shear("oscillation", time, SMALL * np.sin(w * time), wave),
    ]


def noisy(test: LabTest, rng, noise: float) -> LabTest:
    off = noise * np.abs(test.measured).max() * rng.standard_normal(len(test.time))
    if test.control == "stress":
        return dataclasses.replace(test, deformation=test.deformation + off)
    return dataclasses.replace(test, stress=test.stress + off)


def at(truth: dict[str, float]) -> np.ndarray:
    return np.array([np.log(truth[g[0]] / float(SLS.start[g[0]])) for g in SLS.groups])


def test_closed_forms_of_the_standard_linear_solid_are_predicted():
    for test, found in zip(closed_forms(), predict(Viscoelastic(), SLS, at(TRUTH), closed_forms())):
        # creep rows are steps of constant rate of strain: where they are long beside R, up to 1 %; a sine between 181
        # rows is a polygon, (w dt)^2/12 = 8e-4; strains of 1e-3 squared
        rough = {"creep": 1e-2, "oscillation": 2e-3, "relaxation": 1e-5}[test.name]
        np.testing.assert_allclose(found.measured, test.measured, rtol=0, atol=rough * np.abs(test.measured).max())


@pytest.mark.parametrize("chosen", [(0,), (1,), (2,), (0, 1, 2)], ids=["relaxation", "creep", "oscillation", "all"])
def test_the_standard_linear_solid_comes_back_within_its_intervals(chosen, rng):
    tests = [noisy(test, rng, 0.01) for i, test in enumerate(closed_forms()) if i in chosen]
    found = fit(Viscoelastic(), SLS, tests, log=Log(None))
    for name, true in TRUTH.items():
        low, high = found.best.intervals[name]
        # 90 % intervals of one draw: truth is asked for within twice their width
        assert low / (high / low) < true < high * (high / low) and high / low < 1.25, (name, low, true, high)
    assert not found.others and not found.best.undetermined


def test_rubber_of_closed_form_comes_back(rng):
    """Incompressible Mooney-Rivlin: nominal stress 2 (a - a^-2)(C_1 + C_2/a), no matter how fast."""
    first, second = 1.4e5, 4e4
    stretch = np.concatenate([np.linspace(1, 3, 30), np.linspace(2.9, 0.6, 30)])
    nominal = 2 * (stretch - stretch**-2) * (first + second / stretch)
    test = LabTest(
        name="pull", kind="nominal", control="deformation", lead=1e-9, time=np.arange(60.0), deformation=stretch,
        stress=nominal,
    )  # fmt: skip
    start = {"first_modulus": 2e4, "second_modulus": 2e4, "bulk_modulus": 1e9}
    field = GlobalField(
        start={n: torch.tensor(v, dtype=torch.float64) for n, v in start.items()},
        learn=("first_modulus", "second_modulus"),
    )
    exact = fit(MooneyRivlin(), field, [test], log=Log(None)).best.values
    # K of a thousand times the stress: volume changes by that much
    assert exact["first_modulus"] == pytest.approx(first, rel=2e-3)
    assert exact["second_modulus"] == pytest.approx(second, rel=1e-2)
    best = fit(MooneyRivlin(), field, [noisy(test, rng, 0.005)], log=Log(None)).best
    for name, true in (("first_modulus", first), ("second_modulus", second)):
        low, high = best.intervals[name]
        assert low**2 / high < true < high**2 / low and high / low < 1.5


def test_how_a_specimen_came_to_its_first_row_matters():
    """After a jump it pulls by G + g, after a long rest by G, after a ramp of length L by the integral between."""
    t, held = np.array([0.0, 0.1]), np.full(2, SMALL)
    for lead, modulus in ((1e-12, LONG + BRANCH), (1e9, LONG), (2.0, LONG + BRANCH * TIME / 2 * -np.expm1(-2 / TIME))):
        test = shear("held", t, held, np.ones(2), lead=lead)
        found = predict(Viscoelastic(), SLS, at(TRUTH), [test])[0].measured[0]
        assert found == pytest.approx(SMALL * modulus, rel=1e-5), lead  # strains of 1e-3 squared


def test_what_the_tests_do_not_tell_is_said(rng):
    """A second of relaxation does not tell how long a minute's relaxation takes, but its sum of moduli."""
    slow = {**TRUTH, "shear_relaxation_time": 60.0}
    time = np.linspace(0, 1, 20)
    stress = SMALL * (LONG + BRANCH * np.exp(-time / 60.0))
    test = noisy(shear("short", time, np.full(20, SMALL), stress), rng, 0.01)
    best = fit(Viscoelastic(), SLS, [test], log=Log(None)).best
    assert "shear_relaxation_time" in best.undetermined and "bulk_relaxation_time" in best.undetermined
    low, high = best.intervals["shear_relaxation_time"]
    lower, upper = (np.exp(x[-1]) * 0.05 for x in limits(SLS, [test]))
    assert lower * 0.999 <= low < slow["shear_relaxation_time"] < high <= upper * 1.001


def test_two_valleys_are_told():
    """Two processes six decades apart and as strong as each other, and one branch to draw them: it takes either."""
    time = np.geomspace(1e-5, 1e5, 31)
    stress = SMALL * (LONG + BRANCH * np.exp(-time / 1e-3) + BRANCH * np.exp(-time / 1e3))
    time = np.concatenate([[0], time])
    stress = np.concatenate([[SMALL * (LONG + 2 * BRANCH)], stress])
    found = fit(Viscoelastic(), SLS, [shear("two", time, np.full(32, SMALL), stress)], log=Log(None))
    times = sorted(f.values["shear_relaxation_time"] for f in (found.best, *found.others))
    assert len(times) == 2 and times[0] < 1 < times[1], times


def test_fewer_rows_than_parameters_is_an_error():
    time = np.array([0.0, 1.0, 2.0])
    test = shear("brief", time, SMALL * time, LONG * SMALL * time)
    with pytest.raises(ValueError, match=r"3 rows for 3 parameters; give more rows"):
        fit(Viscoelastic(), SLS, [test], log=Log(None))


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_intervals_cover_the_truth(rho, rng):
    """200 draws of two noisy curves, fitted by SciPy with the closed form: the truth is inside for 80 to 97 % of them,
    of each parameter, and with correlated noise an interval that takes rows as independent would not."""
    t = [np.geomspace(0.02, 10, 60), np.linspace(0.1, 5, 40)]
    true = np.log([LONG, BRANCH, TIME])

    def curve(theta, t):
        G, g, T = np.exp(theta)
        return (G + g * np.exp(-t / T)) / 1e5

    def slope(theta, t):
        G, g, T = np.exp(theta)
        decay = np.exp(-t / T)
        return np.stack([np.full_like(t, G), g * decay, g * decay * t / T], 1) / 1e5

    inside, naive, draws = np.zeros(3), np.zeros(3), 200
    for _ in range(draws):
        data = []
        for i, x in enumerate(t):
            white = rng.standard_normal(len(x) + 200) * np.sqrt(1 - rho**2)
            data.append(curve(true, x) + 0.02 * (1 + i) * signal.lfilter([1], [1, -rho], white)[200:])
        residual = lambda theta, data=data: np.concatenate([curve(theta, x) - y for x, y in zip(t, data)])
        found = optimize.least_squares(residual, true, lambda theta: np.concatenate([slope(theta, x) for x in t])).x
        told = interval(
            found, [curve(found, x) - y for x, y in zip(t, data)], [slope(found, x) for x in t],
            (true - 10, true + 10),
        )  # fmt: skip
        inside += (told.lower < true) & (true < told.upper)
        J = np.concatenate([slope(found, x) for x in t])
        se = np.sqrt(np.diag(np.linalg.inv(J.T @ J)) * (residual(found) ** 2).sum() / (len(J) - 3))
        naive += np.abs(found - true) < 1.66 * se
    assert (inside / draws >= 0.8).all() and (inside / draws <= 0.97).all(), inside / draws
    if rho:
        assert (naive / draws < 0.75).any(), naive / draws
