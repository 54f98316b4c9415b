"""The carnation twin: a potted carnation made by code, photographed from all sides and poked.

The flower stands in a terracotta pot on a wooden table. Everything above the soil moves, everything below it is fixed.
What deforms is one viscoelastic solid: stem, calyx and the dome that the petals fill; the visible petals, sepals
and leaves are thin sheets without mass, carried by it. The stem is kept thick so that cells of 1.2 cm resolve
its bending. The photographed shape is the rest shape, so there is no gravity.

The motion is that of finite elements by a library (`finite_elements.py`), kept in a file (`reference_motion.py`); where
a number of the twin is changed it is computed by the project's own grid, finer than the pipeline's. The pictures are
ray traced from meshes.
"""

from dataclasses import dataclass

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.checks import (
    Count,
    Device,
    Duration,
    Every,
    Frames,
    Length,
    Pixels,
    PoissonsRatio,
    Positive,
    Rate,
    Seed,
    require_fields,
)
from physics3d.gaussians.cameras import Camera
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.scenes import room
from physics3d.scenes.base import AbstractSource, Capture, Outline
from physics3d.scenes.flower import SOIL, blossom_centre, plant, surroundings
from physics3d.scenes.photographs import triple
from physics3d.scenes.reference_motion import Pokes, path_of
from physics3d.scenes.studio import Mesh, Studio
from physics3d.scenes.synthetic import captured, outlined, particles
from physics3d.world import World


@dataclass(frozen=True, kw_only=True)
class CarnationTwin(AbstractSource):
    # what is photographed
    views: Count = 40  # photographs, from all around
    width: Pixels = 320  # [px]
    height: Pixels = 240  # [px]
    held_out_every: Every = 8  # every so many photographs are kept for evaluation
    points: Count = 5000  # surface points, as from structure from motion
    # what moves, and how it is recorded
    frames: Frames = 30  # of each take, the rest state included
    fps: Rate = 30.0  # [1/s]
    learn_force: tuple[float, float, float] = (0.09, 0.02, 0.0)  # on the blossom in the take to learn from [N]
    evaluate_force: tuple[float, float, float] = (-0.05, 0.06, 0.02)  # in the take that is held out [N]
    push: Duration = 0.1  # duration of the push, from the first frame [s]
    # the truth
    youngs_modulus: Positive = 1.5e5  # of the elastic branch [Pa]
    poissons_ratio: PoissonsRatio = 0.3
    branch_shear_modulus: Positive = 3.0e4  # mu_N [Pa]
    branch_bulk_modulus: Positive = 6.5e4  # K_N, of the same Poisson ratio [Pa]
    shear_relaxation_time: Duration = 0.15  # 1/k_d [s]
    bulk_relaxation_time: Duration = 0.15  # 1/k_v [s]
    density: Positive = 300.0  # petals hold much air [kg/m^3]
    # how it moves: as once found (`reference_motion.py`), or by a grid finer than the pipeline's where nothing is kept
    motion: str = "carnation"  # file of it
    dx: Length = 0.010  # cell of the grid [m]
    seed: Seed = 0
    device: Device = "cpu"

    def files(self) -> tuple[str, ...]:
        return (str(path_of(self.motion)),)  # even if missing: the pipeline asks once

    @property
    def outline(self) -> Outline:
        return outlined("carnation", self.views, self.frames, self.fps)

    def __call__(self, *, log) -> Capture:
        require_fields(self, "source")
        meshes, solids = plant(self.seed)
        studio = Studio([*meshes, *surroundings(self.seed)], room.DAYLIGHT, openness_rays=24, seed=self.seed)
        return captured(
            name="carnation",
            motion=self.motion,
            world=self.world(),
            pokes=self.pokes(),
            matter=particles(solids, self.dx / 2, self.seed),
            solids=solids,
            studio=studio,
            cameras=photographers(self.views, self.width, self.height),
            witness=room.witness(self.width, self.height, target=TARGET, distance=DISTANCE, opening=OPENING),
            frames=self.frames,
            fps=self.fps,
            points=self.points,
            held_out_every=self.held_out_every,
            seed=self.seed,
            device=self.device,
            note=(
                "this is a synthetic twin: flower, photographs and motion are made by code, so its material is known; "
                "for a real capture set scene.source to a folder of photographs with cameras (see README)"
            ),
            log=log,
        )

    def solids(self) -> list[Mesh]:
        """What deforms, as closed meshes."""
        return plant(self.seed)[1]

    def pokes(self) -> Pokes:
        """The push of each take, by its role."""
        centre = blossom_centre()
        return {
            role: (Impulse(force=triple("force", force), centre=centre, radius=0.05, start=0.0, duration=self.push),)
            for role, force in (("learn", self.learn_force), ("evaluate", self.evaluate_force))
        }

    def world(self) -> World:
        """The physics that the reference motion obeys, with the true parameters as start."""
        material = Viscoelastic()
        return World(
            material=material,
            density=self.density,
            start={name: getattr(self, name) for name in material.parameters},
            dx=self.dx,
            gravity=(0.0, 0.0, 0.0),
            boundaries=(FixedRegion(lower=(-0.1, -0.1, -0.1), upper=(0.1, 0.1, SOIL)),),
        )


TARGET = (0.012, 0.0, 0.137)  # what cameras look at [m]
DISTANCE = 0.5  # of all cameras from there [m]
OPENING = 44.0  # of the lens, across [deg]


def photographers(views: int, width: int, height: int) -> list[Camera]:
    """Cameras on three rings around the front of the flower."""
    return room.photographers(views, width, height, target=TARGET, distance=DISTANCE, opening=OPENING)
