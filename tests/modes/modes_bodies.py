"""Bodies that tests and benchmarks of the solver without a grid move, and the closed forms they are compared with."""

import math

import numpy as np
import torch
from known_answers import DENSITY, K_D
from scipy.integrate import solve_bvp
from scipy.linalg import expm
from scipy.optimize import brentq
from torch import Tensor

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.cells import solid_cells
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.matter import Matter
from physics3d.modes.rollout import Solver, rollout
from physics3d.world import World

CLAMP = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.0, 1.0, 1.0))  # x < 0


def row(count: int, edge: float) -> tuple[Tensor, Tensor]:
    """(position, volume) of a beam along x, one cube of this edge [m] across."""
    x = (torch.arange(count, dtype=torch.float64) + 0.5) * edge
    return torch.stack([x, 0 * x, 0 * x], 1), torch.full((count,), edge**3, dtype=torch.float64)


def world(young: float, poisson: float, **changes) -> World:
    """A neo-Hookean body clamped at x < 0, without gravity."""
    usual = dict(
        material=NeoHookean(), density=300.0, start=dict(youngs_modulus=young, poissons_ratio=poisson), dx=0.012,
        gravity=(0.0, 0.0, 0.0), boundaries=(CLAMP,), precision="float64",
    )  # fmt: skip
    return World(**(usual | changes))


def turned_beam(
    length: float, thick: float, shape: str, degrees: float, spacing: float, shift: float
) -> tuple[Tensor, Tensor, Matter]:
    """A free beam, square or round, turned about y, as filling fills it from a closed surface; its lattice shifted."""
    a = math.radians(degrees)
    axes = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])

    def inside(x: np.ndarray) -> np.ndarray:
        y = x @ axes
        across = np.abs(y[:, 1:]).max(1) if shape == "square" else np.hypot(y[:, 1], y[:, 2])
        return (across <= thick / 2) & (np.abs(y[:, 0]) <= length / 2)

    ends = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (ends * [length / 2, thick / 2, thick / 2]) @ axes.T
    box = np.array([corners.min(0), corners.max(0) + shift * spacing])
    position, volume, matter = solid_cells(inside, box, spacing)
    return torch.from_numpy(position), torch.from_numpy(volume), matter


def timoshenko(
    length: float, area: float, inertia: float, young: float, poisson: float, density: float, shear: float, free: bool
) -> list[float]:
    """The first two frequencies of bending [Hz] of a beam clamped at one end, or free; `shear` is the coefficient
    of the section. The determinant of the transfer matrix of (w, phi, M, Q) vanishes where both ends
    have what they must."""
    G = young / (2 * (1 + poisson))
    scale = np.array([1, 1 / length, young * inertia / length**2, young * inertia / length**3])

    def end(omega: float) -> float:
        A = np.zeros((4, 4))
        A[0, 1], A[0, 3] = 1, 1 / (shear * G * area)
        A[1, 2] = 1 / (young * inertia)
        A[2, 1], A[2, 3] = -density * inertia * omega**2, -1
        A[3, 0] = -density * area * omega**2
        T = expm(A * scale[None, :] / scale[:, None] * length)
        return float(np.linalg.det(T[2:, :2] if free else T[2:, 2:]))

    first = (22.37 if free else 3.516) / length**2 * math.sqrt(young * inertia / (density * area))
    omega = np.linspace(0.3 * first, 9 * first, 500)
    value = [end(w) for w in omega]
    roots = [brentq(end, a, b) for a, b, f, g in zip(omega, omega[1:], value, value[1:]) if f * g < 0]
    return [w / (2 * math.pi) for w in roots[:2]]


def section(shape: str, thick: float, poisson: float) -> tuple[float, float, float]:
    """(area [m^2], second moment [m^4], shear coefficient of Cowper (1966))."""
    if shape == "square":
        return thick**2, thick**4 / 12, 10 * (1 + poisson) / (12 + 11 * poisson)
    return math.pi / 4 * thick**2, math.pi / 64 * thick**4, 6 * (1 + poisson) / (7 + 6 * poisson)


def elastica(load: float) -> np.ndarray:
    """Where the end of an inextensible cantilever of length one goes under a dead transverse force F L^2/(E I)."""
    right = lambda s, y: np.stack([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])
    ends = lambda a, b: np.array([a[0], b[1], a[2], a[3]])
    s = np.linspace(0, 1, 300)
    guess = np.stack([1.2 * s * min(1, load / 3), 0 * s, s, s / 2])
    return solve_bvp(right, ends, s, guess, tol=1e-8, max_nodes=100_000).y[2:, -1]


def bent_cantilever(load: float) -> tuple[np.ndarray, np.ndarray]:
    """(where the end of a cantilever one particle across goes, the same of the elastica), in its length."""
    thick, count, young = 0.006, 20, 1e5
    position, volume = row(count, thick)
    length = (count - 0.5) * thick  # the force acts on the middle of the last particle
    force = load * young * section("square", thick, 0.3)[1] / length**2
    poke = Impulse(force=(0.0, 0.0, force), centre=tuple(position[-1].tolist()), nearest=1, duration=1.0)
    solver = Solver.of(world(young, 0.3), position, volume, excitation=(poke,), log=Log(None))
    end = position[-1] + solver.statics({k: torch.tensor(v) for k, v in solver.world.start.items()}, poke)[-1]
    return end[[0, 2]].numpy() / length, elastica(load)


def swings(periods: float, steps: int) -> tuple[np.ndarray, float]:
    """(energy at 20 times spread over the periods [J], the largest swing in its length) of an elastic beam that is let
    go with a speed."""
    count, parameters = 8, dict(youngs_modulus=1e4, poissons_ratio=0.3)
    position, volume = row(count, 0.01)
    period = 2 * math.pi / Solver.of(world(1e4, 0.3), position, volume, log=Log(None)).model.omega[0]
    solver = Solver.of(world(1e4, 0.3, dt=period / steps), position, volume, log=Log(None))
    speed = 0.3 * float(position[-1, 0]) * 2 * math.pi / period
    velocity = (position[:, :1] / position[-1, 0]) ** 2 * torch.tensor([0.0, 0.0, speed]).double()
    with torch.no_grad():  # frames meet other phases of the swing each time
        timing = dict(frames=21, frame_dt=period * periods / 20, log=Log(None))
        motion = solver.rollout(parameters, velocity=velocity, **timing)
    swing = (motion.position[:, -1] - position[-1]).norm(dim=1).max() / position[-1, 0]
    return np.array(motion.health["energy"]), float(swing)


def viscoelastic_bar(count: int = 20, precision: str = "float64") -> tuple[float, int]:
    """(relative error over two periods, steps) of so many pieces, by steps of a hundredth of a second, of

        u = a(t) sin(pi X/2),    rho a'' = -(pi/2)^2 (E a + E_N z),    z' = a' - k z

    Without Poisson's ratio the bar of `known_answers` needs no walls: the axial modulus of a branch, 4/3 mu_N + K_N, is
    2 mu_N where K_N = 2/3 mu_N."""
    E_N, speed = 0.5e4, 1e-3
    start = dict(
        youngs_modulus=1e4, poissons_ratio=0.0, branch_shear_modulus=E_N / 2, branch_bulk_modulus=E_N / 3,
        shear_relaxation_time=1 / K_D, bulk_relaxation_time=1 / K_D,
    )  # fmt: skip
    position, volume = row(count, 1 / count)
    shape = torch.sin(math.pi / 2 * position[:, 0])
    velocity = torch.zeros_like(position)
    velocity[:, 0] = speed * shape
    bar = world(1e4, 0.0, material=Viscoelastic(), start=start, density=DENSITY, dt=0.01, precision=precision)
    parameters = {name: torch.tensor(value).double() for name, value in start.items()}
    with torch.no_grad():
        motion = rollout(bar, parameters, position, volume, velocity=velocity, frames=41, frame_dt=0.05, log=Log(None))
    t = torch.linspace(0, 2, 41, dtype=torch.float64)
    q2 = (math.pi / 2) ** 2 / DENSITY
    A = torch.tensor([[0, 1, 0], [-q2 * 1e4, 0, -q2 * E_N], [0, 1, -K_D]], dtype=torch.float64)
    curve = torch.linalg.matrix_exp(A * t[:, None, None])[:, 0, 1]
    found = (motion.position - motion.rest_position)[:, :, 0] / speed
    exact = curve[:, None] * shape
    return float((found.double() - exact).norm() / exact.norm()), int(sum(motion.health["substeps"]))
