"""The films that the small video model is trained on: closed forms against the solver."""

import math
from dataclasses import replace

import torch

from physics3d.log import Log
from physics3d.modes.rollout import Solver
from physics3d.scenes.stems import FPS, FRAMES, MODE, Look, Poke, Stem, Swaying, film, front

FORM = Stem(cubes=18, blossom=1.8, flat=0.9)


def test_a_film_of_any_size_and_stiffness_moves_as_the_solver_says():
    swaying = Swaying.of(FORM, log=Log(None))
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


def test_four_times_the_modulus_is_twice_the_frequency():
    """After the poke the motion is a free vibration, whose time only is scaled."""
    swaying = Swaying.of(FORM, log=Log(None))
    omega = float(swaying.omega[0])
    E = torch.tensor(MODE, dtype=torch.float64, requires_grad=True)
    position, _ = swaying.move(FORM, Poke(speed=0.1, azimuth=0.0), modulus=E)
    sway = position[:, -1, 0]
    assert 0.9 < omega / (2 * math.pi) < 2.5  # about one period in the film
    (slope,) = torch.autograd.grad(sway[-1], E)
    more, _ = swaying.move(replace(FORM, youngs_modulus=1.0001 * MODE), Poke(speed=0.1, azimuth=0.0))
    assert math.isclose(float(slope), float(more[-1, -1, 0] - sway[-1]) / (1e-4 * MODE), rel_tol=1e-3)


def test_the_first_frame_is_at_rest_and_the_blossom_moves():
    swaying = Swaying.of(FORM, log=Log(None))
    look = Look(blossom=(0.8, 0.1, 0.2), stem=(0.2, 0.5, 0.2), camera=front(10.0, 0.0))
    clip = film(FORM, look, *swaying.move(FORM, Poke(speed=0.3, azimuth=0.0)))
    still = film(FORM, look, *swaying.move(FORM, Poke(speed=0.0, azimuth=0.0)))
    assert torch.equal(clip[0], still[0])
    redness = clip[..., 0] - clip[..., 1]
    column = torch.arange(clip.shape[2]) + 0.5
    centre = (redness.clamp(min=0) * column).sum((1, 2)) / redness.clamp(min=0).sum((1, 2))
    # 0.3 m/s and some 9 rad/s are 30 mm, or three pixels of 10 mm
    assert 1.5 < float((centre - centre[0]).max()) < 5
