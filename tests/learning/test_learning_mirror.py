"""Laws of the other valley of a relaxation time; truths are complex moduli and sines written here."""

import math

import numpy as np
import pytest
import torch

from physics3d.learning.fields import GlobalField
from physics3d.learning.mirror import across, angular_frequency, time_by_modulus
from physics3d.trajectory import Trajectory

E, NU, OMEGA = 2e4, 0.3, 7.0
TIES = (("branch_shear_modulus", "branch_bulk_modulus"), ("shear_relaxation_time", "bulk_relaxation_time"))


def field_of(x: float, share: float = 0.4, **changes) -> GlobalField:
    """A spring E and a branch of a share of it, whose time is x/OMEGA."""
    mu = share * E / (2 * (1 + NU))
    start = dict(
        youngs_modulus=E, poissons_ratio=NU, branch_shear_modulus=mu, branch_bulk_modulus=2 * mu,
        shear_relaxation_time=x / OMEGA, bulk_relaxation_time=2 * x / OMEGA,
    )  # fmt: skip
    start = {name: torch.tensor(value, dtype=torch.float64) for name, value in start.items()}
    usual = dict(learn=("youngs_modulus",), ties=TIES, span=1e4)
    return GlobalField(start=start, **(usual | changes))


def answer(values: dict[str, torch.Tensor]) -> complex:
    """Complex Young's modulus at OMEGA, of a Maxwell branch beside a spring."""
    m, z = 2 * (1 + NU) * float(values["branch_shear_modulus"]), 1j * OMEGA * float(values["shear_relaxation_time"])
    return float(values["youngs_modulus"]) + m * z / (1 + z)


@pytest.mark.parametrize("x", [0.05, 0.4, 0.9, 1.2, 2.5, 30.0])
def test_the_other_valley_answers_a_swing_alike_from_the_other_side(x):
    field = field_of(x)
    places = across(field, field.zero(), OMEGA)
    assert places
    for there in places:
        values = field.parameters(there)
        time = float(values["shear_relaxation_time"])
        assert answer(values) == pytest.approx(answer(field.parameters(field.zero())), rel=1e-9)
        assert max(time * OMEGA / x, x / (time * OMEGA)) > 2  # elsewhere
        assert float(values["bulk_relaxation_time"]) == pytest.approx(2 * time)  # what is tied stays so
        assert float(values["branch_bulk_modulus"]) == pytest.approx(2 * float(values["branch_shear_modulus"]))
    at = sorted(OMEGA * float(field.parameters(there)["shear_relaxation_time"]) for there in places)
    if 1 / 1.6 < x < 1.6:  # both sides are one: to either
        assert at == pytest.approx([x / 3, 3 * x])
    elif 1 / 3 < x < 3:
        assert at == pytest.approx([1 / x])
    else:  # the sides are far apart: between them as well, where a branch damps most
        assert at == pytest.approx(sorted([1.0, 1 / x]))


def test_what_has_no_other_valley_is_left_alone():
    tied = dict(ties=(("youngs_modulus", "branch_shear_modulus", "branch_bulk_modulus"), TIES[1]))
    for changes in (tied, dict(ties=TIES[:1]), dict(learn=(), ties=TIES)):
        field = field_of(0.2, **changes)
        assert across(field, field.zero(), OMEGA) == []
    assert across(field_of(0.2), field_of(0.2).zero(), 0.0) == []  # nothing swings


def test_the_frequency_is_that_of_a_sine():
    t = torch.linspace(0, 3 * 2 * math.pi / OMEGA, 200, dtype=torch.float64)[:-1]
    way = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double()
    still = torch.randn(5, 3, generator=torch.Generator().manual_seed(1)).double()
    motion = Trajectory(
        rest_position=still, position=still + torch.sin(OMEGA * t)[:, None, None] * way,
        velocity=OMEGA * torch.cos(OMEGA * t)[:, None, None] * way,
        deformation=torch.eye(3).double().expand(len(t), 5, 3, 3), fps=30.0, health={}, substeps=1, substep_dt=1 / 30,
    )  # fmt: skip
    assert angular_frequency(motion) == pytest.approx(OMEGA, rel=1e-6)


@pytest.mark.parametrize("x", [0.1, 0.5, 2.0, 20.0])
def test_a_time_follows_its_modulus_along_what_is_damped(x):
    """m x/(1 + x^2) stays: by differences; where it hardly hangs on x, near 1, nobody follows it far."""
    exact = np.roots([1, -(1 + x**2) / x * 1.001, 1])  # of m x'/(1 + x'^2) = x/(1 + x^2) with m = 1.001
    near = exact[np.abs(exact - x).argmin()]
    assert time_by_modulus(x) == pytest.approx(max(-2, min(2, math.log(near / x) / math.log(1.001))), rel=5e-3)
    assert abs(time_by_modulus(0.99)) == abs(time_by_modulus(1.01)) == 2
