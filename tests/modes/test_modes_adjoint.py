"""Gradients of a whole trajectory against finite differences."""

import pytest
import torch
from modes_bodies import row

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.modes.rollout import Solver
from physics3d.world import World

START = dict(
    youngs_modulus=1e4, poissons_ratio=0.3, branch_shear_modulus=4e3, branch_bulk_modulus=8e3,
    shear_relaxation_time=0.1, bulk_relaxation_time=0.2,
)  # fmt: skip
WORLD = World(
    material=Viscoelastic(), density=300.0, start=START, dx=0.02, gravity=(0.0, 0.0, -9.81), damping=0.5, dt=0.01,
    boundaries=(FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.004, 1.0, 1.0)),), precision="float64",
)  # fmt: skip


def loss(theta: torch.Tensor, force: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
    """Random sums of positions and deformations of a body that bends by half its length and stretches by a quarter."""
    position, volume = row(8, 0.01)
    poke = Impulse(force=force, centre=(0.075, 0.0, 0.0), radius=0.02, start=0.02, duration=0.1)
    solver = Solver.of(WORLD, position, volume, excitation=(poke,), log=Log(None))
    velocity = speed * (position[:, :1] / position[-1, 0]) ** 2
    motion = solver.rollout(dict(zip(START, theta)), velocity=velocity, frames=4, frame_dt=0.05, log=Log(None))
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(motion.position.shape, generator=generator, dtype=torch.float64)
    b = torch.randn(motion.deformation.shape, generator=generator, dtype=torch.float64)
    return 100 * (motion.position * a).sum() + (motion.deformation * b).sum()


def test_gradients_are_those_of_finite_differences():
    values = [
        torch.tensor(list(START.values())).double(),
        torch.tensor([0.002, 0.004, 0.003]).double(),
        torch.tensor([0.02, 0.1, 0.2]).double(),
    ]
    for value in values:
        value.requires_grad_()
    loss(*values).backward()
    h = 2e-3
    for which, value in enumerate(values):
        direction = value.detach() * torch.linspace(1, -0.5, len(value)).double()

        def moved(step: float, which=which, direction=direction) -> float:
            with torch.no_grad():
                return float(loss(*(v + step * direction if i == which else v for i, v in enumerate(values))))

        difference = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
        # fourth order: h^4 = 2e-11; Newton stops at 1e-11 of the energy norm
        assert float(value.grad @ direction) == pytest.approx(difference, rel=1e-6)
