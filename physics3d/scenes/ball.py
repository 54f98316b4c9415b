"""The ball twin: a soft checkered ball that falls onto a floor; the smallest scene that exercises the whole pipeline.

Nothing but the ball is seen (white behind it), so there is nothing to segment. The floor is the plane z = 0. In the
take to learn from it falls straight down, in the held-out one it is also pushed sideways.
"""

from dataclasses import dataclass

import numpy as np

from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.checks import (
    Count,
    Device,
    Duration,
    Every,
    Frames,
    Length,
    NotNegative,
    Pixels,
    PoissonsRatio,
    Positive,
    Rate,
    Seed,
    require_fields,
)
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.scenes.base import AbstractSource, Capture, Outline
from physics3d.scenes.photographs import triple
from physics3d.scenes.studio import Light, Mesh, Studio, ring, surface_grid, to_linear
from physics3d.scenes.synthetic import captured, outlined, particles
from physics3d.world import World

RADIUS = 0.05  # [m]


@dataclass(frozen=True, kw_only=True)
class BallTwin(AbstractSource):
    # what is photographed
    views: Count = 16  # photographs, from all around
    width: Pixels = 96  # [px]
    height: Pixels = 96  # [px]
    held_out_every: Every = 8
    points: Count = 1000
    # what moves, and how it is recorded
    gap: NotNegative = 0.02  # between ball and floor at rest [m]
    frames: Frames = 12  # of each take, the rest state included
    fps: Rate = 48.0  # [1/s]
    evaluate_force: tuple[float, float, float] = (0.4, 0.0, 0.0)  # on the whole ball in the held-out take [N]
    push: Duration = 0.05  # duration of the push [s]
    # the truth
    youngs_modulus: Positive = 6.0e3  # of the elastic branch [Pa]
    poissons_ratio: PoissonsRatio = 0.3
    branch_shear_modulus: Positive = 1.2e3  # mu_N [Pa]
    branch_bulk_modulus: Positive = 2.0e3  # K_N [Pa]
    shear_relaxation_time: Duration = 0.05  # 1/k_d [s]
    bulk_relaxation_time: Duration = 0.05  # 1/k_v [s]
    density: Positive = 300.0  # [kg/m^3]
    gravity: float = 9.81  # downward [m/s^2]
    # how the reference motion is computed: finer than the pipeline
    dx: Length = 0.0125  # cell of the grid [m]
    seed: Seed = 0
    device: Device = "cpu"

    def files(self) -> tuple[str, ...]:
        return ()

    @property
    def outline(self) -> Outline:
        return outlined("ball", self.views, self.frames, self.fps, mattes=True)

    def __call__(self, *, log) -> Capture:
        require_fields(self, "source")
        centre = (0.0, 0.0, RADIUS + self.gap)
        mesh = checkered_ball(centre)
        light = Light(sun=(1.0, 0.96, 0.9), backdrop=(1.0, 1.0, 1.0))
        studio = Studio([mesh], light, openness_rays=4, seed=self.seed)
        per_ring = [self.views - 2 * (self.views // 3), self.views // 3, self.views // 3]
        cameras = []
        for elevation, count in zip((15.0, 50.0, -25.0), per_ring):
            azimuths = np.linspace(0, 360, count, endpoint=False) + elevation
            cameras += ring(
                (0.0, 0.0, RADIUS),
                distance=0.32,
                elevation=elevation,
                azimuths=azimuths,
                width=self.width,
                height=self.height,
                opening=36,
            )
        push = Impulse(
            force=triple("evaluate_force", self.evaluate_force),
            centre=centre,
            radius=1.2 * RADIUS,
            start=0.0,
            duration=self.push,
        )
        (witness,) = ring(
            (0.0, 0.0, RADIUS),
            distance=0.32,
            elevation=12,
            azimuths=np.array([-90.0]),
            width=self.width,
            height=self.height,
            opening=36,
        )
        return captured(
            name="ball",
            world=self.world(),
            pokes={"learn": (), "evaluate": (push,)},
            matter=particles([mesh], self.dx / 2, self.seed),
            studio=studio,
            cameras=cameras,
            witness=witness,
            frames=self.frames,
            fps=self.fps,
            points=self.points,
            noise=2e-4,
            held_out_every=self.held_out_every,
            seed=self.seed,
            device=self.device,
            single_object=True,
            note="this is a synthetic twin: ball, photographs and motion are made by code, so its material is known",
            log=log,
        )

    def world(self) -> World:
        """The physics that the reference motion obeys, with the true parameters as start."""
        material = Viscoelastic()
        return World(
            material=material,
            density=self.density,
            start={name: getattr(self, name) for name in material.parameters},
            dx=self.dx,
            gravity=(0.0, 0.0, -self.gravity),
            boundaries=(HalfSpace(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), kind="separate", friction=0.3),),
        )


def checkered_ball(centre: tuple[float, float, float]) -> Mesh:
    """A sphere with squares of two colours that change around it, so that no two sides look the same."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, 49), np.linspace(0, 2 * np.pi, 96, endpoint=False), indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    dark = (np.floor(polar / np.pi * 8 - 1e-9) + np.floor(around / (2 * np.pi) * 12 + 1e-9)) % 2 == 0
    turn = (0.5 + 0.5 * np.cos(around))[..., None]
    warm, cool = to_linear(np.array((0.85, 0.25, 0.15))), to_linear(np.array((0.15, 0.35, 0.75)))
    albedo = np.where(dark[..., None], turn * warm + (1 - turn) * cool, to_linear(np.array((0.85, 0.75, 0.50))))
    return surface_grid(np.asarray(centre) + RADIUS * unit, albedo, closed_b=True, moves=True)
