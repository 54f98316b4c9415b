"""The implicit step: stable far beyond the explicit limit, the explicit solution as dt shrinks, exact gradients."""

import dataclasses
import math
from itertools import pairwise

import pytest
import torch
from mpm_bodies import block, every_boundary, every_material, soft_world, tensors

from physics3d.boundaries.bounding_box import BoundingBox
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.log import Log
from physics3d.materials.drucker_prager import DruckerPrager
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.newtonian import Newtonian
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.rollout import rollout

DX = 0.1
CLAMP = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(0.05, 1.0, 1.0))
PUSH = Impulse(force=(30.0, 5.0, -4.0), centre=(0.1, 0.1, 0.1), radius=0.12, start=0.013, duration=0.03)


def simulate(world, position, volume, *, frames, frame_dt, **more):
    more.setdefault("threads", 1)
    with torch.no_grad():
        return rollout(
            world, tensors(world.start), position, volume, frames=frames, frame_dt=frame_dt, log=Log(None), **more
        )


def lone_limit(world) -> float:
    """The longest explicit substep [s], dx/(sqrt(3) c), of the undeformed body."""
    modulus = float(world.material.wave_modulus(world.material.coefficients(tensors(world.start))).max())
    return world.dx / math.sqrt(3 * modulus / world.density)


def shaken(n: int, speed: float) -> torch.Tensor:
    return speed * torch.randn(n, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


@pytest.mark.parametrize(
    ("material", "precision"), [(NeoHookean(), "float64"), (Viscoelastic(branches=0), "float32")], ids=repr
)
def test_twenty_times_the_explicit_limit_holds_with_bounded_energy(material, precision):
    position, volume = block((4, 2, 2), DX)
    start = dict(youngs_modulus=1e6, poissons_ratio=0.4)
    world = soft_world(material=material, start=start, boundaries=(CLAMP,), scheme="implicit", precision=precision)
    dt = 20 * lone_limit(world)
    world = dataclasses.replace(world, dt=dt)
    velocity = 0.3 * (position / DX) ** 2 / 16 + shaken(len(position), 0.1)
    health = simulate(world, position, volume, frames=13, frame_dt=dt, velocity=velocity).health
    energy = torch.tensor(health["energy"])
    # backward Euler takes energy out and never adds any; the transfers neither
    rounding = 1e-3 if precision == "float32" else 1e-6
    assert bool((energy.diff() <= rounding * energy[0]).all())
    assert -rounding * float(energy[0]) <= float(energy[-1]) < float(energy[0])
    assert set(health["rejected"]) == {0.0}


@pytest.mark.parametrize("material", [NeoHookean(), Viscoelastic(branches=1)], ids=repr)
def test_solution_of_the_explicit_scheme_as_the_step_shrinks(material):
    """First order: half the step, half the difference. Both with the same step, for the transfers damp what lives below
    a cell by as much in each of them."""
    position, volume = block((4, 1, 1), DX)
    branch = dict(
        branch_shear_modulus=4e3, branch_bulk_modulus=8e3, shear_relaxation_time=0.2, bulk_relaxation_time=0.5
    )
    start = dict(youngs_modulus=1e4, poissons_ratio=0.3) | (branch if isinstance(material, Viscoelastic) else {})
    world = soft_world(material=material, start=start, boundaries=(CLAMP,))
    velocity = torch.zeros_like(position)
    velocity[:, 0] = 0.05 * torch.sin(math.pi / 2 * position[:, 0] / 0.4)
    seconds = 8 * lone_limit(world)

    def moved(scheme: str, steps: int) -> torch.Tensor:
        run = dataclasses.replace(world, scheme=scheme, dt=seconds / steps)
        return simulate(run, position, volume, frames=2, frame_dt=seconds, velocity=velocity).position[-1] - position

    errors = []
    for steps in (16, 32, 64):
        explicit = moved("explicit", steps)
        errors.append(float((moved("implicit", steps) - explicit).norm() / explicit.norm()))
    slopes = [math.log2(a / b) for a, b in pairwise(errors)]
    assert errors[-1] < 0.04
    assert all(0.9 < slope < 1.1 for slope in slopes), (errors, slopes)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_one_endless_step_is_the_equilibrium(precision):
    """A column under its own weight between slip walls, u = -(rho g/M)(L z - z^2/2); a second step moves nothing."""
    position, volume = block((1, 1, 6), DX)
    walls = BoundingBox(kind="slip", lower=(0.0, 0.0, 0.0), upper=(DX, DX, 3.0))
    world = soft_world(
        gravity=(0.0, 0.0, -9.81), boundaries=(walls,), scheme="implicit", dt=1e3, precision=precision,
        start=dict(youngs_modulus=1e7, poissons_ratio=0.3), material=Viscoelastic(branches=0),
        lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 3.0),
    )  # fmt: skip
    trajectory = simulate(world, position, volume, frames=3, frame_dt=1e3)
    u = (trajectory.position - position)[1:, :, 2].double()
    length, z, M = 0.6, position[:, 2], 1e7 * 0.7 / (1.3 * 0.4)
    exact = -(1000 * 9.81 / M) * (length * z - z**2 / 2)
    # six cells with mirrored walls, second order in dx
    assert float((u[0] - exact).norm() / exact.norm()) < 0.03
    # geometrically non-linear, rho g L/M = 4e-4 of it
    assert float((u[1] - u[0]).norm() / exact.norm()) < 2e-3


def test_momenta_of_a_free_body_are_kept():
    """A stiff body that spins and vibrates, ten times the explicit limit."""
    position, volume = block((3, 3, 2), DX)
    world = soft_world(start=dict(youngs_modulus=1e6, poissons_ratio=0.3), scheme="implicit")
    omega = torch.tensor((0.3, 0.0, 2.0), dtype=torch.float64)
    velocity = torch.linalg.cross(omega.expand_as(position), position - position.mean(0)) + 0.05 * position.flip(1)
    dt = 10 * lone_limit(world)
    health = simulate(
        dataclasses.replace(world, dt=dt), position, volume, frames=11, frame_dt=dt, velocity=velocity
    ).health
    # the residual of Newton is 1e-11 of the velocities; backward Euler brakes a spin by w dt/2 per radian
    for kind, tolerance in (("momentum", 1e-8), ("angular_momentum", 0.01)):
        curves = torch.tensor([health[f"{kind}_{axis}"] for axis in "xyz"], dtype=torch.float64)
        scale = float(curves[:, 0].norm())
        assert float((curves - curves[:, :1]).abs().max()) < tolerance * scale, kind


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_threads_agree_and_reruns_are_equal_bit_by_bit(precision):
    position, volume = block((3, 3, 3), DX)
    ground = HalfSpace(point=(0.0, 0.0, -0.01), normal=(0.0, 0.0, 1.0), kind="separate")
    world = soft_world(
        precision=precision, gravity=(0.0, 0.0, -9.81), boundaries=(ground,), scheme="implicit", dt=0.02,
        start=dict(youngs_modulus=1e6, poissons_ratio=0.3),
    )  # fmt: skip

    def run(threads: int):
        return simulate(world, position, volume, frames=3, frame_dt=0.04, threads=threads, excitation=(PUSH,)).position

    one, two, again = run(1), run(2), run(2)
    assert torch.equal(two, again)
    # sums in another order, and Newton ends a tolerance away
    assert float((one - two).abs().max()) < (1e-5 if precision == "float32" else 1e-10)


# --- gradients --------------------------------------------------------------------------------------------------------


def compare(loss, inputs: dict[str, torch.Tensor]) -> None:
    """Adjoint against central differences along one random direction of all inputs together, each to its scale."""
    generator = torch.Generator().manual_seed(1)
    inputs = {name: value.double().requires_grad_() for name, value in inputs.items()}
    gradients = torch.autograd.grad(loss(**inputs), list(inputs.values()))
    directions = {
        name: float(value.detach().abs().max().clamp(min=0.1))
        * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        for name, value in inputs.items()
    }
    adjoint = sum(float((g * d).sum()) for g, d in zip(gradients, directions.values()))

    def difference(h: float) -> float:
        with torch.no_grad():
            ahead, behind = (
                loss(**{name: value + sign * h * directions[name] for name, value in inputs.items()})
                for sign in (1, -1)
            )
        return float(ahead - behind) / (2 * h)

    coarse, fine = difference(2e-5), difference(1e-5)
    noise = abs(coarse - fine)  # truncation, fourfold less in the finer one, and round-off of the solves
    assert abs(adjoint - fine) <= 1e-6 * abs(fine) + noise, (adjoint, coarse, fine)
    assert noise <= 1e-5 * abs(fine), f"the differences {coarse}, {fine} are no reference"


def make_loss(world, *, frame_dt: float, speed: float, excitation=()):
    position, volume = block((2, 2, 2), DX)
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(3, 64, 3, *tail, generator=generator, dtype=torch.float64) for tail in ((), (3,)))

    signs = {name: math.copysign(1.0, value) for name, value in world.start.items()}

    def loss(*, velocity, place, force=None, **logs):
        parameters = {name: signs[name] * value.exp() for name, value in logs.items()}
        extra = () if force is None else (dataclasses.replace(PUSH, force=force),)
        trajectory = rollout(
            world, parameters, position + 0.1 * DX * place, volume, velocity=speed * velocity,
            excitation=(*excitation, *extra), frames=3, frame_dt=frame_dt, threads=1, log=Log(None),
        )  # fmt: skip
        return (a * (trajectory.position - position)).sum() / DX + (b * trajectory.deformation).sum()

    inputs = {"velocity": shaken(64, 1.0) + position.flip(1) / DX, "place": shaken(64, 1.0).flip(1)}
    return loss, inputs | {name: value.abs().log() for name, value in tensors(world.start).items()}


@pytest.mark.parametrize("boundary", every_boundary(), ids=lambda b: f"{type(b).__name__}-{getattr(b, 'kind', '')}")
def test_adjoint_is_the_derivative_through_every_boundary(boundary):
    """With an impulse, gravity and damping, steps of twelve times the explicit limit."""
    start = dict(youngs_modulus=1e6, poissons_ratio=0.3)
    world = soft_world(scheme="implicit", dt=0.02, damping=0.5, gravity=(0.0, 0.0, -9.81), start=start)
    loss, inputs = make_loss(world, frame_dt=0.02, speed=0.1, excitation=(boundary,))
    compare(loss, inputs | {"force": torch.tensor(PUSH.force)})


@pytest.mark.parametrize("material", every_material(), ids=repr)
def test_adjoint_is_the_derivative_for_every_material(material):
    start = {name: value for name, value in material.example.items() if value > 0}
    assert len(start) == len(material.example) or not isinstance(material, NeoHookean | Viscoelastic)
    world = soft_world(material=material, start=dict(material.example), scheme="implicit")
    dt = 4 * lone_limit(world)
    world = dataclasses.replace(world, dt=dt)
    loss, inputs = make_loss(world, frame_dt=2 * dt, speed=0.02 * DX / dt)
    constant = {name: inputs.pop(name) for name in material.example if name not in start}
    compare(lambda **some: loss(**some, **constant), inputs)


def test_a_second_way_back_gives_the_same_gradient():
    world = soft_world(scheme="implicit", dt=0.02, start=dict(youngs_modulus=1e6, poissons_ratio=0.3))
    loss, inputs = make_loss(world, frame_dt=0.04, speed=0.1, excitation=(CLAMP,))
    inputs = {name: value.double().requires_grad_() for name, value in inputs.items()}
    value = loss(**inputs)
    first = torch.autograd.grad(value, list(inputs.values()), retain_graph=True)
    again = torch.autograd.grad(value, list(inputs.values()))
    for one, two in zip(first, again):
        assert torch.equal(one, two) and bool(one.any())


# --- the choice -------------------------------------------------------------------------------------------------------


def test_automatic_scheme_is_implicit_only_where_that_pays():
    position, volume = block((2, 2, 2), DX)

    def newton(**changes) -> float:
        return sum(
            simulate(soft_world(**changes), position, volume, frames=2, frame_dt=0.05).health["newton_iterations"]
        )

    stiff = dict(start=dict(youngs_modulus=1e12, poissons_ratio=0.3), gravity=(0.0, 0.0, -9.81))
    assert newton() == 0
    assert newton(**stiff) > 0
    # a substep that is given is that of the explicit scheme, and refused
    with pytest.raises(ValueError, match="implicit"):
        newton(**stiff, dt=0.01)


def test_fluid_too_viscous_for_explicit_substeps():
    """1e6 Pa s: explicit substeps are refused with viscosity named, the automatic scheme flows on, without inertia."""
    position, volume = block((2, 2, 2), DX)
    start = dict(bulk_modulus=1e5, viscosity=1e6, power_index=1.0)
    world = soft_world(material=Newtonian(), start=start, max_substeps=10_000)
    shear = torch.zeros_like(position)
    shear[:, 0] = position[:, 2] - 0.1
    with pytest.raises(ValueError, match=r"would need \d+ substeps .* viscosity of 1e\+06 Pa s .* scheme='implicit'"):
        explicit = dataclasses.replace(world, scheme="explicit")
        simulate(explicit, position, volume, frames=3, frame_dt=0.04, velocity=shear)
    trajectory = simulate(world, position, volume, frames=3, frame_dt=0.04, velocity=shear)
    assert torch.isfinite(trajectory.position).all() and sum(trajectory.health["newton_iterations"]) > 0
    # the shear dies at once, the rotation in it stays, which has half of the energy
    assert trajectory.health["kinetic_energy"][-1] == pytest.approx(
        0.5 * trajectory.health["kinetic_energy"][0], rel=0.1
    )


def test_sand_has_no_potential_and_converges_all_the_same():
    position, volume = block((2, 2, 2), DX)
    ground = HalfSpace(point=(0.0, 0.0, -0.01), normal=(0.0, 0.0, 1.0), kind="separate", friction=0.3)
    world = soft_world(
        material=DruckerPrager(), start=dict(DruckerPrager().example), boundaries=(ground,), gravity=(0.0, 0.0, -9.81),
        scheme="implicit",
    )  # fmt: skip
    health = simulate(world, position, volume, frames=3, frame_dt=0.02).health
    assert max(health["kinetic_energy"]) < 10 and all(map(math.isfinite, health["energy"]))
