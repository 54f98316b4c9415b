"""The bodies of `benchmarks/learning.py` are drawn by a law of continuum mechanics that needs no solver to be true."""

import math

import numpy as np
import pytest
import torch
from learning_twins import scaled, stretched
from small_scene import DAMPED, POKE, bar, world

from physics3d.log import Log
from physics3d.solver import motion_of

TIMES_AS_STIFF = 7.3


def moved(stiffness: float, size: float) -> torch.Tensor:
    """Displacements [t, p, 3] over the size of a bar so many times as stiff and as large, seen at the same phases."""
    from dataclasses import replace

    _, body = bar()
    # lengths by size, times by size/sqrt(stiffness), so that forces go by stiffness size^2 whatever the density
    slower = size / math.sqrt(stiffness)
    start = scaled(DAMPED, stiffness=stiffness, branch=1.0, time=slower)
    larger = size * np.ones(3)
    one = lambda b: stretched(b, larger, force=stiffness * size**2, time=slower)
    there = replace(
        world(start), dx=size * world(start).dx, solver="modes", boundaries=tuple(map(one, world(start).boundaries))
    )
    place, volume = size * body.position, size**3 * body.volume
    motion = motion_of(there, place, volume, excitation=tuple(map(one, POKE)), device="cpu", log=Log(None))
    run = motion(there.estimate().parameters, frames=8, frame_dt=slower / 20, log=Log(None))
    return (run.position - place) / size


@pytest.mark.parametrize("stiffness, size", [(TIMES_AS_STIFF, 1.0), (TIMES_AS_STIFF, 1.2)])
def test_stiffness_and_size_are_a_change_of_units(stiffness, size):
    """What is s times as stiff and L times as large, pushed s L^2 times as hard for L/sqrt(s) of the time, moves alike
    at L/sqrt(s) times the instants: div P = rho a is the same equation in these units. By that the motion that finite
    elements found of one carnation is that of all that are drawn. 1e-3 of the motion: steps are solved to 1e-5 of the
    forces, positions are float32, and the bar swings for a third of a second."""
    reference, other = moved(1.0, 1.0), moved(stiffness, size)
    largest = float(reference.norm(dim=2).max())
    assert largest > 0.01
    assert float((other - reference).abs().max()) < 1e-3 * largest
