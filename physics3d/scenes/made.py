"""A thing composed of shapes by its scene's file: a synthetic twin that is data, and can be read as such.

    moving     shapes that move: those that are full make the body, the others are ornaments that it carries
    still      what stands around it: a pot, a plate, a stand
    world      the truth: material, parameters, what holds the thing, and a grid finer than the pipeline's
    learn      what sets the thing going in the take to learn from, evaluate: in the one that is held out

It stands on a table before a wall. The motion is that of finite elements where one is kept (`reference_motion.py`),
else it is computed by the project's own grid, with other particles and cells than the pipeline takes; the pictures are
ray traced from meshes: learning has to see through both differences.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32

from physics3d.boundaries.base import AbstractBoundary
from physics3d.checks import (
    Count,
    Device,
    Every,
    Frames,
    Length,
    Name,
    Pixels,
    Positive,
    Rate,
    Seed,
    require_fields,
)
from physics3d.scenes.base import AbstractSource, Capture, Outline
from physics3d.scenes.reference_motion import Pokes, path_of
from physics3d.scenes.room import DAYLIGHT, RINGS, Rings, photographers, room, witness
from physics3d.scenes.shapes import AbstractShape, Place, Sheet
from physics3d.scenes.studio import Mesh, Studio
from physics3d.scenes.synthetic import captured, outlined, particles, within
from physics3d.world import World


@dataclass(frozen=True, kw_only=True)
class MadeTwin(AbstractSource):
    name: Name
    moving: Mapping[str, AbstractShape]  # what sways, shape by shape, under names of one's own
    still: Mapping[str, AbstractShape] = field(default_factory=dict)  # what stands around it
    world: World  # the truth
    learn: tuple[AbstractBoundary, ...]  # what sets it going in the take to learn from
    evaluate: tuple[AbstractBoundary, ...]  # in the take that is held out
    # how it is photographed and filmed
    target: Place = (0.0, 0.0, 0.1)  # what cameras look at [m]
    distance: Length = 0.5  # of the cameras from there [m]
    opening: Positive = 44.0  # of the lens, across [deg]
    views: Count = 40
    rings: Rings = RINGS  # how high above the horizon the photographs are taken from [deg], and what share of them
    width: Pixels = 320  # [px]
    height: Pixels = 240
    held_out_every: Every = 8  # every so many photographs are kept for evaluation
    points: Count = 5000  # surface points, as from structure from motion
    frames: Frames = 30  # of each take, the rest state included
    fps: Rate = 30.0  # [1/s]
    seed: Seed = 0
    device: Device = "cpu"

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "source")
        for shape in (*self.moving.values(), *self.still.values()):
            shape.check()
        if not any(shape.full for shape in self.moving.values()):
            raise ValueError("source.moving has no shape that is full; nothing would move, make one of them full")
        if abs(sum(share for _, share in self.rings) - 1) > 1e-6:
            raise ValueError(f"source.rings is {self.rings}; take shares, the second numbers, that add up to 1")

    def files(self) -> tuple[str, ...]:
        return (str(path_of(self.name)),)  # even if missing: the pipeline asks once, and would not learn of a new one

    @property
    def outline(self) -> Outline:
        return outlined(self.name, self.views, self.frames, self.fps)

    def __call__(self, *, log) -> Capture:
        self.check()
        seen: Any = dict(target=self.target, distance=self.distance, opening=self.opening)
        return captured(
            name=self.name,
            world=self.world,
            pokes=self.pokes(),
            matter=self.matter(),
            solids=self.solids(),
            studio=Studio([*self.meshes(), *room()], DAYLIGHT, openness_rays=24, seed=self.seed),
            cameras=photographers(self.views, self.width, self.height, rings=self.rings, **seen),
            witness=witness(self.width, self.height, **seen),
            frames=self.frames,
            fps=self.fps,
            points=self.points,
            held_out_every=self.held_out_every,
            seed=self.seed,
            device=self.device,
            note="this is a synthetic twin: thing, photographs and motion are made by code, so its material is known",
            log=log,
        )

    def meshes(self) -> list[Mesh]:
        """All that is seen of the thing and of what stands around it, in the order of the scene's file."""
        named = [(shape, True) for shape in self.moving.values()] + [(shape, False) for shape in self.still.values()]
        return [m for i, (shape, moves) in enumerate(named) for m in shape.meshes(self.seed + i, moves=moves)]

    def pokes(self) -> Pokes:
        """The push of each take, by its role."""
        return {"learn": self.learn, "evaluate": self.evaluate}

    def solids(self) -> list[Mesh]:
        """What deforms, as closed meshes; sheets that are thinner than two particles are in as well."""
        return [m for shape in self.moving.values() if shape.full for m in shape.meshes(self.seed, moves=True)]

    def matter(self) -> tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, " p"]]:
        """Particles of the body, half a cell apart: position [m], volume [m^3]. What overlaps counts once."""
        spacing = self.world.dx / 2
        full = [shape for shape in self.moving.values() if shape.full]
        thin = [shape for shape in full if isinstance(shape, Sheet) and shape.thickness < 2 * spacing]
        solids = [m for shape in full if shape not in thin for m in shape.meshes(self.seed, moves=True)]
        layers = [shape.layer(spacing) for shape in thin]
        position, volume = particles(solids, spacing, self.seed) if solids else (np.zeros((0, 3)), np.zeros(0))
        for points, stands_for in layers:
            free = ~within(solids, points)
            position = np.concatenate([position, points[free]])
            volume = np.concatenate([volume, stands_for[free]])
        return position.astype(np.float32), volume.astype(np.float32)
