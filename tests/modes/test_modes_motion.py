"""Motion without a grid: large bending, energy, rigid motion, rest, and the bar in closed form."""

import math

import numpy as np
import pytest
import torch
from modes_bodies import bent_cantilever, row, swings, viscoelastic_bar, world

from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.enforced_translation import EnforcedTranslation
from physics3d.log import Log
from physics3d.modes.rollout import rollout


@pytest.mark.parametrize("load", [1.0, 10.0])
def test_a_cantilever_bends_like_the_elastica(load):
    """To 80 degrees at its end."""
    end, exact = bent_cantilever(load)
    # slenderness 20: the elastica knows neither shear nor the spread of the force
    np.testing.assert_allclose(end, exact, atol=0.01 * np.linalg.norm(exact - [1, 0]))


def test_the_energy_of_an_elastic_body_stays():
    energy, swing = swings(periods=45, steps=64)  # coarser steps gain energy at so large a swing
    assert swing > 0.1  # of its length: not linear
    # the midpoint rule keeps quadratic energies; the rest comes and goes with the phase
    np.testing.assert_allclose(energy[1:], energy[1:].mean(), rtol=0.01)


def test_a_free_body_flies_and_turns_rigidly():
    """Objectivity: a body thrown with a spin keeps its shape but for the centrifugal stretch, momentum exactly."""
    position, volume = row(6, 0.01)
    free = world(1e6, 0.3, boundaries=(), gravity=(0.0, 0.0, -9.81), dt=1e-3)
    middle, spin, throw = (
        position.mean(0),
        torch.tensor([0.0, 3.0, 2.0]).double(),
        torch.tensor([0.1, 0.0, 1.0]).double(),
    )
    velocity = throw + torch.linalg.cross(spin.expand_as(position), position - middle)
    with torch.no_grad():
        motion = rollout(
            free, dict(youngs_modulus=1e6, poissons_ratio=0.3), position, volume, velocity=velocity, frames=11,
            frame_dt=0.05, log=Log(None),
        )  # fmt: skip
    t = torch.arange(11).double()[:, None] * 0.05
    exact = middle + throw * t + 0.5 * torch.tensor([0.0, 0.0, -9.81]).double() * t**2
    # the midpoint rule is exact for parabolas
    torch.testing.assert_close(motion.position.mean(1), exact, atol=1e-7, rtol=0)
    gram = motion.deformation.mT @ motion.deformation
    # rho (w l)^2 / E = 3e-6; the rest is second order in dt
    torch.testing.assert_close(gram, torch.eye(3).double().expand_as(gram), atol=1e-4, rtol=0)
    turned = torch.linalg.det(motion.deformation)
    torch.testing.assert_close(turned, torch.ones_like(turned), atol=1e-4, rtol=0)
    assert float((motion.deformation[-1] - torch.eye(3)).norm(dim=(1, 2)).min()) > 1  # it did turn


def test_what_nothing_moves_rests():
    position, volume = row(6, 0.01)
    motion = rollout(
        world(1e4, 0.3), dict(youngs_modulus=1e4, poissons_ratio=0.3), position, volume, frames=5, frame_dt=0.1,
        log=Log(None),
    )  # fmt: skip
    assert torch.equal(motion.position, motion.rest_position.expand_as(motion.position))


def test_the_viscoelastic_bar_follows_its_modal_solution():
    # 1 %: (w dt)^2/12 = 2e-4 in the frequency, over two periods, and the centrifugal nothing of a thin bar
    error, _ = viscoelastic_bar()
    assert error < 0.01


def test_what_is_moved_goes_where_it_is_told():
    position, volume = row(12, 0.01)
    box = dict(lower=(0.1, -1.0, -1.0), upper=(1.0, 1.0, 1.0))
    pulled = EnforcedTranslation(**box, velocity=(0.05, 0.0, 0.02), duration=1.0)
    parameters = dict(youngs_modulus=1e4, poissons_ratio=0.3)
    with torch.no_grad():
        motion = rollout(
            world(1e4, 0.3, damping=5.0), parameters, position, volume, excitation=(pulled,), frames=6, frame_dt=0.1,
            log=Log(None),
        )  # fmt: skip
    exact = 0.5 * torch.tensor([0.05, 0.0, 0.02]).double()
    # springs a thousand times as stiff as the matter they hold
    torch.testing.assert_close((motion.position - position)[-1, -1], exact, atol=2e-3 * 0.027, rtol=0)
    turned = EnforcedRotation(
        point=(0.11, 0.0, 0.0), axis=(1.0, 0.0, 0.0), radius=0.02, half_height=0.011, angular_velocity=2.0, duration=1.0
    )
    with torch.no_grad():
        motion = rollout(
            world(1e4, 0.3, damping=5.0), parameters, position, volume, excitation=(turned,), frames=6, frame_dt=0.1,
            log=Log(None),
        )  # fmt: skip
    F = motion.deformation[-1, -1]
    angle = math.atan2(float(F[2, 1] - F[1, 2]), float(F[1, 1] + F[2, 2]))
    assert angle == pytest.approx(1.0, abs=0.03)
