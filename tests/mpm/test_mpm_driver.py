"""Known answers on the test machine without a grid (docs/method.md, section 5, 1 to 5; yield, friction, viscosity)."""

import itertools
import math

import pytest
import torch

from physics3d.mpm import driver
from physics3d.mpm.materials.drucker_prager import DruckerPrager
from physics3d.mpm.materials.neo_hookean import NeoHookean
from physics3d.mpm.materials.newtonian import Newtonian
from physics3d.mpm.materials.viscoelastic import Viscoelastic
from physics3d.mpm.materials.von_mises import VonMises

ONE = torch.eye(3, dtype=torch.float64)
BRANCH = Viscoelastic(elastic=False)


def numbers(**values):
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


def branch(mu, K, k_d, k_v):
    return numbers(
        branch_shear_modulus=mu, branch_bulk_modulus=K, shear_viscosity_time=1 / k_d, bulk_viscosity_time=1 / k_v
    )


def deviator(tau):
    return tau - tau.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * ONE


def test_step_strain_relaxes_exponentially_at_any_rotation():
    mu, K, k_d, k_v, dt = 3.0, 5.0, 0.8, 0.3, 0.25
    A = torch.tensor([[1.3, 0.4, 0.0], [-0.2, 0.8, 0.3], [0.1, 0.0, 1.1]], dtype=torch.float64)
    time = torch.arange(12, dtype=torch.float64) * dt
    W = torch.tensor([[0, 1.0, 0.3], [-1.0, 0, 0.2], [-0.3, -0.2, 0]], dtype=torch.float64)
    Q = torch.matrix_exp(W * (time[1:, None, None] - dt))
    F = torch.cat([ONE[None], Q @ A])
    tau = driver.prescribed(BRANCH, branch(mu, K, k_d, k_v), time, F)[1:]
    held = Q.mT @ tau @ Q
    age = (time[1:] - dt)[:, None, None]
    # exact for any rotation: only round-off
    torch.testing.assert_close(deviator(held), torch.exp(-k_d * age) * deviator(held[:1]), rtol=1e-12, atol=1e-12)
    trace = held.diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close(trace, torch.exp(-k_v * age[:, 0, 0]) * trace[0], rtol=1e-12, atol=1e-12)
    # and the first stress is that of the strain half relaxed over the step
    log_b = torch.linalg.eigvalsh(A @ A.T).log()
    torch.testing.assert_close(trace[0], 3 * K * math.exp(-k_v * dt / 2) * log_b.sum() / 2, rtol=1e-12, atol=0)


def ramp_error(n):
    mu, k_d, a, end = 2.0, 1.5, 0.4, 3.0
    time = torch.linspace(0, end, n + 1, dtype=torch.float64)
    F = torch.diag_embed(torch.exp(a * time[:, None] * torch.tensor([1.0, -0.5, -0.5])))
    tau = driver.prescribed(BRANCH, branch(mu, 5.0, k_d, 0.5), time, F)[-1]
    exact = 3 * mu * a / k_d * (1 - math.exp(-k_d * end))
    return abs((tau[0, 0] - tau[1, 1]).item() / exact - 1)


def test_isochoric_ramp_is_second_order():
    errors = [ramp_error(n) for n in (8, 16, 32, 64)]
    slopes = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert errors[-1] < 5e-4  # (dt k)^2/24 = 2e-4 in steady flow
    assert min(slopes) > 1.95


def shear_start_up(material, n, dtype=torch.float64):
    time = torch.linspace(0, 4, n + 1, dtype=torch.float64)
    tau = driver.simple_shear(material, branch(2.0, 1 + 4 / 3, 0.4, 0.2 * (1 + 4 / 3)), time, time.to(dtype))[-1]
    return torch.stack([tau[0, 1], tau[0, 0] - tau[1, 1]]).double()


def test_shear_start_up_has_the_known_stress():
    known = torch.tensor([1.58283, 4.67265], dtype=torch.float64)
    # 5 decimals are given; 128 steps: Strang errs by 2e-5 relative, backward Euler by 3e-3
    torch.testing.assert_close(shear_start_up(BRANCH, 512), known, rtol=0, atol=1e-5)
    torch.testing.assert_close(shear_start_up(BRANCH, 128), known, rtol=3e-5, atol=0)
    torch.testing.assert_close(shear_start_up(BRANCH, 128, torch.float32), known, rtol=1e-4, atol=0)


@pytest.mark.parametrize("spring", ["hencky", "neo_hookean"])
def test_shear_start_up_is_second_order(spring):
    material = Viscoelastic(elastic=False, spring=spring)
    fine = shear_start_up(material, 1024)
    errors = [(shear_start_up(material, n) - fine).norm().item() for n in (16, 32, 64)]
    assert errors[0] / errors[1] > 3.6  # 4 for second order, 2 for first
    assert errors[1] / errors[2] > 3.6


def test_neo_hookean_branch_follows_its_differential_equation():
    """d eps/dt = -(k_d/2) dev(b~) integrated by itself with 4000 explicit steps, strain held."""
    k_d, dt = 0.7, 0.05
    stretches = torch.tensor([2.0, 0.8, 1 / 1.6], dtype=torch.float64)
    time = torch.arange(41, dtype=torch.float64) * dt
    F = torch.cat([ONE[None], torch.diag(stretches).repeat(40, 1, 1)])
    tau = driver.prescribed(Viscoelastic(elastic=False, spring="neo_hookean"), branch(1.0, 1.0, k_d, 1.0), time, F)
    eps = stretches.log()
    h = (time[-1].item() - dt / 2) / 4000  # the table holds from the end of the first step, its stress half a step on
    for _ in range(4000):
        b = torch.exp(2 * eps)
        middle = torch.exp(2 * (eps - h / 2 * k_d / 2 * (b - b.mean())))
        eps = eps - h * k_d / 2 * (middle - middle.mean())
    b = torch.exp(2 * eps)
    # second order, dt k_d = 0.035
    torch.testing.assert_close(deviator(tau[-1]).diagonal(), b - b.mean(), rtol=2e-3, atol=1e-3)


def test_small_oscillation_has_the_zener_moduli():
    mu_E, mu, k_d, omega, amplitude = 1.5, 2.0, 0.8, 1.3, 1e-6
    values = branch(mu, 4.0, k_d, 0.4) | numbers(youngs_modulus=2 * mu_E * 1.3, poissons_ratio=0.3)
    per_period, periods = 200, 8
    time = torch.arange(per_period * periods + 1, dtype=torch.float64) * (2 * math.pi / omega / per_period)
    tau = driver.simple_shear(Viscoelastic(), values, time, amplitude * torch.sin(omega * time))[:, 0, 1]
    last, phase = tau[-per_period:], omega * time[-per_period:]
    storage = 2 * (last * torch.sin(phase)).mean() / amplitude
    loss = 2 * (last * torch.cos(phase)).mean() / amplitude
    # (dt omega)^2/12 = 8e-5 of the interpolation between rows; transients e^{-k_d 7 periods}
    assert storage.item() == pytest.approx(mu_E + mu * omega**2 / (omega**2 + k_d**2), rel=2e-4)
    assert loss.item() == pytest.approx(mu * omega * k_d / (omega**2 + k_d**2), rel=2e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_tension_frees_the_sides(dtype):
    """Neo-Hookean bar: tau_22 = mu (q^2 - 1) + lam ln J = 0 gives the lateral stretch q."""
    E, nu = 1e5, 0.45
    mu, lam = E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)
    stretch = torch.cat([torch.ones(1), torch.linspace(1, 1.8, 9)[1:], torch.linspace(1.8, 0.6, 12)[1:]]).to(dtype)
    time = torch.arange(len(stretch), dtype=torch.float64)
    tau, q = driver.uniaxial(NeoHookean(), numbers(youngs_modulus=E, poissons_ratio=nu), time, stretch)
    side = mu * (q**2 - 1) + lam * torch.log(stretch * q**2)
    accuracy = 2e-6 if dtype == torch.float32 else 1e-11
    assert side.abs().max() < accuracy * (lam + 2 * mu)
    expected = mu * (stretch**2 - 1) + lam * torch.log(stretch * q**2)
    torch.testing.assert_close(tau, expected, rtol=0, atol=2 * accuracy * (lam + 2 * mu))


def test_tension_is_differentiable_with_respect_to_the_material():
    """Including the lateral stretch, which solves an equation of its own: what fitting to laboratory curves needs."""
    time = torch.linspace(0, 1, 6, dtype=torch.float64)
    material = Viscoelastic()

    def last(E, mu, tau_d):
        values = branch(1.0, 3.0, 1.0, 1.0) | numbers(poissons_ratio=0.3)
        values |= {"youngs_modulus": E, "branch_shear_modulus": mu, "shear_viscosity_time": tau_d}
        stress, lateral = driver.uniaxial(material, values, time, 1 + 0.4 * time)
        return stress[-1] + lateral[-1]

    point = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (2.0, 1.0, 0.7)]
    assert torch.autograd.gradcheck(last, point, eps=1e-5, atol=1e-7, rtol=1e-6)


def test_metal_in_tension_hardens_along_the_given_line():
    """Beyond yield tau_11 = sigma_y + h alpha, and ln stretch = tau_11/E + alpha (Hencky elasticity)."""
    E, sigma_y, h = 1e6, 2e4, 1e5
    stretch = torch.linspace(1, 1.2, 21, dtype=torch.float64)
    values = numbers(youngs_modulus=E, poissons_ratio=0.3, yield_stress=sigma_y, hardening_modulus=h)
    tau, _ = driver.uniaxial(VonMises(), values, torch.arange(21, dtype=torch.float64), stretch)
    strain = stretch.log()
    expected = torch.minimum(E * strain, (sigma_y + h * strain) / (1 + h / E))
    # proportional loading: radial return is exact; the sides are free to 1e-12 of the stiffness
    torch.testing.assert_close(tau, expected, rtol=1e-9, atol=1e-4)


def test_sand_shears_at_its_friction_angle_and_bears_no_tension():
    phi = 0.6
    a = math.sqrt(2 / 3) * 2 * math.sin(phi) / (3 - math.sin(phi))
    values = numbers(youngs_modulus=1e6, poissons_ratio=0.3, friction_angle=phi)
    squeeze, shear = 0.99 * ONE, torch.linspace(0, 0.2, 20, dtype=torch.float64)
    F = torch.cat([ONE[None], squeeze.repeat(len(shear), 1, 1)])
    F[1:, 0, 1] = shear
    tau = driver.prescribed(DruckerPrager(), values, torch.arange(len(F), dtype=torch.float64), F)[-1]
    assert deviator(tau).norm().item() == pytest.approx(-a * tau.trace().item(), rel=1e-12)
    # pulled apart it is free, pushed back to its first volume it is free still, and pressed further it resists
    path = torch.stack([size * ONE for size in (1.0, 1.02, 1.05, 1.02, 1.0, 0.99)])
    tau = driver.prescribed(DruckerPrager(), values, torch.arange(6, dtype=torch.float64), path)
    pressure = -tau.diagonal(dim1=-2, dim2=-1).mean(-1)
    torch.testing.assert_close(pressure[:5], torch.zeros(5, dtype=torch.float64), rtol=0, atol=1e-6)
    assert pressure[5].item() == pytest.approx(-3 * math.log(0.99) * 1e6 / (3 * (1 - 0.6)), rel=1e-9)


@pytest.mark.parametrize("n", [1.0, 0.5])
def test_fluid_in_shear_has_its_viscosity(n):
    rate, k = 4.0, 3.0
    time = torch.linspace(0, 1, 11, dtype=torch.float64)
    values = numbers(bulk_modulus=1e5, viscosity=k, power_index=n)
    tau = driver.simple_shear(Newtonian(), values, time, rate * time)[-1]
    assert tau[0, 1].item() == pytest.approx(k * rate**n, rel=1e-6)  # (g_0/g)^2 of the regularisation
    assert tau.diagonal().abs().max() < 1e-6


def test_tables_that_cannot_be_right_are_refused():
    values = numbers(youngs_modulus=1.0, poissons_ratio=0.3)
    time, stretch = torch.linspace(0, 1, 4), torch.linspace(1, 2, 4)
    with pytest.raises(ValueError, match="increase"):
        driver.uniaxial(NeoHookean(), values, time.flip(0), stretch)
    with pytest.raises(ValueError, match="undeformed"):
        driver.uniaxial(NeoHookean(), values, time, stretch + 0.1)
    with pytest.raises(ValueError, match="rows"):
        driver.simple_shear(NeoHookean(), values, time[:3], stretch - 1)
