"""theta -> physical parameters."""

import math

import pytest
import torch

from physics3d.learning.fields import GlobalField

START = {"youngs_modulus": torch.tensor(2e4), "poissons_ratio": torch.tensor(0.3), "viscosity": torch.tensor(0.0)}
START |= {"branch_shear_modulus": torch.tensor([5e3, 6e3])}


def values(field, *theta):
    return field.parameters(torch.tensor(theta, dtype=torch.float64))


def test_zero_is_the_start():
    field = GlobalField(start=START, learn=("youngs_modulus", "poissons_ratio"))
    for name, value in field.parameters(field.zero()).items():
        torch.testing.assert_close(value, START[name].double(), rtol=1e-12, atol=1e-12)


def test_moduli_are_learned_as_logarithms():
    field = GlobalField(start=START, learn=("youngs_modulus",))
    assert float(values(field, math.log(3))["youngs_modulus"]) == pytest.approx(6e4, rel=1e-12)


@pytest.mark.parametrize("offset", [-20.0, -1.0, 0.5, 20.0])
def test_poissons_ratio_stays_possible_and_scales_the_bulk_to_shear_ratio(offset):
    field = GlobalField(start=START, learn=("poissons_ratio",))
    found = values(field, offset)
    nu, ratio = found["poissons_ratio"], lambda nu: 2 * (1 + nu) / (3 * (1 - 2 * nu))
    assert -1 < float(nu) < 0.5
    assert float(ratio(nu) / ratio(torch.tensor(0.3).double())) == pytest.approx(
        math.exp(offset), rel=1e-6
    )  # 1 - 2 nu cancels
    assert float(found["youngs_modulus"]) == 2e4


def test_tied_parameters_keep_their_ratio_also_per_particle():
    field = GlobalField(start=START, learn=("youngs_modulus",), ties=(("youngs_modulus", "branch_shear_modulus"),))
    assert field.names == ("youngs_modulus+branch_shear_modulus",)
    found = values(field, 0.7)
    torch.testing.assert_close(
        found["branch_shear_modulus"] / found["youngs_modulus"], torch.tensor([0.25, 0.3]).double()
    )


def test_bounds_hold_for_the_material_and_not_for_the_velocity():
    field = GlobalField(start=START, learn=("youngs_modulus",), span=10.0, velocity_scale=2.0)
    assert field.names == ("youngs_modulus", "velocity_x", "velocity_y", "velocity_z")
    theta = field.bound(torch.tensor([9.0, 9.0, 0.0, -9.0], dtype=torch.float64))
    assert float(field.parameters(theta)["youngs_modulus"]) == pytest.approx(2e5, rel=1e-9)
    assert field.velocity(theta).tolist() == [18.0, 0.0, -18.0]


@pytest.mark.parametrize(
    "options, word",
    [
        ({"learn": ("youngs_modulu",)}, "youngs_modulus, poissons_ratio"),
        ({"learn": ()}, "nothing to learn"),
        ({"learn": ("youngs_modulus",), "span": 1.0}, "learn.span"),
        ({"learn": ("viscosity",)}, "start it above 0"),
        ({"learn": ("youngs_modulus",), "ties": (("youngs_modulus", "poissons_ratio"),)}, "poissons_ratio"),
        ({"learn": (), "ties": (("youngs_modulus", "viscosity"), ("youngs_modulus",))}, "name each once"),
    ],
)
def test_bad_options_name_the_field(options, word):
    with pytest.raises(ValueError, match=word):
        GlobalField(start=START, **options)
