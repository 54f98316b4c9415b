"""Steps whose length changes from frame to frame, and from explicit to implicit: branches of a body that flies apart.

A body so heavy that its stress does nothing flies on almost as it starts, v = v_0 + A x. A branch then has principal
strains that obey eps' = d ln f/dt - k eps, f the stretches of the body, and SciPy has solved that; its energy
mu |dev eps|^2 + K/2 (tr eps)^2 shows what the branch remembers.
"""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
import torch
import warp as wp
from mpm_bodies import block, soft_world, tensors
from torch import Tensor

from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.adjoint import Adjoint
from physics3d.mpm.arrays import Arrays
from physics3d.mpm.hooks import hooks_of
from physics3d.mpm.implicit.step import ImplicitSubsteps
from physics3d.mpm.rollout import rollout
from physics3d.mpm.substep import Substeps
from physics3d.warp_start import start_warp

A = np.array([0.5, -0.3, 0.1])  # [1/s]
MU, K, K_D, K_V = 1e-4, 2e-4, 8.0, 3.0  # [Pa], [1/s]
FRAMES, FRAME_DT = 9, 0.05
BRANCH = dict(
    branch_shear_modulus=MU, branch_bulk_modulus=K, shear_relaxation_time=1 / K_D, bulk_relaxation_time=1 / K_V
)


def strain_of_the_branch(time: Tensor, deformation: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """(dev eps [t, p, 3], tr eps / 3 [t, p]) of stretches along the axes F [t, p, 3, 3]."""
    F, time = deformation.double().numpy(), time.numpy()
    stretches = np.diagonal(F, axis1=2, axis2=3)
    assert np.abs(F - stretches[..., None] * np.eye(3)).max() < 1e-3
    rate = scipy.interpolate.CubicSpline(time, np.log(stretches)).derivative()

    def slope(t, eps):
        eps = eps.reshape(-1, 3)
        mean = eps.mean(1, keepdims=True)
        return (rate(t) - K_D * (eps - mean) - K_V * mean).ravel()

    start = np.zeros(stretches[0].size)
    eps = scipy.integrate.solve_ivp(slope, (0, time[-1]), start, t_eval=time, rtol=1e-9, atol=1e-11).y
    eps = eps.T.reshape(len(time), -1, 3)
    mean = eps.mean(2)
    return eps - mean[..., None], mean


def energy_of_the_branch(deformation: Tensor) -> np.ndarray:
    """Mean over particles, per volume [J/m^3], frame by frame."""
    dev, mean = strain_of_the_branch(torch.arange(FRAMES) * FRAME_DT, deformation)
    return (MU * (dev**2).sum(2) + K / 2 * (3 * mean) ** 2).mean(1)


def flight(world, position, volume, velocity, part=None):
    values = tensors(world.start) | ({} if part is None else {"part": part})
    with torch.no_grad():
        return rollout(
            world, values, position, volume, velocity=velocity,
            frames=FRAMES, frame_dt=FRAME_DT, threads=1, log=Log(None),
        )  # fmt: skip


def spreading(position: Tensor) -> Tensor:
    return position * torch.tensor(A)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("scheme", ["explicit", "implicit"])
def test_a_branch_remembers_its_strain_over_changing_steps(scheme, precision):
    position, volume = block((2, 2, 2), 0.1)
    world = soft_world(
        material=Viscoelastic(elastic=False),
        start=BRANCH,
        scheme=scheme,
        precision=precision,
        gravity=(0.0, 0.0, -20.0),
    )
    velocity = spreading(position) + torch.tensor([0.0, 0.0, 2.0])  # thrown up: slow on top, fast below
    motion = flight(world, position, volume, velocity)
    assert len(set(motion.health["substeps"][1:])) > 2, "the steps do not change: nothing is tested"
    found = np.array(motion.health["elastic_energy"]) / float(volume.sum())
    # the rate of stretching changes within the longest step by A dt = 1 %
    np.testing.assert_allclose(found[1:], energy_of_the_branch(motion.deformation)[1:], rtol=5e-3)


def switching(k_d: float) -> tuple[Tensor, Tensor, Tensor, Callable[[], Tensor]]:
    """A body that flies apart in explicit steps of 1 ms, implicit ones of 1/30 s, and again: (times [s], F, tau) after
    every step, and a function that carries the adjoint of the last stress back to k_d [p]."""
    start_warp()
    position, volume = block((2, 2, 2), 0.1)
    n, cells = len(position), position / 0.1
    material = Viscoelastic(elastic=False)
    values = tensors(BRANCH | dict(shear_relaxation_time=1 / k_d))
    hooks = hooks_of((), (), wp.float64)
    arrays = Arrays(
        dx=0.1, origin=(0.0, 0.0, 0.0), gravity=(0.0, 0.0, 0.0), mass=1000 * volume, volume=volume, rest=position,
        cell=cells.floor().int(), offset=cells - cells.floor(),
        coefficients=material.coefficients(values).expand(-1, n).contiguous(), q=torch.zeros(0),
        selection=torch.zeros(0, 0), hooks=hooks, walls=None, memory_rows=material.memory_rows, longest_run=1,
        threads=1, fast=True,
    )  # fmt: skip
    arrays.set_window((-4, -4, -4), (11, 11, 11))
    first = arrays.state(0)
    first.v_gathered.copy_(spreading(position))
    first.L_gathered.copy_(torch.diag(torch.tensor(A)).expand(n, 3, 3))
    substeps = Substeps(arrays, hooks, material.advance(wp.float64))
    substeps.start(np.array([[0.0, 1.0]]), 0, 0)
    implicit = ImplicitSubsteps(substeps, bounded=False)
    lengths = [1e-3] * 20 + [1 / 30] * 3 + [1e-3] * 20 + [1 / 30] * 2
    velocities = []
    for i, dt in enumerate(lengths):
        clock = np.array([[dt, 1.0]])
        if dt < 0.01:
            assert substeps.run(clock, [i, i + 1]) == 0
            velocities.append(None)
        else:
            velocities.append(implicit.step(clock, i, i + 1).node_velocity)
    states = [arrays.state(i) for i in range(len(lengths) + 1)]

    def gradient() -> Tensor:
        adjoint = Adjoint(substeps)
        adjoint.clear()
        adjoint.states[0].tau.copy_(states[-1].tau / MU**2)
        side = 0
        for i in reversed(range(len(lengths))):
            clock = np.array([[lengths[i], 1.0]])
            if velocities[i] is None:
                side = adjoint.reverse(clock, [i, i + 1], side)
            else:
                side = implicit.reverse(adjoint, clock, i, i + 1, side, velocities[i])
        return adjoint.gradients(adjoint.states[side])[0][2]

    one = torch.eye(3, dtype=torch.float64)
    time = torch.tensor([0.0, *lengths], dtype=torch.float64).cumsum(0)
    return time, torch.stack([s.H + one for s in states]), torch.stack([s.tau for s in states]), gradient


def test_a_branch_remembers_its_strain_from_explicit_to_implicit_steps_and_back():
    time, F, tau, _ = switching(K_D)
    dev, mean = strain_of_the_branch(time, F)
    found, expected = np.diagonal(tau.numpy(), axis1=2, axis2=3), 2 * MU * dev + 3 * K * mean[..., None]
    # the rate of stretching changes within the longest step by A dt = 1.5 %; with the strain half a step ahead: 12 %
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0, atol=3e-3 * np.abs(expected).max())


def test_the_adjoint_goes_back_through_the_changes_of_the_step():
    """Of |tau|^2 at the end with respect to the rate of relaxation, against differences."""
    _, _, _, gradient = switching(K_D)
    ahead, behind = ((switching(K_D * (1 + h))[2][-1] / MU).square().sum() / 2 for h in (1e-5, -1e-5))
    slope = float(ahead - behind) / (2e-5 * K_D)
    assert float(gradient().sum()) == pytest.approx(slope, rel=1e-6)
