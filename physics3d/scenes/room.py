"""The room in which twins are photographed: a wooden table at z = 0, a plastered wall, cameras around its front.

Everything here stands still. Metres, z up.
"""

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from physics3d.checks import Share
from physics3d.gaussians.cameras import Camera
from physics3d.scenes.studio import Light, Mesh, ring, surface_grid, to_linear

Elevation = Annotated[float, Ge(-80), Le(80)]

DAYLIGHT = Light(backdrop=(0.80, 0.83, 0.86))
Rings = tuple[tuple[Elevation, Share], ...]  # of the cameras above the horizon [deg], share of the views
RINGS: Rings = ((14.0, 0.45), (32.0, 0.35), (58.0, 0.20))


def room() -> list[Mesh]:
    """Table, its edge and the wall."""
    x, y = np.meshgrid(np.linspace(-0.42, 0.42, 71), np.linspace(-0.36, 0.44, 67), indexing="ij")
    table = surface_grid(np.stack([x, y, 0 * x], -1), np.ones(3), paint=wood)
    edge = np.array([(-0.42, -0.36), (0.42, -0.36), (0.42, 0.44), (-0.42, 0.44)])
    rim = np.stack([np.column_stack([edge, np.full(4, h)]) for h in (0.0, -0.025)])
    apron = surface_grid(rim, np.full(3, 0.8), closed_b=True, paint=wood)
    angle, h = np.meshgrid(np.radians(np.linspace(18, 162, 60)), np.linspace(-0.06, 0.46, 24), indexing="ij")
    wall = surface_grid(
        np.stack([0.62 * np.cos(angle), 0.16 + 0.34 * np.sin(angle), h], -1),
        to_linear(np.array((0.70, 0.76, 0.80))),
        paint=plaster,
    )
    return [table, apron, wall]


def photographers(
    views: int,
    width: int,
    height: int,
    *,
    target: tuple[float, float, float],
    distance: float,
    opening: float,
    rings: Rings = RINGS,
) -> list[Camera]:
    """Cameras on `rings` at `distance` [m] around the front of `target`, never behind the wall; `opening` [deg]."""
    counts = [round(views * share) for _, share in rings]
    counts[0] += views - sum(counts)
    cameras = []
    for i, ((elevation, _), count) in enumerate(zip(rings, counts)):
        azimuths = -90 + np.linspace(-112, 112, count) + 4 * (i - 1)
        cameras += ring(
            target,
            distance=distance,
            elevation=elevation,
            azimuths=azimuths,
            width=width,
            height=height,
            opening=opening,
        )
    return cameras


def witness(width: int, height: int, *, target: tuple[float, float, float], distance: float, opening: float) -> Camera:
    """The camera that films: from the front, at the height of the lowest ring."""
    (camera,) = ring(
        target,
        distance=distance,
        elevation=14,
        azimuths=np.array([-84.0]),
        width=width,
        height=height,
        opening=opening,
    )
    return camera


def wood(point: np.ndarray) -> np.ndarray:
    """Planks 9 cm wide along x: rings of a slightly tilted trunk, joints dark. [n, 3] [m] -> linear albedo [n, 3]."""
    x, y = point[:, 0].astype(np.float64), point[:, 1].astype(np.float64)
    plank = np.floor(y / 0.09 + 0.5)
    across = y - 0.09 * plank
    shift = np.sin(plank * 12.9898) * 43.7585
    offset = 0.02 * (shift - np.floor(shift)) - 0.01
    ring_ = np.sqrt((across - offset) ** 2 + (0.03 + 0.06 * x + 0.004 * np.sin(9 * x + plank)) ** 2) * 520
    grain = 0.5 + 0.5 * np.sin(ring_ + 1.5 * np.sin(14 * x + 3 * plank))
    streak = 0.5 + 0.5 * np.sin(1500 * across + 6 * np.sin(31 * x + plank))
    light, dark = to_linear(np.array((0.72, 0.54, 0.37))), to_linear(np.array((0.58, 0.40, 0.26)))
    tone = (0.40 * grain + 0.20 * streak + 0.40 * (0.5 + 0.5 * np.sin(plank * 2.4)))[:, None]
    joint = 1 - 0.55 * np.exp(-(((np.abs(across) - 0.045) / 0.0012) ** 2))
    return ((dark + (light - dark) * tone) * joint[:, None]).astype(np.float32)


def plaster(point: np.ndarray) -> np.ndarray:
    """A painted wall, slightly uneven. [n, 3] [m] -> factor [n, 3]."""
    x, z = point[:, 0], point[:, 2]
    tone = (
        np.sin(23 * x + 4 * np.sin(17 * z))
        + np.sin(31 * z + 3 * np.sin(13 * x))
        + 0.6 * np.sin(90 * x) * np.sin(83 * z)
    )
    return (1 + 0.03 * tone)[:, None].astype(np.float32) * np.ones(3, np.float32)
