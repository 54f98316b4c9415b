"""Names of parameters that have changed are answered with the new one, wherever an old file may hold them."""

import pytest
import torch
from mpm_bodies import soft_world

from physics3d.learning.fields import GlobalField
from physics3d.materials.mixture import Mixture
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.world import Estimate

OLD = "shear_viscosity_time"
SAYS = r"shear_viscosity_time\w* is called (\w+\.)?shear_relaxation_time"


def aged(values: dict[str, float]) -> dict[str, float]:
    return {name.replace("relaxation_time", "viscosity_time"): value for name, value in values.items()}


@pytest.mark.parametrize(
    "material",
    [Viscoelastic(), Viscoelastic(branches=2), Mixture(materials={"stem": Viscoelastic(), "leaf": NeoHookean()})],
    ids=["one", "two", "parts"],
)
def test_a_world_with_an_old_name_is_told_the_new_one(material):
    with pytest.raises(ValueError, match=SAYS):
        soft_world(material=material, start=aged(material.example)).check()


def test_a_stored_estimate_with_an_old_name_is_told_the_new_one():
    parameters = {name: torch.tensor(value) for name, value in aged(Viscoelastic().example).items()}
    with pytest.raises(ValueError, match=SAYS):
        Estimate(parameters=parameters, velocity=torch.zeros(3)).check()


@pytest.mark.parametrize("learnt", [{"learn": (OLD,)}, {"learn": (), "ties": ((OLD, "bulk_viscosity_time"),)}])
def test_learning_an_old_name_is_told_the_new_one(learnt):
    start = {name: torch.tensor(value) for name, value in Viscoelastic().example.items()}
    with pytest.raises(ValueError, match=SAYS):
        GlobalField(start=start, **learnt)
