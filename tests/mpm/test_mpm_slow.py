"""What an implicit step remembers of the last ones: slow modes, tangents, and the closed form of what grips."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from mpm_bodies import block, soft_world, tensors
from test_mpm_fused import substeps

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.implicit.constraints import Constraints
from physics3d.mpm.implicit.krylov import conjugate_gradients
from physics3d.mpm.implicit.slow import Course, SlowModes
from physics3d.mpm.implicit.step import ImplicitSubsteps
from physics3d.mpm.implicit.system import System
from physics3d.mpm.rollout import rollout

LOW = (0.001, 0.004, 0.02, 0.09)


@pytest.fixture
def matrix(rng) -> torch.Tensor:
    """Symmetric, 300 x 300: eigenvalues spread over 1 to 8, and four that are low."""
    Q = np.linalg.qr(rng.normal(size=(300, 300)))[0]
    return torch.from_numpy(Q * np.concatenate([LOW, np.linspace(1, 8, 296)]) @ Q.T)


def solved(matrix, rhs, slow: SlowModes) -> tuple[torch.Tensor, int]:
    course = Course()
    x, used, done = conjugate_gradients(
        lambda p: matrix @ p, rhs, precondition=lambda r: r + slow.correction(r),
        size=lambda r: float(r.norm()), target=1e-8 * float(rhs.norm()), course=course,
    )  # fmt: skip
    assert done
    slow.learn(course, used, 8.0)
    return x, used


def test_a_solve_finds_the_lowest_eigenvectors_and_the_next_one_is_as_short_as_without_them(matrix, rng):
    first, second = (torch.from_numpy(rng.normal(size=300)) for _ in range(2))
    slow = SlowModes()
    _, alone = solved(matrix, first, slow)
    values = slow.eigenvalues.sort().values
    # a solve to 1e-8 knows them to the square of that, the highest of the four to less
    torch.testing.assert_close(values[:4], torch.tensor(LOW, dtype=torch.float64), rtol=1e-3, atol=0)
    x, used = solved(matrix, second, slow)
    # eigenvalues from 1 to 8: (sqrt 8 - 1)/(sqrt 8 + 1) per product, 1e-8 in 25; four low ones cost the first more
    assert used <= 27 < alone
    torch.testing.assert_close(x, torch.linalg.solve(matrix, second), rtol=0, atol=1e-4 * float(x.abs().max()))


def test_what_no_longer_helps_is_forgotten(matrix, rng):
    slow = SlowModes()
    solved(matrix, torch.from_numpy(rng.normal(size=300)), slow)
    # another body: its slow motions are elsewhere, and what was slow is not
    Q = torch.from_numpy(np.linalg.qr(rng.normal(size=(300, 300)))[0])
    for _ in range(2):
        solved(Q @ matrix @ Q.T, torch.from_numpy(rng.normal(size=300)), slow)
    x, _ = solved(Q @ matrix @ Q.T, torch.from_numpy(rng.normal(size=300)), slow)
    assert bool(torch.isfinite(x).all())
    values = slow.eigenvalues.sort().values
    torch.testing.assert_close(values[:4], torch.tensor(LOW, dtype=torch.float64), rtol=1e-3, atol=0)


def test_slow_modes_stay_where_they_are_when_the_window_moves():
    slow = SlowModes()
    slow.follow(0.1, (0, 0, 0), (3, 4, 5))
    place = torch.arange(60.0).view(3, 4, 5, 1).expand(-1, -1, -1, 3)  # a number for each node
    slow.vectors, slow.eigenvalues = place.reshape(1, -1).clone(), torch.ones(1)
    slow.follow(0.1, (1, -1, 0), (4, 4, 3))
    moved = slow.vectors.view(4, 4, 3, 3)
    assert torch.equal(moved[:2, 1:, :], place[1:, :3, :3]) and not moved[2:].any() and not moved[:, 0].any()
    slow.follow(0.2, (1, -1, 0), (4, 4, 3))
    assert slow.vectors is None, "a step of another length has another matrix"


@pytest.mark.parametrize("floor", [False, True])
def test_the_projection_onto_what_grips_is_the_derivative_of_the_update(floor):
    """In closed form where nothing else acts; by the kernels where the body touches a floor."""
    body, clock = substeps(NeoHookean(), fast=True, moved=True, floor=floor)
    step = ImplicitSubsteps(body, bounded=True)
    step.launches.between(1, 2)
    system = System(step.launches, clock, 1, 2)
    v = system.update(gravity=True)
    system.forces(v)
    system.residual(v)
    constraints = Constraints(system, bounded=True)
    assert (constraints.groups is None) == floor
    x = torch.randn(v.shape, dtype=v.dtype, generator=torch.Generator().manual_seed(0))
    # the update is linear in the momenta but for the floor, which takes or leaves a node: nothing but rounding
    torch.testing.assert_close(constraints.derivative(x), constraints._difference(x), rtol=0, atol=1e-6)
    if not floor:
        once = constraints.derivative(x)
        torch.testing.assert_close(constraints.derivative(once), once, rtol=0, atol=1e-12)


def test_later_steps_take_half_the_products_of_the_first():
    """A clamped beam that swings, a hundred times the explicit limit; before anything was kept every step took as many
    products as the first."""
    position, volume = block((8, 3, 3), 0.1)
    world = soft_world(
        material=Viscoelastic(branches=0), start=dict(youngs_modulus=1e6, poissons_ratio=0.3), precision="float32",
        boundaries=(FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.05, 1.0, 1.0)),), scheme="implicit",
        gravity=(0.0, 0.0, -9.81),
    )  # fmt: skip
    modulus = float(world.material.wave_modulus(world.material.coefficients(tensors(world.start))).max())
    dt = 100 * world.dx / math.sqrt(3 * modulus / world.density)
    with torch.no_grad():
        motion = rollout(
            dataclasses.replace(world, dt=dt), tensors(world.start), position, volume, frames=9, frame_dt=dt,
            threads=1, log=Log(None),
        )  # fmt: skip
    first, *later = motion.health["stiffness_products"][1:]
    assert sum(later[3:]) / len(later[3:]) < first / 2, (first, later)
    assert set(motion.health["rejected"]) == {0.0}
