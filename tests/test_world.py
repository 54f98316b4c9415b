"""A world that cannot be is refused in one line that names the field, its value and the remedy."""

import math
from pathlib import Path

import pytest
import torch
from mpm_bodies import soft_world

from physics3d.world import Estimate


@pytest.mark.parametrize(
    "changes, says",
    [
        (dict(density=0.0), "world.density is 0.0"),
        (dict(dx=-0.1), "world.dx is -0.1"),
        (dict(cfl=1.5), "world.cfl is 1.5"),
        (dict(damping=-1.0), "world.damping is -1.0"),
        (dict(dt=0.0), "world.dt is 0.0"),
        (dict(density=math.nan), "world.density is nan"),
        (dict(gravity=(0.0, math.nan, 0.0)), "world.gravity.1 is nan"),
        (dict(precision="half"), "world.precision is .half."),
        (dict(scheme="crank"), "world.scheme is .crank."),
        (dict(max_substeps=0), "world.max_substeps is 0"),
        (dict(lower=(0.0, 0.0, 0.0)), "world.lower"),
        (dict(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 0.0)), "world.lower"),
        (dict(start=dict(youngs_modulus=-1.0, poissons_ratio=0.3)), "youngs_modulus is -1"),
        (dict(start=dict(youngs_modulus=1e4, poissons_ratio=0.5)), "poissons_ratio is 0.5"),
        (dict(start=dict(youngs_modulus=1e4)), "poissons_ratio"),
    ],
    ids=lambda value: str(value),
)
def test_senseless_world_is_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        soft_world(**changes).estimate()


def test_estimate_is_the_start_and_survives_a_file(tmp_path: Path):
    estimate = soft_world().estimate()
    estimate.save(tmp_path)
    again = Estimate.load(tmp_path)
    assert {name: float(value) for name, value in again.parameters.items()} == soft_world().start
    assert torch.equal(again.velocity, torch.zeros(3))
