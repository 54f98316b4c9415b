"""The films that the small video model is trained on: closed forms against the solver."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from physics3d.log import Log
from physics3d.modes.rollout import Solver
from physics3d.scenes.stems import DRAG, FPS, FRAMES, MODE, PUSH, Look, Poke, Stem, Swaying, film, front, step_answer

FORM = Stem(cubes=18, blossom=1.8, flat=0.9)


@pytest.fixture(scope="module")
def swaying() -> Swaying:
    return Swaying.of(FORM, log=Log(None))


def test_a_film_of_any_size_and_stiffness_moves_as_the_solver_says(swaying):
    stem, poke = replace(FORM, size=1.15, youngs_modulus=2 * MODE), Poke(speed=0.03, azimuth=0.4)
    position, deformation = swaying.move(stem, poke)
    world = stem.world()
    start = {name: torch.tensor(value, dtype=torch.float64) for name, value in world.start.items()}
    solver = Solver.of(
        world, stem.cubes_at()[0], stem.volumes(), excitation=(poke.impulse(stem),), modes=6, points=80, log=Log(None)
    )
    moved = solver.rollout(start, frames=FRAMES, frame_dt=1 / FPS, log=Log(None))
    u, expected = position - position[0], moved.position.double() - position[0]
    # a weak poke: rotations of some degrees; time steps of a 24th of a period put frequencies off by half a per cent
    assert float((u - expected).norm() / expected.norm()) < 0.05
    H, expected = deformation - deformation[0], moved.deformation.double() - deformation[0]
    assert float((H - expected).norm() / expected.norm()) < 0.08


def test_an_oscillator_under_a_poke_is_that_of_numerical_integration():
    from scipy.integrate import solve_ivp

    omega, time = 9.0, np.arange(FRAMES) / FPS
    push = lambda t: 1.0 if t < PUSH else 0.0
    found = solve_ivp(
        lambda t, y: [y[1], push(t) - DRAG * y[1] - omega**2 * y[0]],
        (0, time[-1]), [0.0, 0.0], t_eval=time, max_step=1e-3, rtol=1e-9, atol=1e-12,
    )  # fmt: skip
    t = torch.from_numpy(time)[:, None]
    w = torch.tensor([omega], dtype=torch.float64)
    ours = step_answer(w, t) - step_answer(w, (t - PUSH).clamp(min=0))
    # the integration misses the end of the poke by up to a step of 1 ms, in 100 ms
    np.testing.assert_allclose(ours[:, 0].numpy(), found.y[0], atol=0.01 * np.abs(found.y[0]).max())


def test_the_derivative_after_the_modulus_is_that_of_differences(swaying):
    poke = Poke(speed=0.1, azimuth=0.0)
    assert 0.9 < float(swaying.omega[0]) / (2 * math.pi) < 2.5  # about half a period in the film [Hz]
    E = torch.tensor(MODE, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(swaying.move(FORM, poke, modulus=E)[0][-1, -1, 0], E)
    h = 1e-4 * MODE
    above, below = (swaying.move(replace(FORM, youngs_modulus=MODE + s * h), poke)[0][-1, -1, 0] for s in (1, -1))
    # second order in 1e-4
    assert math.isclose(float(slope), float(above - below) / (2 * h), rel_tol=1e-5)


def test_the_first_frame_is_at_rest_and_the_blossom_moves(swaying):
    look = Look(blossom=(0.8, 0.1, 0.2), stem=(0.2, 0.5, 0.2), camera=front(10.0, 0.0))
    clip = film(FORM, look, *swaying.move(FORM, Poke(speed=0.3, azimuth=0.0)))
    still = film(FORM, look, *swaying.move(FORM, Poke(speed=0.0, azimuth=0.0)))
    assert torch.equal(clip[0], still[0])
    redness = (clip[..., 0] - clip[..., 1]).clamp(min=0)
    column = torch.arange(clip.shape[2]) + 0.5
    centre = (redness * column).sum((1, 2)) / redness.sum((1, 2))
    # 0.3 m/s and some 9 rad/s are 30 mm, or three pixels of 10 mm
    assert 1.5 < float((centre - centre[0]).max()) < 5
