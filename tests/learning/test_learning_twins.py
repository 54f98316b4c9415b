"""The bodies of `benchmarks/learning.py` are drawn by a law of continuum mechanics that needs no solver to be true."""

import math
from dataclasses import replace

import numpy as np
import torch
from learning_twins import scaled, stretched
from small_scene import DAMPED, world

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
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
