"""Whole histories in one launch against the plain twin, closed forms and finite differences."""

import cProfile
import pstats

import pytest
import torch

from physics3d.materials import driver, histories
from physics3d.materials.histories import NOMINAL, SHEAR, SHEAR_STRESS, STRETCH, TRUE, Schedule, sensitivities
from physics3d.materials.mooney_rivlin import MooneyRivlin
from physics3d.materials.viscoelastic import Viscoelastic

VISCO, RUBBER = Viscoelastic(), MooneyRivlin()
# steps that grow, and two that stop: what exactness over steps of any length is for
TIME = torch.tensor([0.0, 0.01, 0.05, 0.06, 0.3, 0.31, 0.9, 3.0], dtype=torch.float64)
STRAIN = torch.tensor([0.0, 0.02, 0.1, 0.3, 0.4, 0.4, 0.2, -0.1], dtype=torch.float64)


def coefficients(material, s=1):
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in material.example.items()}
    return values, material.coefficients(values).expand(-1, s).contiguous()


def schedule(prescribes, given, rows=None):
    dt = torch.cat([torch.ones(1), TIME.diff()]).double()[:, None].expand(-1, given.shape[1]).contiguous()
    rows = torch.full((given.shape[1],), len(given)) if rows is None else torch.tensor(rows)
    return Schedule(prescribes=torch.tensor(prescribes), rows=rows, dt=dt[: len(given)], given=given.contiguous())


@pytest.fixture(scope="module", params=[VISCO, RUBBER], ids=str)
def run(request):
    """Tension, its nominal and its true stress prescribed, shear and its stress, side by side."""
    material = request.param
    _, c = coefficients(material, 2)
    told = schedule([STRETCH, SHEAR], torch.stack([1 + STRAIN, STRAIN], 1))
    first = histories.histories(material, c, told)
    given = [1 + STRAIN, first.nominal[:, 0], first.true[:, 0], STRAIN, first.tau[:, 1, 0, 1]]
    plan = schedule([STRETCH, NOMINAL, TRUE, SHEAR, SHEAR_STRESS], torch.stack(given, 1))
    columns = c[:, :1].expand(-1, 5).contiguous()
    return material, columns, plan, histories.histories(material, columns, plan)


def test_histories_are_those_of_the_driver(run):
    material, _, _, done = run
    values, c = coefficients(material)
    tau, lateral = driver.uniaxial(material, values, TIME, 1 + STRAIN)
    sheared = driver.simple_shear(material, values, TIME, STRAIN)
    stiffness = material.wave_modulus(c).item()
    # both leave 1e-12 of the stiffness on the sides at most; rounding of the logarithms as much again
    torch.testing.assert_close(done.tau[:, 0, 0, 0], tau, rtol=0, atol=1e-11 * stiffness)
    torch.testing.assert_close(done.side[:, 0], lateral, rtol=0, atol=1e-11)
    torch.testing.assert_close(done.tau[:, 3], sheared, rtol=0, atol=1e-11 * stiffness)
    assert not done.lost.any() and done.tau[:, :3, 1, 1].abs().max() < 2e-12 * stiffness


def test_a_prescribed_stress_is_borne_and_gives_back_the_deformation(run):
    """Over steps of any length: the stress of the driver's stretch returns that stretch."""
    _, _, plan, done = run
    for column in (1, 2):  # 1e-12 of the stiffness over the tangent
        torch.testing.assert_close(done.stretch[:, column], 1 + STRAIN, rtol=0, atol=1e-9)
    torch.testing.assert_close(done.shear[:, 4], STRAIN, rtol=0, atol=1e-9)
    scale = plan.given.abs().amax(0)
    borne = torch.stack([done.nominal[:, 1], done.true[:, 2], done.tau[:, 4, 0, 1]], 1)
    torch.testing.assert_close(borne / scale[[1, 2, 4]], plan.given[:, [1, 2, 4]] / scale[[1, 2, 4]], rtol=0, atol=1e-9)


def outputs(done):
    tau = done.tau[..., [0, 1, 0], [0, 1, 1]]
    return torch.cat([torch.stack([done.stretch, done.side, done.shear], -1), tau], -1)


def test_sensitivities_are_those_of_finite_differences(run):
    material, c, plan, done = run
    exact = sensitivities(material, c, plan, done)
    for i in range(len(c)):
        step = torch.zeros_like(c)
        step[i] = 1e-5 * c[i]
        ahead, behind = (outputs(histories.histories(material, c + sign * step, plan)) for sign in (1, -1))
        slope = (ahead - behind) / 2e-5
        size = outputs(done).abs().amax(0)
        size[:, :2] -= 1  # of strains
        size = torch.maximum(size, size.amax(-1, keepdim=True) * 1e-9)
        size[:, 3:] = size[:, 3:].amax(-1, keepdim=True)
        size[:, :3] = size[:, :3].abs().amax(-1, keepdim=True)
        # rounding of 1e-12 of a stiffness fifty times the stress, over 1e-5
        torch.testing.assert_close(exact[..., i] * c[i][:, None] / size, slope / size, rtol=1e-5, atol=2e-5)


def test_short_tests_beside_long_ones_are_those_alone():
    _, c = coefficients(VISCO, 2)
    plan = schedule([STRETCH, SHEAR_STRESS], torch.stack([1 + STRAIN, 1e4 * STRAIN], 1), rows=[4, 8])
    done = histories.histories(VISCO, c, plan)
    slope = sensitivities(VISCO, c, plan, done)
    alone = schedule([STRETCH], 1 + STRAIN[:4, None])
    one = histories.histories(VISCO, c[:, :1], alone)
    torch.testing.assert_close(done.tau[:4, 0], one.tau[:, 0], rtol=0, atol=0)
    single = sensitivities(VISCO, c[:, :1].contiguous(), alone, one)
    torch.testing.assert_close(slope[:4, 0], single[:, 0], rtol=1e-10, atol=1e-12)
    assert slope[4:, 0].abs().max() == 0 and torch.isfinite(slope).all()


def test_a_load_that_cannot_be_borne_is_said():
    """What would stretch it by more than a factor of eleven in one row is no test; the one beside it does not
    suffer."""
    _, c = coefficients(VISCO, 2)
    given = torch.linspace(0, -1, 8).double()[:, None] * torch.tensor([-1e9, 1e2])
    done = histories.histories(VISCO, c, schedule([NOMINAL, NOMINAL], given))
    assert done.lost.tolist() == [True, False]
    assert torch.isfinite(done.stretch).all()
    torch.testing.assert_close(done.nominal[:, 1], given[:, 1], rtol=0, atol=1e-6)  # 1e-12 of the stiffness


def test_cost_grows_with_the_rows_alone(monkeypatch):
    """Twice the rows, twice the single steps that are differentiated, and no more than twice the calls of Python."""
    counted, advance = [], histories.advance

    def counting(material, dt, L, H, c, memory):
        counted.append(len(H))
        return advance(material, dt, L, H, c, memory)

    monkeypatch.setattr(histories, "advance", counting)

    def work(rows: int) -> tuple[int, int]:
        counted.clear()
        dt = torch.full((rows, 1), 0.01, dtype=torch.float64)
        given = 1 + 0.2 * torch.linspace(0, 1, rows, dtype=torch.float64)[:, None]
        plan = Schedule(prescribes=torch.tensor([STRETCH]), rows=torch.tensor([rows]), dt=dt, given=given)
        _, c = coefficients(VISCO)
        with cProfile.Profile() as profile:
            sensitivities(VISCO, c, plan, histories.histories(VISCO, c, plan))
        return sum(counted), pstats.Stats(profile).total_calls

    work(3)
    (few, calls), (some, more), (many, most) = work(21), work(41), work(81)
    assert many - some == 2 * (some - few) and some - few == 20 * 11  # outputs of a step: 3 stresses, 8 of memory
    assert most - more <= 2.1 * max(more - calls, 100)
