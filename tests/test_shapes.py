"""Shapes in annotations are held to while the tests run."""

import importlib

import pytest
import torch
from jaxtyping import TypeCheckError
from shape_hook import with_checked_shapes

from physics3d.mpm.velocity_gradient import velocity_gradient
from physics3d.trajectory import Trajectory


def test_a_wrong_shape_is_refused():
    x, mass = torch.rand(5, 3, dtype=torch.float64), torch.rand(5, dtype=torch.float64)
    assert velocity_gradient(x, x, mass).shape == (5, 3, 3)
    for wrong in ((x, x[:4], mass), (x, x[:, :2], mass), (x, x, mass[:, None]), (x, x, [1.0] * 5)):
        with pytest.raises(TypeCheckError):
            velocity_gradient(*wrong)


def test_a_wrong_shape_of_a_field_is_refused():
    fields = dict(
        position=torch.zeros(2, 5, 3), velocity=torch.zeros(2, 5, 3), deformation=torch.zeros(2, 5, 3, 3), fps=24,
        health={}, substeps=1,
    )  # fmt: skip
    Trajectory(rest_position=torch.zeros(5, 3), substep_dt=0.1, **fields)
    with pytest.raises(TypeCheckError):
        Trajectory(rest_position=torch.zeros(4, 3), substep_dt=0.1, **fields)


def test_the_check_can_be_left_out(unchecked):
    x = torch.rand(5, 3, dtype=torch.float64)
    with pytest.raises(RuntimeError):  # torch's own word on it
        velocity_gradient(x, x[:4], x[:, 0])


@pytest.mark.parametrize("name", ["physics3d.mpm.rollout", "physics3d.gaussians.rasterize", "physics3d.matter"])
def test_public_functions_are_checked(name: str):
    assert name in with_checked_shapes()
    assert any(type(x).__name__ == "_JaxtypingLoader" for x in [importlib.import_module(name).__spec__.loader])
