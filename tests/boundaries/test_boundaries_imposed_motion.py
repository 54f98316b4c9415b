"""A motion that is imposed on part of a body, by a table over time and an affine field."""

import dataclasses

import pytest
import torch
from differences import compare
from mpm_bodies import block, soft_world, tensors

from physics3d.boundaries.imposed_motion import ImposedMotion
from physics3d.log import Log
from physics3d.mpm.rollout import rollout

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
STRETCH = ((1.03, 0.0, 0.0), (0.0, 0.99, 0.0), (0.0, 0.0, 1.0))
SHEAR = ((1.0, 0.0, 0.04), (0.0, 1.0, 0.0), (0.0, 0.02, 1.0))
SHELL = ImposedMotion(
    lower=(-9.0, -9.0, -9.0), upper=(9.0, 9.0, 9.0), hole_lower=(0.1, 0.1, 0.1), hole_upper=(0.4, 0.4, 0.4),
    times=(0.0, 0.5, 3.0), displacement=((0.0, 0.0, 0.0), (0.02, 0.01, 0.0), (0.02, 0.01, 0.0)), centre=(0.1, 0.2, 0.3),
)  # fmt: skip


@pytest.mark.parametrize("per_cell", [1, 2], ids=["dx = one spacing", "dx = two spacings"])
@pytest.mark.parametrize("deformation", [STRETCH, SHEAR], ids=["stretch", "shear"])
def test_what_a_shell_encloses_takes_its_affine_field(deformation, per_cell):
    """The patch test: only the outermost cells are driven. What drives them is where the table says, to round-off."""
    position, volume = block((5, 5, 5), 0.1, per_cell)
    shell = dataclasses.replace(SHELL, deformation=(EYE, deformation, deformation))
    world = soft_world(boundaries=(shell,), damping=10.0)
    with torch.no_grad():
        motion = rollout(
            world, tensors(world.start), position, volume, frames=3, frame_dt=0.5, threads=1, log=Log(None)
        )
    A, c, d = (torch.tensor(v, dtype=torch.float64) for v in (deformation, shell.centre, (0.02, 0.01, 0.0)))
    inside = ((position > 0.1) & (position < 0.4)).all(1)
    target = c + d + (position - c) @ A.T
    torch.testing.assert_close(motion.position[-1, ~inside], target[~inside], atol=1e-12, rtol=0)
    strain = float((A - torch.eye(3)).abs().max())
    found = motion.deformation[-1, inside]
    # of the strain: the mean is the field's, particles sample it
    assert float((found.mean(0) - A).abs().max()) < 0.02 * strain
    assert float((found - A).abs().max()) < 0.15 * strain
    assert float((motion.position[-1] - target).abs().max()) < 0.03 * strain * 0.5


def test_gradient_of_the_tables_is_the_derivative():
    position, volume = block((3, 2, 2), 0.1)
    world = soft_world(dt=0.002)
    weight = torch.randn(2, *position.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(displacement, deformation):
        jaw = ImposedMotion(
            lower=(-1.0, -1.0, -1.0), upper=(0.1, 1.0, 1.0), times=(0.0, 0.015, 0.05),
            displacement=displacement, deformation=deformation,
        )  # fmt: skip
        motion = rollout(
            world, tensors(world.start), position, volume, excitation=(jaw,),
            frames=3, frame_dt=0.02, threads=1, log=Log(None),
        )  # fmt: skip
        return (weight * (motion.position - position)[1:]).sum()

    inputs = dict(
        displacement=torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.004, 0.0], [-0.01, 0.0, 0.01]]),
        deformation=torch.tensor([EYE, STRETCH, SHEAR]),
    )
    compare(loss, inputs, tolerance=1e-6)


def test_tables_that_make_no_sense_are_refused():
    for change, field in (
        (dict(times=(0.0, 0.0, 1.0)), "times"),
        (dict(times=(0.0, 1.0)), "displacement"),
        (dict(deformation=(EYE, EYE)), "deformation"),
        (dict(deformation=(EYE, EYE, ((-1.0, 0.0, 0.0), *EYE[1:]))), "deformation"),
    ):
        with pytest.raises(ValueError, match=f"ImposedMotion.{field} is .*take"):
            dataclasses.replace(SHELL, **change).check()
