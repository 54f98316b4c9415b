"""The bodies of `benchmarks/learning.py` are drawn by a law of continuum mechanics that needs no solver to be true."""

import math
from dataclasses import replace

import numpy as np
import torch
from learning_twins import Twin, scaled, stretched, told_wrongly
from small_scene import DAMPED, bar, capture, world

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.gaussians.render import render
from physics3d.log import Log
from physics3d.solver import motion_of

CLAMP = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.0, 1.0, 1.0))
POKE = Impulse(force=(0.0, 2.4e-3, 1.2e-3), centre=(0.055, 0.0, 0.0), radius=0.012, duration=0.1)


def moved(*, stiffness: float, size: float) -> torch.Tensor:
    """Displacements [t, p, 3], over its size, of a beam so many times as stiff and as large, at the same phases."""
    slower = size / math.sqrt(stiffness)
    larger = size * np.ones(3)
    x = size * (torch.arange(6) + 0.5) * 0.01
    place, volume = torch.stack([x, 0 * x, 0 * x], 1), torch.full((6,), (size * 0.01) ** 3)
    start = scaled(DAMPED, stiffness=stiffness, branch=1.0, time=slower)
    held = stretched(CLAMP, larger, force=1.0, time=1.0)
    there = replace(world(start, "float64"), dx=0.02 * size, solver="modes", boundaries=(held,))
    push = stretched(POKE, larger, force=stiffness * size**2, time=slower)
    motion = motion_of(there, place, volume, excitation=(push,), device="cpu", log=Log(None))
    run = motion(there.estimate().parameters, frames=8, frame_dt=slower / 20, log=Log(None))
    return (run.position - place) / size


def test_stiffness_and_size_are_a_change_of_units():
    """What is s times as stiff and L times as large, pushed s L^2 times as hard for L/sqrt(s) of the time, moves alike
    at L/sqrt(s) times the instants: div P = rho a is the same equation in these units. So the motion that finite
    elements found of one carnation is that of all that are drawn. To a two-hundredth of the motion: modes of equal
    frequency are found in another combination, and the points of integration are chosen by them."""
    reference = moved(stiffness=1.0, size=1.0)
    largest = float(reference.norm(dim=2).max())
    assert largest > 0.005
    for stiffness, size in ((7.3, 1.0), (0.2, 1.2)):
        assert float((moved(stiffness=stiffness, size=size) - reference).abs().max()) < 5e-3 * largest


def test_who_is_told_wrongly_sees_the_same_and_finds_another_material():
    """With lengths L times and forces k times the true ones the pictures are the same, and of k/L^2 times the
    stiffness and k/L^4 times the density the body moves alike: that is what intervals must allow for."""
    clip = replace(capture(DAMPED, frames=2), gaussians=bar()[0])
    there = replace(world(DAMPED, "float64"), dx=0.1, solver="modes")
    true = Twin(world=there, given=there, capture=clip, spacing=0.025, moved_by="")
    told = told_wrongly(true, cameras=1, seed=4)
    L = told.spacing / true.spacing
    pushes = [twin.capture.takes[0].excitation for twin in (true, told)]
    k = pushes[1][0].force[0] / pushes[0][0].force[0]
    assert abs(math.log(L)) > 0.01 and abs(math.log(k)) > 0.01
    pictures = [
        render(twin.capture.gaussians, twin.capture.takes[0].cameras[0], background=torch.zeros(3)).color
        for twin in (true, told)
    ]
    assert pictures[0].std() > 0.05
    assert float((pictures[1] - pictures[0]).abs().max()) < 1e-3  # single precision; a level of 8 bits is 4e-3
    position = bar()[1].position.double()
    swings = []
    for twin, push, size, stiffness, heavier in (
        (true, pushes[0], 1.0, 1.0, 1.0),
        (told, pushes[1], L, k / L**2, k / L**4),
    ):
        own = replace(
            twin.given, start=scaled(DAMPED, stiffness=stiffness, branch=1.0, time=1.0), density=300.0 * heavier
        )
        volume = torch.full((len(position),), (0.025 * size) ** 3)
        motion = motion_of(own, size * position, volume, excitation=push, device="cpu", log=Log(None))
        run = motion(own.estimate().parameters, frames=8, frame_dt=0.05, log=Log(None))
        swings.append((run.position / size - position).numpy())
    largest = np.abs(swings[0]).max()
    assert largest > 0.005
    assert np.abs(swings[1] - swings[0]).max() < 5e-3 * largest  # as above
