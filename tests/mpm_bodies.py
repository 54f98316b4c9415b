"""Small bodies, every material and every boundary, for the tests of the solver."""

import importlib
import inspect
import pkgutil

import torch

from physics3d import boundaries, materials
from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.bounding_box import BoundingBox
from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.enforced_translation import EnforcedTranslation
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.boundaries.impulse import Impulse
from physics3d.boundaries.mesh_collider import MeshCollider
from physics3d.boundaries.moving_cuboid import MovingCuboid
from physics3d.boundaries.sequential_release import SequentialRelease
from physics3d.log import Log
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.mixture import Mixture
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout
from physics3d.world import World


def block(cells: tuple[int, int, int], dx: float, per_cell: int = 2, lower=(0.0, 0.0, 0.0)):
    """(position [p, 3], volume [p]) of a block of whole cells, per_cell^3 particles in each, float64."""
    axes = [(torch.arange(c * per_cell, dtype=torch.float64) + 0.5) * dx / per_cell for c in cells]
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    volume = torch.full((len(position),), (dx / per_cell) ** 3, dtype=torch.float64)
    return position + torch.tensor(lower, dtype=torch.float64), volume


CUBE, CUBE_VOLUME = block((2, 2, 2), 0.1)


def soft_world(**changes) -> World:
    """A block of jelly in free space, in double precision."""
    values = dict(
        material=NeoHookean(),
        density=1000.0,
        start=dict(youngs_modulus=1e4, poissons_ratio=0.3),
        dx=0.1,
        gravity=(0.0, 0.0, 0.0),
        precision="float64",
    )
    return World(**(values | changes))


def small_rollout(
    world: World | None = None, position=CUBE, volume=CUBE_VOLUME, *, parameters=None, frames=3, frame_dt=0.02, **more
):
    """A few frames of a cube of two cells, or of what is given."""
    world = world or soft_world()
    parameters = parameters or tensors(world.start)
    return rollout(
        world, parameters, position, volume, frames=frames, frame_dt=frame_dt, threads=1, log=Log(None), **more
    )


def tensors(values: dict[str, float]) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


def found(package, kind: type) -> list[type]:
    """Concrete classes in the files of a package."""
    classes = []
    for module in pkgutil.iter_modules(package.__path__):
        for _, value in inspect.getmembers(
            importlib.import_module(f"{package.__name__}.{module.name}"), inspect.isclass
        ):
            if issubclass(value, kind) and not inspect.isabstract(value) and value not in classes:
                classes.append(value)
    return classes


def every_material() -> list[AbstractMaterial]:
    """One default instance of each class in the folder; a mixture is nothing by itself."""
    return [kind() for kind in found(materials, AbstractMaterial) if kind is not Mixture]


# for a block of 3 x 3 x 3 cells of 0.1 m with its corner at the origin
EXAMPLES: list[AbstractBoundary] = [
    BoundingBox(kind="slip", lower=(-0.5, 0.0, -0.5), upper=(0.8, 0.8, 0.8)),
    BoundingBox(kind="sticky", lower=(0.0, -0.5, -0.5), upper=(0.8, 0.8, 0.8)),
    BoundingBox(kind="separate", lower=(0.0, 0.0, -0.5), upper=(0.8, 0.8, 0.8)),
    HalfSpace(point=(0.0, 0.0, 0.05), normal=(0.1, 0.0, 1.0), kind="separate", friction=0.3),
    HalfSpace(point=(0.0, 0.0, 0.05), normal=(0.1, 0.0, 1.0), kind="slip"),
    HalfSpace(point=(0.0, 0.0, 0.05), normal=(0.1, 0.0, 1.0), kind="sticky"),
    FixedRegion(lower=(-0.1, -0.1, -0.1), upper=(0.1, 0.4, 0.4)),
    HeldParticles(position=((0.05, 0.05, 0.02), (0.05, 0.22, 0.02), (0.22, 0.1, 0.04))),
    Impulse(force=(30.0, 5.0, -4.0), centre=(0.2, 0.2, 0.2), radius=0.12, start=0.013, duration=0.03),
    MeshCollider(  # a corner of a cube that turns as it moves into the block
        vertices=((-0.1, -0.1, -0.1), (0.25, -0.1, -0.1), (-0.1, 0.25, -0.1), (-0.1, -0.1, 0.25)),
        triangles=((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
        rotation=(0.1, 0.0, 0.2),
        velocity=(0.5, 0.2, 0.3),
        angular_velocity=(0.0, 1.0, 2.0),
        start=0.013,
        duration=0.04,
        kind="separate",
        friction=0.3,
    ),
    MovingCuboid(lower=(-0.1, -0.1, -0.1), upper=(0.1, 0.4, 0.1), velocity=(0.5, 0.0, 0.5), start=0.01, duration=0.05),
    EnforcedTranslation(lower=(0.0, 0.0, 0.0), upper=(0.1, 0.3, 0.3), velocity=(-0.3, 0.2, 0.0), duration=0.05),
    EnforcedRotation(
        point=(0.15, 0.15, 0.05),
        axis=(0.0, 0.1, 1.0),
        radius=0.12,
        half_height=0.06,
        angular_velocity=5.0,
        start=0.01,
        duration=0.05,
    ),
    SequentialRelease(
        lower=(0.0, 0.0, 0.0), upper=(0.3, 0.3, 0.3), direction=(0.0, 0.0, 1.0), layers=3, start=0.01, interval=0.03
    ),
]


def every_boundary() -> list[AbstractBoundary]:
    """The examples; a boundary in the folder without one is an error."""
    without = set(found(boundaries, AbstractBoundary)) - {type(example) for example in EXAMPLES}
    assert not without, f"no example of {without}: add one to EXAMPLES in tests/mpm/mpm_bodies.py"
    return EXAMPLES
