"""What every scene that is composed of shapes has to be, so that learning from it means something.

The motion is looked at on a grid twice as coarse as the pipeline's, which is enough to say how far it goes.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.boundaries.moving_cuboid import MovingCuboid
from physics3d.log import Log
from physics3d.mpm.rollout import rollout
from physics3d.scenes.made import MadeTwin
from physics3d.scenes.room import room, witness
from physics3d.scenes.shapes import Sheet, Tube
from physics3d.segmentation.prompts import Prompt, within_any
from physics3d.world import World
from pipeline.settings import CONF, choices, compose
from pipeline.stage import build

TARGET = "physics3d.scenes.made.MadeTwin"
COARSE = 2.0  # cells of the grid that the motion is looked at on, in those of the pipeline
WIDTH = 320  # of the pictures of the default profile [px]


@dataclass(frozen=True)
class Scene:
    twin: MadeTwin
    world: World  # of the pipeline, with what learning starts from
    prompts: tuple[Prompt, ...]
    sheet_thickness: float


@cache
def scene(name: str) -> Scene:
    config, _ = compose([f"scene={name}"])
    return Scene(
        twin=build(config["capture"]["source"], "cpu"),
        world=build(config["simulate"]["world"], "cpu"),
        prompts=build(config["segment"]["prompts"], "cpu"),
        sheet_thickness=config["fill"]["sheet_thickness"],
    )


NAMES = [name for name in choices("scene") if TARGET in (CONF / "scene" / f"{name}.yaml").read_text()]


@pytest.fixture(params=NAMES)
def made(request) -> Scene:
    return scene(request.param)


def vertices(twin: MadeTwin, *, moving: bool) -> np.ndarray:
    meshes = [m for m in (*twin.meshes(), *room()) if m.moves == moving]
    return np.concatenate([m.vertices for m in meshes])


@cache
def matter(twin_name: str) -> tuple[np.ndarray, np.ndarray]:
    return scene(twin_name).twin.matter()


def shares(boundary, position: np.ndarray, volume: np.ndarray, world: World) -> np.ndarray:
    """How much of each particle a boundary selects."""
    from physics3d.boundaries.base import Setting

    x, v = torch.from_numpy(position).double(), torch.from_numpy(volume).double()
    setting = Setting(
        position=x,
        mass=v * world.density,
        volume=v,
        lower=tuple(position.min(0)),
        upper=tuple(position.max(0)),
        dx=world.dx,
    )
    return boundary.selection(setting).numpy()


def test_there_are_scenes():
    assert {"jelly", "alocasia", "hat", "cake"} <= set(NAMES)


def test_the_truth_is_in_the_range_of_the_material_and_learning_starts_off_it(made):
    made.twin.world.check()
    truth, start = made.twin.world.start, made.world.start
    assert set(truth) == set(start) == set(made.world.material.parameters)
    # a factor 1.5 or more, so that what is learned is not what was given
    assert abs(np.log(start["youngs_modulus"] / truth["youngs_modulus"])) > np.log(1.5)
    assert start["poissons_ratio"] == truth["poissons_ratio"]  # it is not learned
    assert made.twin.world.density == made.world.density and made.twin.world.gravity == made.world.gravity
    assert made.twin.world.boundaries == made.world.boundaries
    assert made.twin.world.dx < made.world.dx  # the recorded motion is the better resolved one


def test_something_is_held_and_something_is_free(made):
    position, volume = matter(made.twin.name)
    held = np.max(
        [shares(b, position, volume, made.world) for b in made.world.boundaries if isinstance(b, FixedRegion)], 0
    )
    share = (held * volume).sum() / volume.sum()
    assert 0.01 < share < 0.5, share


@pytest.mark.parametrize("role", ["learn", "evaluate"])
def test_the_poke_hits_what_is_free(made, role):
    position, volume = matter(made.twin.name)
    held = np.max(
        [shares(b, position, volume, made.world) for b in made.world.boundaries if isinstance(b, FixedRegion)], 0
    )
    for poke in getattr(made.twin, role):
        if isinstance(poke, Impulse):
            hit = shares(poke, position, volume, made.world)
            assert (hit * (1 - held) * volume).sum() > 0.8 * (hit * volume).sum() > 0
        else:
            assert isinstance(poke, MovingCuboid)
            travel = np.array(poke.velocity) * poke.duration
            before, after = (
                ((position > poke.lower + way) & (position < poke.upper + way)).all(1) for way in (0 * travel, travel)
            )
            assert not before.any() and after.any()  # it comes from outside


def test_thin_parts_are_as_thick_as_two_cells_or_sheets(made):
    for name, shape in made.twin.moving.items():
        if shape.full and isinstance(shape, Tube):
            assert 2 * min(shape.radii) >= 1.85 * made.world.dx, name
        if shape.full and isinstance(shape, Sheet):
            thin = shape.thickness < 0.5 * made.world.dx
            assert thin or shape.thickness >= 1.85 * made.world.dx, name
            if thin:  # the filling takes it for a sheet of the same thickness
                assert made.sheet_thickness == shape.thickness, name


def test_prompts_hold_what_moves_and_nothing_else(made):
    """The boxes in space say of nearly all vertices that nothing holds whether they move."""
    for moving in (True, False):
        point = vertices(made.twin, moving=moving)
        held = [((point >= b.lower) & (point <= b.upper)).all(1) for b in made.world.boundaries]
        inside = within_any(made.prompts, torch.from_numpy(point))[~np.any(held, 0)]
        assert inside.double().mean() > 0.97 if moving else inside.double().mean() < 0.01


def test_what_is_seen_to_move_is_near_what_moves_it(made):
    from scipy.spatial import cKDTree

    position, _ = matter(made.twin.name)
    tree = cKDTree(position)
    for mesh in made.twin.meshes():
        if mesh.moves:
            places = mesh.vertices if mesh.anchor is None else np.array([mesh.anchor])
            assert tree.query(places)[0].max() < 3 * made.world.dx


def coarse(made: Scene, position: np.ndarray, volume: np.ndarray, seconds: float) -> np.ndarray:
    """Positions [t, p, 3] over the first `seconds` of the take to learn from."""
    # the turns of a coil would touch on a coarser grid
    coiled = any(isinstance(shape, Tube) and shape.coil for shape in made.twin.moving.values())
    dx = made.world.dx * (1.0 if coiled else COARSE)
    # particles twice as far apart: a part of them stands for the volume of all
    spacing = dx / 2
    _, first, cell = np.unique((position // spacing).astype(int), axis=0, return_index=True, return_inverse=True)
    fewer, stands_for = position[first], np.bincount(cell.reshape(-1), volume).astype(np.float32)
    world = replace(made.twin.world, dx=dx)
    frames = 1 + round(15 * seconds)
    trajectory = rollout(
        world,
        world.estimate().parameters,
        torch.from_numpy(fewer),
        torch.from_numpy(stands_for),
        excitation=made.twin.learn,
        frames=frames,
        frame_dt=1 / 15,
        log=Log(None),
    )
    return trajectory.position.numpy()


def test_the_motion_is_seen_and_stays_in_the_room(made):
    position, volume = matter(made.twin.name)
    path = coarse(made, position, volume, 3 / 15)
    twin = made.twin
    camera = witness(WIDTH, WIDTH * 3 // 4, target=twin.target, distance=twin.distance, opening=twin.opening)
    pixels = np.stack([camera.project(torch.from_numpy(x).double())[0].numpy() for x in path])
    moved = np.linalg.norm(pixels - pixels[0], axis=-1).max(0)
    # a tenth of the body moves by more than a pixel, and by several, so that a material can be told from it
    assert np.quantile(moved, 0.9) > 3, np.quantile(moved, 0.9)
    size = np.ptp(position, 0).max()
    assert np.linalg.norm(path - path[0], axis=-1).max() < 0.5 * size  # it is poked, not torn off
    assert path[..., 2].min() > -0.5 * made.world.dx  # nothing goes through the table
    assert (pixels.min(1) > 0).all() and (pixels.max(1) < [camera.width, camera.height]).all()  # nor out of the picture


def test_a_hollow_cake_gives_way():
    """What METHOD=without_filling shows: a shell two particles thick under the same hand."""
    made = scene("cake")
    position, volume = matter("cake")
    spacing = made.world.dx / 2
    middle = np.array([0.0, 0.0, 0.048])
    inner = (np.linalg.norm((position - middle)[:, :2], axis=1) < 0.080 - 2 * spacing) & (
        np.abs(position[:, 2] - middle[2]) < 0.036 - 2 * spacing
    )
    full, hollow = (coarse(made, position[keep], volume[keep], 0.2) for keep in (inner | True, ~inner))
    sunk, more = ((path[0] - path)[..., 2].max() for path in (full, hollow))
    assert more > 1.5 * sunk
