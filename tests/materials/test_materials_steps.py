"""Whatever steps a history is cut into: analytic curves, differential equations, slow flow and rotations."""

import math

import numpy as np
import pytest
import scipy.integrate
import torch
from mpm_bodies import tensors

from physics3d.materials import driver
from physics3d.materials.herschel_bulkley import HerschelBulkley
from physics3d.materials.material_points import advance
from physics3d.materials.mixture import Mixture
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.materials.with_branches import WithBranches

MU, K_D, RATE, RAMP = 2.0, 4.0, 0.5, 1.0  # [Pa], [1/s], [1/s], [s]


def rows_of_50_ms() -> np.ndarray:
    return np.arange(0, 2.001, 0.05)


def rows_on_a_logarithmic_scale() -> np.ndarray:
    """Dense after the start and after the corner."""
    after = np.geomspace(1e-4, 1, 25)
    return np.concatenate([[0], after, 1 + after])


def fine_then_coarse() -> np.ndarray:
    """1e-4 s, then 1/30 s, with single short steps between."""
    time = [0.0]
    for dt in [1e-4] * 50 + [1 / 30] * 20 + [1e-4] * 3 + [1 / 30] * 6 + [1e-3] * 5:
        time.append(time[-1] + dt)
    return np.unique(np.concatenate([time, [1.0, 2.0]]))


def beyond_all_relaxation_times() -> np.ndarray:
    """Steps of 0.001 to 4 relaxation times."""
    return np.array([0, 1e-3, 0.9, 0.9001, 1.0, 1.001, 1.8, 1.81, 2.0])


STEPS = [rows_of_50_ms, rows_on_a_logarithmic_scale, fine_then_coarse, beyond_all_relaxation_times]


def strain(time: np.ndarray, k: float = K_D) -> np.ndarray:
    """z' = rate - k z while time < RAMP, then z' = -k z."""
    ramp = RATE / k * (1 - np.exp(-k * np.minimum(time, RAMP)))
    return ramp * np.exp(-k * np.maximum(time - RAMP, 0))


def stretched(time: np.ndarray) -> torch.Tensor:
    """Isochoric, exp(RATE t) along x until RAMP, then held."""
    stretch = torch.exp(RATE * torch.tensor(np.minimum(time, RAMP)))
    return torch.diag_embed(torch.stack([stretch, stretch**-0.5, stretch**-0.5], 1))


def branch(suffix: str = "", k_d: float = K_D) -> dict[str, float]:
    values = dict(branch_shear_modulus=MU, branch_bulk_modulus=5.0)
    values |= dict(shear_relaxation_time=1 / k_d, bulk_relaxation_time=2.0)
    return {name + suffix: value for name, value in values.items()}


def difference_of_stress(material, values, time, dtype=torch.float64):
    """tau_11 - tau_22 along the ramp and the hold."""
    tau = driver.prescribed(material, tensors(values), torch.tensor(time), stretched(time).to(dtype))
    return (tau[:, 0, 0] - tau[:, 1, 1]).double().numpy()


def hencky(z):
    return 3 * MU * z


def neo_hookean(z):
    return MU * (np.exp(2 * z) - np.exp(-z))


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("spring, stress", [("hencky", hencky), ("neo_hookean", neo_hookean)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_ramp_then_hold_is_exact_for_any_steps(steps, spring, stress, dtype):
    time = steps()
    found = difference_of_stress(Viscoelastic(elastic=False, spring=spring), branch(), time, dtype)
    # round-off of a few hundred steps, those of float32 from entries of F of order one
    accuracy = 1e-11 if dtype == torch.float64 else 2e-5
    np.testing.assert_allclose(found, stress(strain(time)), rtol=0, atol=accuracy * MU)


@pytest.mark.parametrize("steps", STEPS)
def test_every_branch_beside_others_is_exact_for_any_steps(steps):
    """Three branches of their own relaxation times, alone and beside a solid."""
    time = steps()
    rates = (40.0, K_D, 0.2)
    values = branch("", rates[0]) | branch("_2", rates[1]) | branch("_3", rates[2])
    expected = sum(hencky(strain(time, k)) for k in rates)
    found = difference_of_stress(Viscoelastic(elastic=False, branches=3), values, time)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * MU)
    solid = dict(youngs_modulus=3.0, poissons_ratio=0.4)
    found = difference_of_stress(WithBranches(solid=NeoHookean(), branches=3), solid | values, time)
    F = stretched(time).numpy()
    elastic = 3.0 / 2.8 * (F[:, 0, 0] ** 2 - F[:, 1, 1] ** 2)
    np.testing.assert_allclose(found - elastic, expected, rtol=0, atol=1e-10 * MU)


def test_the_parts_of_a_mixture_are_exact_for_any_steps():
    time = fine_then_coarse()
    material = Mixture(materials={"stem": Viscoelastic(elastic=False), "leaf": NeoHookean()})
    values = tensors({f"stem.{name}": value for name, value in branch().items()})
    values |= tensors({"leaf.youngs_modulus": 3.0, "leaf.poissons_ratio": 0.4})
    c = material.coefficients(material.per_part(values, torch.tensor([0, 1, 0]), ("stem", "leaf")))
    F = stretched(time)
    H, memory = torch.zeros(3, 3, 3, dtype=torch.float64), material.initial_memory(3, torch.float64)
    for before, after, dt in zip(F[:-1], F[1:], np.diff(time)):
        L = (torch.linalg.solve(before, after - before, left=False) / dt).repeat(3, 1, 1)
        H, tau, memory = advance(material, float(dt), L, H, c, memory)
    found = (tau[:, 0, 0] - tau[:, 1, 1]).numpy()
    np.testing.assert_allclose(found[[0, 2]], hencky(strain(time[-1:]))[0], rtol=0, atol=1e-11 * MU)


@pytest.mark.parametrize("material", [Viscoelastic(elastic=False), Viscoelastic(elastic=False, spring="neo_hookean")])
def test_stored_energy_and_stress_are_those_of_the_end_of_the_step(material):
    """Also where the strain is stored ahead: a step of no length repeats the stress, and the energy is that of z."""
    c = material.coefficients(tensors(branch()))
    for dt in (0.01, 1.0):
        H, memory = torch.zeros(1, 3, 3, dtype=torch.float64), material.initial_memory(1, torch.float64)
        M = torch.diag(torch.expm1(RATE * dt * torch.tensor([1.0, -0.5, -0.5], dtype=torch.float64)))[None]
        for _ in range(3):
            H, tau, memory = advance(material, dt, M / dt, H, c, memory)
        z = RATE / K_D * (1 - math.exp(-K_D * 3 * dt))
        shear = 1.5 * z**2 if material.spring == "hencky" else (math.exp(2 * z) + 2 * math.exp(-z) - 3) / 2
        assert float(material.energy(c, H, memory)) == pytest.approx(MU * shear, rel=1e-10)
        _, again, _ = advance(material, 0.0, torch.zeros_like(H), H, c, memory)
        torch.testing.assert_close(again, tau, rtol=1e-12, atol=1e-12)


def uneven(n: int, end: float) -> np.ndarray:
    """n steps whose lengths alternate between one and fifteen parts."""
    lengths = np.where(np.arange(n) % 2, 15.0, 1.0)
    return np.concatenate([[0], np.cumsum(lengths)]) * end / lengths.sum()


def flow_along_the_stress(time: np.ndarray) -> np.ndarray:
    """d eps/dt = D - (k/2) dev(b~), axes fixed, by SciPy; tau_11 - tau_22."""

    def slope(t, z):
        rate = RATE if t < RAMP else 0.0
        return rate - K_D / 2 * (np.exp(2 * z) - np.exp(-z)) * 2 / 3

    options = dict(rtol=1e-11, atol=1e-13)
    first = scipy.integrate.solve_ivp(slope, (0, RAMP), [0.0], t_eval=time[time <= RAMP], **options)
    last = scipy.integrate.solve_ivp(slope, (RAMP, time[-1]), first.y[:, -1], t_eval=time[time > RAMP], **options)
    z = np.concatenate([first.y[0], last.y[0] if last.y.size else []])
    return neo_hookean(z)


def paste_in_tension(time: np.ndarray, n: float) -> np.ndarray:
    """Herschel-Bulkley along fixed axes, 2 mu dev eps = stress: dq/dt = sqrt(3) mu rate - mu ((q - tau_y)/k)^(1/n)."""

    def slope(t, q):
        rate = RATE if t < RAMP else 0.0
        return math.sqrt(3) * MU * rate - MU * (np.maximum(q - YIELD, 0) / CONSISTENCY) ** (1 / n)

    options = dict(rtol=1e-11, atol=1e-13, max_step=0.01)
    first = scipy.integrate.solve_ivp(slope, (0, RAMP), [0.0], t_eval=time[time <= RAMP], **options)
    last = scipy.integrate.solve_ivp(slope, (RAMP, time[-1]), first.y[:, -1], t_eval=time[time > RAMP], **options)
    return math.sqrt(3) * np.concatenate([first.y[0], last.y[0]])


YIELD, CONSISTENCY = 0.3, 0.5  # [Pa], [Pa s^n]


@pytest.mark.parametrize("law", ["stress", 1.0, 0.5, 1.5])
def test_other_flows_are_of_second_order_over_uneven_steps(law):
    """Along the stress of a neo-Hookean spring, and above a yield stress, against SciPy."""
    if law == "stress":
        material, values = Viscoelastic(elastic=False, spring="neo_hookean", flow="stress"), branch()
    else:
        material = HerschelBulkley()
        values = dict(youngs_modulus=2.6 * MU, poissons_ratio=0.3, yield_stress=YIELD, consistency=CONSISTENCY)
        values |= dict(flow_index=law)
    errors = []
    for n in (32, 64, 128, 256):
        # the corner is a row: a step across it is of first order
        time = np.concatenate([uneven(n, RAMP), RAMP + uneven(n, RAMP)[1:]])
        exact = flow_along_the_stress(time) if law == "stress" else paste_in_tension(time, law)
        errors.append(np.abs(difference_of_stress(material, values, time) - exact).max() / exact.max())
    assert errors[-1] < 1e-3
    # over all, for the step in which yielding begins errs by its length squared times a factor that is never the same
    assert math.log2(errors[0] / errors[-1]) / 3 > 1.9


@pytest.mark.parametrize("x", [1e-3, 0.3, 3.0, 100.0])
@pytest.mark.parametrize(
    "spring, flow", [("hencky", "log_strain"), ("neo_hookean", "log_strain"), ("neo_hookean", "stress")]
)
def test_slow_flow_has_its_viscosity_however_long_the_step(x, spring, flow):
    """Shear at a rate far below k: stress mu/k times the rate, with steps of x relaxation times."""
    rate, dt = 1e-7 * K_D, x / K_D
    count = max(3, math.ceil(30 / x)) if x > 0.01 else 30000
    material = Viscoelastic(elastic=False, spring=spring, flow=flow)
    c = material.coefficients(tensors(branch()))
    L = torch.zeros(1, 3, 3, dtype=torch.float64)
    L[0, 0, 1] = rate
    H, memory = torch.zeros_like(L), material.initial_memory(1, torch.float64)
    for _ in range(min(count, 400)):
        H, tau, memory = advance(material, dt, L, H, c, memory)
    age = min(count, 400) * x
    assert tau[0, 0, 1].item() == pytest.approx(MU * rate / K_D * -math.expm1(-age), rel=1e-6)
