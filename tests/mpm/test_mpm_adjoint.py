"""The gradient of a whole rollout is its derivative: against central differences, in double precision."""

import dataclasses
import math

import pytest
import torch
from differences import compare
from mpm_bodies import block, every_boundary, every_material, soft_world, tensors

from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout

DX = 0.1
PUSH = Impulse(force=(30.0, 5.0, -4.0), centre=(0.2, 0.2, 0.2), radius=0.12, start=0.013, duration=0.03)


def make_loss(world, excitation=(), *, frames=4, threads=1):
    position, volume = block((3, 3, 3), DX)
    generator = torch.Generator().manual_seed(0)
    n = len(position)
    a = torch.randn(frames, n, 3, generator=generator, dtype=torch.float64)
    b = torch.randn(frames, n, 3, 3, generator=generator, dtype=torch.float64)

    def loss(*, velocity, position=position, force=None, **parameters):
        parameters = {name: value.exp() if name in world.start else value for name, value in parameters.items()}
        extra = () if force is None else (dataclasses.replace(PUSH, force=force),)
        trajectory = rollout(
            world,
            parameters,
            position,
            volume,
            velocity=velocity,
            excitation=(*excitation, *extra),
            frames=frames,
            frame_dt=0.02,
            threads=threads,
            log=Log(None),
        )
        return (a * (trajectory.position - position)).sum() + (b * trajectory.deformation).sum()

    return loss, n


def logarithms(values: dict[str, float]) -> dict[str, torch.Tensor]:
    return {name: value.abs().log() for name, value in tensors(values).items()}


def shaken(n: int) -> torch.Tensor:
    """Initial velocities that deform the body at once [n, 3]."""
    return 0.3 * torch.randn(n, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


@pytest.mark.parametrize("material", every_material(), ids=repr)
def test_adjoint_is_the_derivative_for_every_material(material):
    start = dict(material.example)
    world = soft_world(material=material, start=start, dt=None)
    wave = float(material.wave_modulus(material.coefficients(tensors(start))).max())
    # whatever its stiffness, the body deforms by some per cent in 40 substeps that are fixed while parameters vary
    duration = 40 * 0.25 * DX / (wave / world.density) ** 0.5
    speed = 0.05 * DX / duration * 40
    world = dataclasses.replace(world, dt=duration / 40)
    position, volume = block((2, 2, 2), DX)
    n = len(position)
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(3, n, 3, generator=generator, dtype=torch.float64)
    b = torch.randn(3, n, 3, 3, generator=generator, dtype=torch.float64)
    shape = torch.randn(n, 3, generator=generator, dtype=torch.float64) * 0.2 + position.flip(1) / DX

    signs = {name: math.copysign(1.0, value) for name, value in start.items()}

    def loss(velocity, **logs):
        parameters = {name: signs[name] * value.exp() for name, value in logs.items()}
        trajectory = rollout(
            world, parameters, position, volume,
            velocity=velocity * speed * shape, frames=3, frame_dt=duration / 2, threads=1, log=Log(None),
        )  # fmt: skip
        return (a * trajectory.position).sum() / DX + (b * trajectory.deformation).sum()

    # 1e-6 of the derivative, as the rounding of differences allows
    compare(loss, {"velocity": torch.tensor(1.0), **logarithms(start)}, tolerance=1e-6)


@pytest.mark.parametrize("boundary", every_boundary(), ids=lambda b: f"{type(b).__name__}-{getattr(b, 'kind', '')}")
def test_adjoint_is_the_derivative_through_every_boundary(boundary):
    world = soft_world(dt=0.002, damping=0.5, gravity=(0.0, 0.0, -9.81))
    loss, n = make_loss(world, (boundary,))
    compare(loss, {"velocity": shaken(n), **logarithms(world.start)}, tolerance=1e-6)


@pytest.mark.parametrize("threads", [1, 2])
def test_adjoint_is_the_derivative_for_force_and_position(threads):
    ground = HalfSpace(point=(0.0, 0.0, 0.05), normal=(0.1, 0.0, 1.0), kind="separate", friction=0.3)
    world = soft_world(dt=0.002, gravity=(0.0, 0.0, -9.81), boundaries=(ground,))
    loss, n = make_loss(world, frames=3, threads=threads)
    position, _ = block((3, 3, 3), DX)
    inputs = {"velocity": shaken(n), "force": torch.tensor(PUSH.force), "position": position, **logarithms(world.start)}
    compare(loss, inputs, tolerance=1e-6)


def test_adjoint_is_the_derivative_for_a_field_of_stiffness():
    world = soft_world(dt=0.002)
    loss, n = make_loss(world, frames=3)
    E = (1e4 * torch.linspace(0.5, 1.5, n)).log()
    compare(
        loss, {"velocity": shaken(n), "youngs_modulus": E, "poissons_ratio": torch.tensor(0.3).log()}, tolerance=1e-6
    )


def test_adjoint_spans_checkpoints():
    """A frame longer than a run of substeps between checkpoints has the same exact gradient."""
    world = soft_world(dt=0.02 / 75)
    loss, n = make_loss(world, frames=3)
    compare(loss, {"velocity": shaken(n), **logarithms(world.start)}, tolerance=1e-6)


def test_gradient_at_rest_is_finite():
    """The body does not move, all stretches are equal, all speeds zero: nothing may become 0/0."""
    world = soft_world(material=NeoHookean(), boundaries=(HalfSpace(
        point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), kind="separate", friction=0.5),))  # fmt: skip
    loss, _ = make_loss(world)
    inputs = {"velocity": torch.zeros(3, dtype=torch.float64), "force": torch.zeros(3, dtype=torch.float64)}
    inputs = {name: value.requires_grad_() for name, value in (inputs | logarithms(world.start)).items()}
    for name, gradient in zip(inputs, torch.autograd.grad(loss(**inputs), list(inputs.values()))):
        assert torch.isfinite(gradient).all(), name


def test_gradient_in_single_precision_follows_double_precision():
    gradients = []
    for precision in ("float32", "float64"):
        loss, n = make_loss(soft_world(dt=0.002, gravity=(0.0, 0.0, -9.81), precision=precision))
        inputs = {"velocity": shaken(n), **logarithms(soft_world().start)}
        inputs = {name: value.requires_grad_() for name, value in inputs.items()}
        gradients.append(torch.autograd.grad(loss(**inputs), list(inputs.values())))
    for single, double in zip(*gradients):
        # seven digits, less those lost in thirty substeps and in the sum over particles
        assert float((single - double).norm()) < 1e-3 * float(double.norm())
