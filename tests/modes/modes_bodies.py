"""Bodies that the tests of the solver without a grid move, and the closed forms of beams they are compared with."""

import math

import numpy as np
import torch
from scipy.linalg import expm
from scipy.optimize import brentq
from torch import Tensor

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.filling.cells import solid_cells
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.matter import Matter
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
