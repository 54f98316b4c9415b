"""Motion without a grid: large bending, energy, rigid motion, rest, and the bar in closed form."""

import math

import numpy as np
import pytest
import torch
from known_answers import DENSITY, K_D
from modes_bodies import CLAMP, row, section, world
from scipy.integrate import solve_bvp

from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.enforced_translation import EnforcedTranslation
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.modes.rollout import Solver, rollout


def elastica(load: float) -> np.ndarray:
    """Where the end of an inextensible cantilever of length one goes under a dead transverse force F L^2/(E I)."""
    right = lambda s, y: np.stack([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])
    ends = lambda a, b: np.array([a[0], b[1], a[2], a[3]])
    s = np.linspace(0, 1, 300)
    guess = np.stack([1.2 * s * min(1, load / 3), 0 * s, s, s / 2])
    return solve_bvp(right, ends, s, guess, tol=1e-8, max_nodes=100_000).y[2:, -1]


@pytest.mark.parametrize("load", [1.0, 10.0])
def test_a_cantilever_bends_like_the_elastica(load):
    """To 80 degrees at its end."""
    thick, count, young = 0.006, 20, 1e5
    position, volume = row(count, thick)
    length = (count - 0.5) * thick  # the force acts on the middle of the last particle
    force = load * young * section("square", thick, 0.3)[1] / length**2
    poke = Impulse(force=(0.0, 0.0, force), centre=tuple(position[-1].tolist()), nearest=1, duration=1.0)
    solver = Solver.of(world(young, 0.3), position, volume, excitation=(poke,), log=Log(None))
    end = position[-1] + solver.statics({k: torch.tensor(v) for k, v in solver.world.start.items()}, poke)[-1]
    exact = elastica(load)
    # slenderness 20: the elastica knows neither shear nor the spread of the force
    np.testing.assert_allclose(end[[0, 2]] / length, exact, atol=0.01 * np.linalg.norm(exact - [1, 0]))


def test_the_energy_of_an_elastic_body_stays():
    thick, count = 0.01, 8
    position, volume = row(count, thick)
    elastic = world(1e4, 0.3)
    solver = Solver.of(elastic, position, volume, log=Log(None))
    period = 2 * math.pi / solver.model.omega[0]
    dt = period / 64  # coarser steps gain energy at so large a swing
    solver = Solver.of(world(1e4, 0.3, dt=dt), position, volume, log=Log(None))
    bend = (position[:, :1] / position[-1, 0]) ** 2
    velocity = bend * torch.tensor([0.0, 0.0, 0.3 * float(position[-1, 0]) / period * 2 * math.pi]).double()
    with torch.no_grad():
        motion = solver.rollout(
            dict(youngs_modulus=1e4, poissons_ratio=0.3), velocity=velocity, frames=21, frame_dt=2.25 * period,
            log=Log(None),
        )  # fmt: skip
    swing = (motion.position[:, -1] - position[-1]).norm(dim=1).max() / position[-1, 0]
    assert swing > 0.1  # of its length: not linear
    energy = np.array(motion.health["energy"])
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
    """u = a(t) sin(pi X/2), rho a'' = -(pi/2)^2 (E a + E_N z), z' = a' - k z. Without Poisson's ratio the bar of
    `known_answers` needs no walls: the axial modulus of a branch, 4/3 mu_N + K_N, is 2 mu_N where K_N = 2/3 mu_N."""
    E_N = 0.5e4
    start = dict(
        youngs_modulus=1e4, poissons_ratio=0.0, branch_shear_modulus=E_N / 2, branch_bulk_modulus=E_N / 3,
        shear_relaxation_time=1 / K_D, bulk_relaxation_time=1 / K_D,
    )  # fmt: skip
    count, speed = 20, 1e-3
    position, volume = row(count, 0.05)
    shape = torch.sin(math.pi / 2 * position[:, 0])
    velocity = torch.zeros_like(position)
    velocity[:, 0] = speed * shape
    bar = world(1e4, 0.0, material=Viscoelastic(), start=start, density=DENSITY, boundaries=(CLAMP,), dt=0.01)
    parameters = {name: torch.tensor(value).double() for name, value in start.items()}
    with torch.no_grad():
        motion = rollout(bar, parameters, position, volume, velocity=velocity, frames=41, frame_dt=0.05, log=Log(None))
    t = torch.linspace(0, 2, 41, dtype=torch.float64)
    q2 = (math.pi / 2) ** 2 / DENSITY
    A = torch.tensor([[0, 1, 0], [-q2 * 1e4, 0, -q2 * E_N], [0, 1, -K_D]], dtype=torch.float64)
    curve = torch.linalg.matrix_exp(A * t[:, None, None])[:, 0, 1]
    found = (motion.position - motion.rest_position)[:, :, 0] / speed
    exact = curve[:, None] * shape
    # 1 %: (w dt)^2/12 = 2e-4 in the frequency, over two periods, and the centrifugal nothing of a thin bar
    assert float((found - exact).norm() / exact.norm()) < 0.01


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
