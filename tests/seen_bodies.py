"""A ball as cameras all around see it, and filling with what they see."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from analytic_bodies import discs, sphere

from physics3d.filling.fill import fill
from physics3d.filling.solids import AbstractSolid, Poisson
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.log import Log

RADIUS, SPACING = 0.05, 0.006  # [m]


def around(count: int = 24, distance: float = 0.4, width: int = 160) -> list[Camera]:
    """Cameras on a spiral over the sphere, all looking at the origin; a pixel is 1.6 mm there."""
    at = (np.arange(count) + 0.5) / count
    height, turn = 1 - 2 * at, np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    places = distance * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], 1)
    pose = [look_at(torch.from_numpy(p), torch.zeros(3)) for p in places]
    return [
        Camera(width=width, height=width, fx=250, fy=250, cx=width / 2, cy=width / 2, world_to_camera=m) for m in pose
    ]


def ball(rng, depth: float, flat: float) -> Gaussians:
    """Discs `flat` [m] thick and 3 mm wide, their centres evenly up to `depth` [m] below the surface of a ball.

    A fit ends with about as many, and as faint, as it takes to hide what is behind: an optical depth of two.
    """
    point, normal = sphere(6000, RADIUS, rng)
    made = discs(point - depth * rng.random((len(point), 1)) * normal, normal, rng, sigma=0.003, thickness=flat)
    return replace(made, opacity_logit=torch.full((len(point),), -1.5))


def radius_in_pictures(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Of a ball at the origin, from the area in which it hides more than half of what is behind [m]."""
    found = []
    for camera in cameras:
        alpha = render(gaussians, camera, background=(0.0, 0.0, 0.0)).alpha
        tangent = np.sqrt(float((alpha > 0.5).sum()) / np.pi) / camera.fx
        found.append(float(camera.centre.norm()) * np.sin(np.arctan(tangent)))
    return float(np.mean(found))


@dataclass(frozen=True, kw_only=True)
class Round(AbstractSolid):
    """An inside test that takes more than there is: a whole ball, whatever the samples say."""

    radius: float  # [m]

    def inside(self, surface, spacing):
        return lambda x: np.linalg.norm(x, axis=1) < self.radius


def filled(
    gaussians: Gaussians,
    cameras: list[Camera],
    label=None,
    solid: AbstractSolid = Poisson(),
    spacing: float = SPACING,
    thickness: float | None = None,
):
    return fill(
        gaussians,
        torch.ones(len(gaussians), dtype=torch.int32) if label is None else label,
        spacing=spacing,
        opacity=0.1,
        solid=solid,
        interior=True,
        sheet_thickness=thickness,
        isolated="keep",
        drop_pieces_below=0.0,
        attach=False,
        cameras=cameras,
        log=Log(None),
    )
