"""The linear problem against beams in closed form, and loss factors against the complex modulus."""

import math

import numpy as np
import pytest
import torch
from modes_bodies import row, section, timoshenko, turned_beam, world

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.log import Log
from physics3d.materials.mixture import PART, Mixture
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.modes.model import model
from physics3d.modes.rollout import Solver


def frequencies(solver: Solver) -> np.ndarray:
    """Of the splines, before the reduction [Hz]."""
    return solver.model.exact_omega / (2 * math.pi)


@pytest.mark.parametrize("slender", [10, 60])
def test_a_clamped_beam_one_particle_across_swings_as_in_theory(slender):
    thick, young = 0.006, 1e5
    solver = Solver.of(world(young, 0.3), *row(slender, thick), log=Log(None))
    theory = timoshenko(slender * thick, *section("square", thick, 0.3)[:2], young, 0.3, 300.0, 0.85, free=False)
    found = frequencies(solver)
    # both planes of bending; (k H)^2/12 = 2 % in omega^2 of the second mode, where ten cells bend
    np.testing.assert_allclose(found[:2], theory[0], rtol=0.01)
    np.testing.assert_allclose(found[2:4], theory[1], rtol=0.01)


@pytest.mark.parametrize("shape", ["square", "round"])
@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_a_turned_free_beam_swings_as_in_theory(shape, degrees):
    thick, slender, young = 0.012, 20, 1e5
    position, volume, matter = turned_beam(slender * thick, thick, shape, degrees, spacing=0.006, shift=0.37)
    solver = Solver.of(world(young, 0.3, boundaries=()), position, volume, matter=matter, log=Log(None))
    area, inertia, shear = section(shape, thick, 0.3)
    theory = timoshenko(slender * thick, area, inertia, young, 0.3, 300.0, shear, free=True)
    found = frequencies(solver)[6:10]
    # 2 %: the quadratic splines and the sampled surface of a beam two cells across, wherever it lies
    np.testing.assert_allclose(found, np.repeat(theory, 2), rtol=0.02)


@pytest.mark.parametrize("cell", [4.0, 6.0, 8.0])
def test_splines_far_apart_say_how_much_too_stiff_they_are(cell):
    """Against the theory of a short free beam, in the mean over its first four modes: 0.5, 1.5 and 3 %; 2 % for the
    sampled surface besides."""
    thick, slender, young = 0.012, 10, 1e5
    position, volume, matter = turned_beam(slender * thick, thick, "square", 30, spacing=0.006, shift=0.37)
    of = world(young, 0.3, boundaries=())
    start = {name: torch.tensor(value).double() for name, value in of.start.items()}
    body = model(of, position, volume, parameters=start, boundaries=(), matter=matter, cells=(cell,), log=Log(None))
    area, inertia, shear = section("square", thick, 0.3)
    theory = timoshenko(slender * thick, area, inertia, young, 0.3, 300.0, shear, free=True)
    error = np.square(body.exact_omega[6:10] / (2 * np.pi * np.repeat(theory, 2))) - 1
    said = body.too_stiff()
    assert abs(error.mean()) < said + 0.02 and said < 0.12, (error, said)


def test_a_box_holds_wherever_its_face_runs():
    """Through the pieces or between two of them, which do not quite meet there: f L^2 is the same."""
    position, volume = row(12, 0.01)
    found = []
    for face in np.linspace(0.021, 0.031, 11):
        clamp = FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(float(face), 1.0, 1.0))
        held = world(1e5, 0.3, boundaries=(clamp,))
        solver = Solver.of(held, position, 0.5 * volume, log=Log(None))  # cubes of 7.9 mm, 2.1 mm apart
        found.append(frequencies(solver)[0] * (0.12 - face) ** 2)
    # a gap belongs to neither side: 2.1 mm of 90 is 5 % of f L^2
    np.testing.assert_allclose(found, np.mean(found), rtol=0.1)


def test_a_sliver_that_hangs_on_a_corner_of_what_is_held_is_held():
    """Behind the first cubes of a beam, which are held, and beside them, as sampling leaves one: it is no part of what
    swings. Left to itself it drifts, and the first frequencies are its."""
    position, volume = row(12, 0.01)
    behind = position.new_tensor([[-0.007, 0.0, 0.0075]])
    held = world(1e5, 0.3, boundaries=(HeldParticles(position=position[:2]),))
    alone = frequencies(Solver.of(held, position, volume, log=Log(None)))
    both = torch.cat([position, behind]), torch.cat([volume, volume.new_tensor([1e-9])])
    found = frequencies(Solver.of(held, *both, log=Log(None)))
    np.testing.assert_allclose(found[:4], alone[:4], rtol=1e-3)  # of what the smaller mean spacing changes


def test_a_free_body_has_six_rigid_motions():
    solver = Solver.of(world(1e5, 0.3, boundaries=()), *row(10, 0.006), log=Log(None))
    found = frequencies(solver)
    # what keeps the matrix regular is far below the first vibration
    assert (found[:6] < 0.02 * found[6]).all()


def test_the_reduced_model_has_the_frequencies_of_the_splines():
    solver = Solver.of(world(1e5, 0.3), *row(20, 0.006), log=Log(None))
    # integrated at all points, the modes are in the basis; round-off of a stiff and a soft direction in one matrix
    np.testing.assert_allclose(solver.model.omega[:6], solver.model.exact_omega[:6], rtol=1e-4)


def test_frequency_and_loss_follow_the_complex_modulus():
    """One Maxwell branch of the same Poisson ratio as the spring: E*(w) = E + E_N i w/(i w + k), whatever the body."""
    young, share, rate, nu = 1e4, 0.5, 20.0, 0.3
    mu_N = share * young / (2 * (1 + nu))
    K_N = share * young / (3 * (1 - 2 * nu))
    start = dict(
        youngs_modulus=young, poissons_ratio=nu, branch_shear_modulus=mu_N, branch_bulk_modulus=K_N,
        shear_relaxation_time=1 / rate, bulk_relaxation_time=1 / rate,
    )  # fmt: skip
    damped = world(young, nu, material=Viscoelastic(), start=start)
    body = row(10, 0.01)
    solver = Solver.of(damped, *body, log=Log(None))
    parameters = {name: torch.tensor(value) for name, value in start.items()}
    mode = solver.modes(parameters)[0]
    elastic = Solver.of(world(young, nu), *body, log=Log(None)).modes({k: parameters[k] for k in list(start)[:2]})[0]
    omega = 2 * math.pi * mode.frequency
    complex_modulus = 1 + share * 1j * omega / (1j * omega + rate)
    # the relaxation is sampled at 120 times; shapes are the same because both parts have one Poisson ratio
    assert mode.frequency == pytest.approx(elastic.frequency * math.sqrt(complex_modulus.real), rel=2e-3)
    assert mode.loss_factor == pytest.approx(complex_modulus.imag / complex_modulus.real, rel=1e-2)


def test_a_held_body_names_its_slowest_swing_however_stiff_it_is_elsewhere():
    """A stiff rod on a soft foot: k = E' I/foot turns it about the middle of the foot."""
    count, edge, soft, hard, of_foot = 60, 0.006, 1e3, 1e9, 4
    start = {f"{part}.{name}": value for part, young in (("foot", soft), ("rod", hard))
             for name, value in (("youngs_modulus", young), ("poissons_ratio", 0.3))}  # fmt: skip
    both = Mixture(materials={"foot": NeoHookean(), "rod": NeoHookean()})
    part = torch.tensor([0] * of_foot + [1] * (count - of_foot))
    solver = Solver.of(world(soft, 0.3, material=both, start=start), *row(count, edge), part=part, log=Log(None))
    values = {name: torch.tensor(value) for name, value in start.items()} | {PART: part}
    found = solver.modes(values)
    foot, rod = of_foot * edge, (count - of_foot) * edge
    inertia = 300.0 * edge**2 * rod * ((foot / 2 + rod / 2) ** 2 + rod**2 / 12)
    theory = math.sqrt(soft * edge**4 / 12 / foot / inertia) / (2 * math.pi)
    assert found[-1].frequency > 1e3 * found[0].frequency
    # splines that reach from the foot into the rod are stiff: at most one of the foot's four particles is lost to them
    assert theory < found[0].frequency < math.sqrt(4 / 3) * theory
