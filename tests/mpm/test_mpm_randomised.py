"""Whatever an optimiser or a scene proposes ends in finite numbers or in a ValueError with a remedy, never in NaN.

Bodies, stiffness, viscosity, forces and time steps are drawn over the ranges of docs/method.md ("stiff and extreme"),
the same ones in every run: one particle alone, one at the corner of the region, a sheet of single particles, masses
that differ by 1e6, a blow that would cross the grid in one step, a press that leaves less than 1 % of the height.
"""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from mpm_bodies import block, tensors

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.bounding_box import BoundingBox
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.boundaries.mesh_collider import MeshCollider
from physics3d.boundaries.moving_cuboid import MovingCuboid
from physics3d.log import Log
from physics3d.materials.drucker_prager import DruckerPrager
from physics3d.materials.newtonian import Newtonian
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout
from physics3d.world import World

DX = 0.04
LOWER, UPPER = (0.0, 0.0, 0.0), (0.4, 0.4, 0.4)
FIXED = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=25,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers from 10^low to 10^high, alike in their logarithm."""
    return st.floats(low, high).map(lambda k: 10.0**k)


def elastic() -> dict[str, st.SearchStrategy[float]]:
    return dict(youngs_modulus=powers(2, 10), poissons_ratio=st.floats(0.0, 0.4999))


MATERIALS = {
    Viscoelastic(branches=1): st.fixed_dictionaries(
        elastic()
        | dict(
            branch_shear_modulus=powers(2, 9),
            branch_bulk_modulus=powers(2, 9),
            # viscosities from next to nothing to 1e12 Pa s and beyond
            shear_relaxation_time=powers(-9, 6),
            bulk_relaxation_time=powers(-9, 6),
        )
    ),
    DruckerPrager(): st.fixed_dictionaries(elastic() | dict(friction_angle=st.floats(0.01, 1.5))),
    Newtonian(): st.fixed_dictionaries(
        dict(bulk_modulus=powers(2, 10), viscosity=powers(-6, 12), power_index=st.floats(0.0, 2.0))
    ),
}


def bodies() -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """(position [p, 3], volume [p]) in the region."""
    position, volume = block((2, 2, 2), DX, lower=(0.16, 0.16, 0.0))
    flat = position[position[:, 2] == position[0, 2]]
    return {
        "cube": (position, volume),
        "masses that differ by 1e6": (position, volume * torch.logspace(-3, 3, len(volume), dtype=torch.float64)),
        "sheet": (flat, volume[: len(flat)]),
        "one": (torch.tensor([[0.2, 0.21, 0.19]], dtype=torch.float64), volume[:1]),
        "lower corner": (torch.tensor([LOWER], dtype=torch.float64), volume[:1]),
        "upper corner": (torch.tensor([UPPER], dtype=torch.float64), volume[:1]),
        "two at every place": (position.repeat(2, 1), volume.repeat(2)),
    }


def press(duration: float) -> MovingCuboid:
    """A plate from two cells above the ground to three below it: what is next to the ground shrinks to exp(-5)."""
    velocity = (0.0, 0.0, -5 * DX / duration)
    return MovingCuboid(lower=(-1.0, -1.0, 2 * DX), upper=(1.0, 1.0, 1.0), velocity=velocity, duration=duration)


TETRAHEDRON = MeshCollider(
    vertices=((0.0, 0.0, -0.1), (0.4, 0.0, -0.1), (0.0, 0.4, -0.1), (0.0, 0.0, 0.3)),
    triangles=((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
    angular_velocity=(0.0, 0.0, 1.0),
    kind="separate",
    friction=0.5,
)


def surroundings(name: str, duration: float) -> tuple[AbstractBoundary, ...]:
    """What is around the body for `duration` [s]."""
    return {
        "nothing": (),
        "slipping walls": (BoundingBox(kind="slip"),),
        "a press": (press(duration), BoundingBox(kind="sticky")),
        "a slope and a mesh": (
            HalfSpace(point=(0.0, 0.0, 0.01), normal=(0.1, 0.2, 1.0), kind="separate", friction=0.5),
            TETRAHEDRON,
        ),
    }[name]


@st.composite
def scenes(draw, values: st.SearchStrategy[dict[str, float]]):
    """(parameters, name of the body, its speed, force on a part of it, frame_dt, options of the world)"""
    start, body = draw(values), draw(st.sampled_from(list(bodies())))
    density = draw(powers(0, 4))
    stiff = max(start.get(name, 0.0) for name in ("youngs_modulus", "branch_shear_modulus", "bulk_modulus"))
    speed = draw(st.sampled_from([0.0, 1e-3, 1.0, 1e3])) * draw(st.sampled_from([1.0, -1.0]))
    force = draw(st.sampled_from([0.0, 1.0, 1e9]))
    # a fixed step from far too short to far too long, or an automatic one for some dozen cells of waves and flight
    dt = draw(st.none() | powers(-7, 0))
    crossing = min(DX / (math.sqrt(stiff / density) + abs(speed)), math.sqrt(DX / 9.81))
    frame_dt = draw(powers(-1, 1.2)) * crossing if dt is None else dt * draw(st.integers(1, 20))
    options = dict(
        density=density,
        dt=dt,
        max_substeps=128,
        damping=draw(st.sampled_from([0.0, 10.0])),
        scheme=draw(st.sampled_from(["auto", "auto", "explicit", "implicit"])),
    )
    return start, body, speed, force, frame_dt, options


def check(material, around, scene) -> None:
    start, body, speed, force, frame_dt, options = scene
    position, volume = bodies()[body]
    velocity = torch.tensor((speed, 0.5 * speed, -speed))
    poke = Impulse(force=(force, 0.3 * force, 0.0), centre=tuple(position[0].tolist()), radius=0.05, duration=frame_dt)
    boundaries = surroundings(around, 2 * frame_dt)
    world = World(material=material, start=start, dx=DX, boundaries=boundaries, lower=LOWER, upper=UPPER, **options)
    try:
        with torch.no_grad():
            trajectory = rollout(
                world, tensors(start), position, volume,
                velocity=velocity, excitation=(poke,), frames=3, frame_dt=frame_dt, threads=1, log=Log(None),
            )  # fmt: skip
    except ValueError as refusal:
        assert any(word in str(refusal) for word in ("take", "enlarge", "move")), refusal
        return
    assert torch.isfinite(trajectory.position).all() and torch.isfinite(trajectory.deformation).all()
    for name, curve in trajectory.health.items():
        assert np.isfinite(curve).all(), (name, curve)
    # as far as the solver lets a particle stray from the region before it refuses
    x = trajectory.position.double()
    slack = 1.5 * DX + 1e-6
    assert float(x.min()) >= min(LOWER) - slack and float(x.max()) <= max(UPPER) + slack


@pytest.mark.timeout(300)
@pytest.mark.parametrize("around", ["nothing", "slipping walls", "a press", "a slope and a mesh"])
def test_any_viscoelastic_scene_is_finite_or_refused(around):
    (material, values), *_ = MATERIALS.items()

    @FIXED
    @given(scenes(values))
    def law(scene):
        check(material, around, scene)

    law()


@pytest.mark.timeout(300)
@pytest.mark.parametrize("material", list(MATERIALS)[1:], ids=lambda m: type(m).__name__)
def test_any_sand_or_fluid_in_a_press_is_finite_or_refused(material):
    @FIXED
    @given(scenes(MATERIALS[material]))
    def law(scene):
        check(material, "a press", scene)

    law()
