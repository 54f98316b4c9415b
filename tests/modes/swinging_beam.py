"""A cantilever that is let go with the speed of its first mode, and what it does in closed form.

    u(L, t) = v(L) z(t),    z'' = -omega^2 (z + r w),    w' = z' - w/tau

with a branch of r times the stiffness of the springs, and of the time tau; omega is that of Timoshenko's beam. The law
of the stability map: whatever the material and the step, the motion is this one, or it is said that it is not, or it is
refused.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from modes_bodies import row, section, timoshenko, world
from scipy.linalg import expm

from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.modes.rollout import Solver

COUNT, EDGE, DENSITY = 12, 0.01, 300.0
LENGTH = COUNT * EDGE
SWING = 0.01  # of the length: what is linear
PERIODS, MOST_STEPS, FEWEST_STEPS = 2, 400, 8
ACCURATE = 0.1
OUTCOMES = ("accurate", "stable, inaccurate", "refused", "FAILED")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A beam and how it is followed."""

    young: float  # [Pa]
    poisson: float = 0.3
    ratio: float = 0.0  # stiffness of a branch by that of the springs; 0: it has none
    time: float = 1.0  # of the branch [s]
    dt: float | None = None  # None: automatic [s]
    start: float | None = None  # Young's modulus that the basis was made for; None: the same [Pa]


class Heard(Log):
    """Keeps the warnings."""

    def __init__(self):
        super().__init__(None)
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def run(case: Case) -> dict:
    """outcome, error [1] (of the displacement of the end over the time looked at, of its root mean square), detail."""
    try:
        found, exact, heard = followed(case)
    except ValueError as reason:
        return dict(outcome="refused", error=math.nan, detail=str(reason))
    except Exception as reason:
        return dict(outcome="FAILED", error=math.nan, detail=f"{type(reason).__name__}: {reason}")
    if not np.isfinite(found).all():
        return dict(outcome="FAILED", error=math.nan, detail="NaN or infinity")
    error = float(np.sqrt(np.mean((found - exact) ** 2) / np.mean(exact**2)))
    largest = float(np.abs(found).max() / (SWING * LENGTH))
    if largest > 1.5:
        return dict(outcome="FAILED", error=error, detail=f"exploded: {largest:.3g} times the swing of the start")
    if error <= ACCURATE:
        return dict(outcome="accurate", error=error, detail="")
    if not heard:
        return dict(outcome="FAILED", error=error, detail="wrong, and not a word about it")
    return dict(outcome="stable, inaccurate", error=error, detail=heard[0])


def followed(case: Case) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """(displacement of the end at the frames [m], the exact one, warnings)."""
    log = Heard()
    position, _ = row(COUNT, EDGE)
    omega = angular(case.young, case.poisson)
    stuck = omega * math.sqrt(1 + case.ratio)
    period = 2 * math.pi / stuck
    if case.dt is None:
        frames, frame_dt = 9, period * PERIODS / 9  # a frame asks for several steps
    else:
        steps = min(max(round(PERIODS * period / case.dt), FEWEST_STEPS), MOST_STEPS)
        every = max(steps // 40, 1)
        frames, frame_dt = steps // every, every * case.dt
    one = setting(case)
    solver = _solver(one, case.dt)
    speed = SWING * LENGTH * stuck
    velocity = torch.zeros_like(position)
    velocity[:, 2] = speed * torch.from_numpy(shape(position[:, 0].numpy() / LENGTH))
    parameters = {name: torch.tensor(value, dtype=torch.float64) for name, value in materials(case).items()}
    with torch.no_grad():
        motion = solver.rollout(parameters, velocity=velocity, frames=1 + frames, frame_dt=frame_dt, log=log)
    t = frame_dt * np.arange(1, 1 + frames)
    found = (motion.position[1:, -1, 2] - motion.rest_position[-1, 2]).double().numpy()
    return found, float(velocity[-1, 2]) * closed_form(t, omega, case.ratio, case.time), log.warnings


def setting(case: Case) -> Case:
    """The case whose basis and world serve."""
    young = case.young if case.start is None else case.start
    return Case(young=young, poisson=case.poisson, ratio=case.ratio, time=case.time)


@cache
def _solver(case: Case, dt: float | None) -> Solver:
    position, volume = row(COUNT, EDGE)
    material = Viscoelastic() if case.ratio else NeoHookean()
    body = world(case.young, case.poisson, material=material, start=materials(case), density=DENSITY, dt=dt)
    return Solver.of(body, position, volume, log=Log(None))


def materials(case: Case) -> dict[str, float]:
    elastic = dict(youngs_modulus=case.young, poissons_ratio=case.poisson)
    if not case.ratio:
        return elastic
    mu = case.young / (2 * (1 + case.poisson))
    bulk = case.young / (3 * (1 - 2 * case.poisson))
    return elastic | dict(
        branch_shear_modulus=case.ratio * mu, branch_bulk_modulus=case.ratio * bulk,
        shear_relaxation_time=case.time, bulk_relaxation_time=case.time,
    )  # fmt: skip


@cache
def angular(young: float, poisson: float) -> float:
    """First frequency [1/s]."""
    area, inertia, shear = section("square", EDGE, poisson)
    known = timoshenko(LENGTH, area, inertia, 1.0, poisson, DENSITY, shear, free=False)[0]
    return 2 * math.pi * known * math.sqrt(young)


def shape(s: np.ndarray) -> np.ndarray:
    """First mode of a slender cantilever at s in its length, 1 at the end."""
    b = 1.875104
    k = (math.cosh(b) + math.cos(b)) / (math.sinh(b) + math.sin(b))
    return 0.5 * (np.cosh(b * s) - np.cos(b * s) - k * (np.sinh(b * s) - np.sin(b * s)))


def closed_form(t: np.ndarray, omega: float, ratio: float, time: float) -> np.ndarray:
    """z(t) [s] from z = w = 0, z' = 1."""
    A = np.array([[0, 1, 0], [-(omega**2), 0, -ratio * omega**2], [0, 1, -1 / time]])
    return np.array([expm(A * x)[0, 1] for x in t])
