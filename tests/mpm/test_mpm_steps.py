"""Steps whose length changes from frame to frame, and from explicit to implicit: branches of a body that flies apart.

A body so heavy that its stress does nothing flies on almost as it starts, v = v_0 + A x. A branch then has principal
strains that obey eps' = d ln f/dt - k eps, f the stretches of the body, and SciPy has solved that; its energy
mu |dev eps|^2 + K/2 (tr eps)^2 shows what the branch remembers.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
import torch
from mpm_bodies import block, soft_world, tensors

from physics3d.log import Log
from physics3d.materials.mixture import Mixture
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout

A = np.array([0.5, -0.3, 0.1])  # [1/s]
MU, K, K_D, K_V = 1e-4, 2e-4, 8.0, 3.0  # [Pa], [1/s]
FRAMES, FRAME_DT = 9, 0.05
BRANCH = dict(
    branch_shear_modulus=MU, branch_bulk_modulus=K, shear_relaxation_time=1 / K_D, bulk_relaxation_time=1 / K_V
)


def energy_of_the_branch(deformation: torch.Tensor) -> np.ndarray:
    """Mean over particles, per volume [J/m^3], frame by frame, of stretches along the axes [t, p, 3, 3]."""
    F = deformation.double().numpy()
    stretches = np.diagonal(F, axis1=2, axis2=3)
    assert np.abs(F - stretches[..., None] * np.eye(3)).max() < 1e-3
    time = np.arange(FRAMES) * FRAME_DT
    rate = scipy.interpolate.CubicSpline(time, np.log(stretches)).derivative()

    def slope(t, eps):
        eps = eps.reshape(-1, 3)
        mean = eps.mean(1, keepdims=True)
        return (rate(t) - K_D * (eps - mean) - K_V * mean).ravel()

    start = np.zeros(stretches[0].size)
    eps = scipy.integrate.solve_ivp(slope, (0, time[-1]), start, t_eval=time, rtol=1e-9, atol=1e-11).y
    eps = eps.T.reshape(FRAMES, -1, 3)
    mean = eps.mean(2)
    return (MU * ((eps - mean[..., None]) ** 2).sum(2) + K / 2 * (3 * mean) ** 2).mean(1)


def flight(world, position, volume, velocity, part=None):
    values = tensors(world.start) | ({} if part is None else {"part": part})
    with torch.no_grad():
        return rollout(
            world, values, position, volume, velocity=velocity,
            frames=FRAMES, frame_dt=FRAME_DT, threads=1, log=Log(None),
        )  # fmt: skip


def spreading(position: torch.Tensor) -> torch.Tensor:
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


def test_a_branch_remembers_its_strain_when_the_scheme_becomes_implicit():
    """Beside it flies a stiff body, too fast for long steps; on top of the flight a few implicit ones do instead."""
    position, volume = block((2, 2, 2), 0.1)
    n = len(position)
    position = torch.cat([position, position + torch.tensor([1.5, 0.0, 0.0])])
    material = Mixture(materials={"soft": Viscoelastic(elastic=False), "stiff": NeoHookean()})
    start = {f"soft.{name}": value for name, value in BRANCH.items()}
    start |= {"stiff.youngs_modulus": 6e9, "stiff.poissons_ratio": 0.0}
    world = soft_world(material=material, start=start, scheme="auto", gravity=(0.0, 0.0, -20.0))
    velocity = torch.cat([spreading(position[:n]), torch.zeros(n, 3)]) + torch.tensor([0.0, 0.0, 6.0])
    motion = flight(world, position, torch.cat([volume, volume]), velocity, torch.arange(2 * n) // n)
    steps = motion.health["substeps"][1:]
    assert max(steps) > 100 * min(steps), f"{steps}: the scheme does not change, nothing is tested"
    found = np.array(motion.health["elastic_energy"]) / float(volume.sum())
    np.testing.assert_allclose(found[1:], energy_of_the_branch(motion.deformation[:, :n])[1:], rtol=5e-3)
