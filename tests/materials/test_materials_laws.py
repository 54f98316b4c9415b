"""Laws that every constitutive model obeys, checked on whatever lies in physics3d/materials."""

import math

import pytest
import torch
from mpm_bodies import every_material

from physics3d.learning.fields import is_elastic, is_stiff
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.material_points import advance
from physics3d.materials.mixture import Mixture
from physics3d.materials.mooney_rivlin import MooneyRivlin
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.newtonian import Newtonian
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.materials.von_mises import VonMises
from physics3d.materials.with_branches import WithBranches
from physics3d.materials.yeoh import Yeoh

ONE = torch.eye(3, dtype=torch.float64)


def found_materials() -> list[AbstractMaterial]:
    """One default instance of each class in the folder, variants of the viscoelastic solid, and compositions."""
    return [
        *every_material(),
        Viscoelastic(spring="neo_hookean"),
        Viscoelastic(spring="neo_hookean", flow="stress"),
        Viscoelastic(branches=0),
        Viscoelastic(elastic=False),
        Viscoelastic(branches=3),
        WithBranches(solid=VonMises(), branches=2, spring="neo_hookean"),
        Mixture(materials={"stem": Viscoelastic(), "petal": NeoHookean(), "leaf": Viscoelastic(), "pot": Newtonian()}),
    ]


@pytest.fixture(params=found_materials(), ids=repr, scope="module")
def material(request) -> AbstractMaterial:
    return request.param


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def placed(material, values, n):
    """The parameters, and what a mixture is told of n particles: they take turns."""
    if not isinstance(material, Mixture):
        return values
    parts = tuple(material.materials)
    return material.per_part(values, torch.arange(n) % len(parts), parts)


def coefficients(material, n, dtype=torch.float64):
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in material.example.items()}
    return material.coefficients(placed(material, values, n)).expand(-1, n).to(dtype).contiguous()


def stiffness(material) -> float:
    return material.wave_modulus(coefficients(material, 1)).item()


def random(rng, *shape):
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def random_rotation(rng, n):
    Q, _ = torch.linalg.qr(random(rng, n, 3, 3))
    return Q * torch.linalg.det(Q)[:, None, None]


def walk(material, H, increments, dt=0.01):
    """Stresses and last state along F_next = (I + M) F, M = increments[step]."""
    c = coefficients(material, len(H), H.dtype)
    memory, history = material.initial_memory(len(H), H.dtype), []
    for M in increments:
        H, tau, memory = advance(material, dt, M / dt, H, c, memory)
        history.append(tau)
    return torch.stack(history), H, memory


def states(material, rng):
    """Reached by large random steps: generic, equal stretches, rigid rotation, rest, strong compression and stretch."""
    special = [
        torch.zeros(3, 3),
        torch.diag(torch.tensor([0.5, 0.5, 0.0])),
        torch.diag(torch.tensor([-0.5, -0.5, -0.5])),
        torch.diag(torch.tensor([-0.9, 0.3, 0.3])),
        torch.diag(torch.tensor([3.0, -0.4, 0.0])),
    ]
    M = torch.cat([torch.stack(special).double(), 0.3 * random(rng, 5, 3, 3), 1e-5 * random(rng, 3, 3, 3)])
    M = torch.cat([M, random_rotation(rng, len(M)) @ (ONE + M) - ONE])
    _, H, memory = walk(material, torch.zeros_like(M), [M])
    return H.detach(), memory.detach()


def test_no_stress_at_rest(material):
    tau, H, _ = walk(material, torch.zeros(1, 3, 3, dtype=torch.float64), [torch.zeros(1, 3, 3, dtype=torch.float64)])
    assert tau.abs().max() == 0
    assert H.abs().max() == 0


def test_shear_under_compression_is_resisted(material):
    M = torch.tensor([[[-0.01, 0.01, 0], [0, -0.01, 0], [0, 0, -0.01]]], dtype=torch.float64)
    tau, _, _ = walk(material, torch.zeros_like(M), [M] * 3)
    assert tau[-1, 0, 0, 1] > 1e-6 * stiffness(material)
    assert tau[-1, 0].trace() < -1e-3 * stiffness(material)


def test_stress_rotates_with_the_body_and_forgets_the_rotation_before(material, rng):
    increments = 0.1 * random(rng, 4, 6, 3, 3)
    Q, start = random_rotation(rng, 6), torch.zeros(6, 3, 3, dtype=torch.float64)
    tau, _, _ = walk(material, start, increments)
    objective, _, _ = walk(material, Q - ONE, Q @ increments @ Q.mT)
    isotropic, _, _ = walk(material, Q - ONE, increments)
    round_off = 1e-12 * tau.abs().max()
    torch.testing.assert_close(objective, Q @ tau @ Q.mT, rtol=0, atol=round_off)
    torch.testing.assert_close(isotropic, tau, rtol=0, atol=round_off)
    torch.testing.assert_close(tau, tau.mT, rtol=0, atol=round_off)


@pytest.mark.parametrize("size", [1e-6, 0.1])
def test_a_finite_rotation_in_every_step_changes_nothing(material, size, rng):
    """Each step turns the body, or whoever looks at it, by another rotation of any angle."""
    increments = size * random(rng, 4, 6, 3, 3)
    Q = torch.stack([ONE.repeat(6, 1, 1), *(random_rotation(rng, 6) for _ in increments)])
    turned = torch.stack([Q[i + 1] @ (ONE + M) @ Q[i].mT - ONE for i, M in enumerate(increments)])
    start = torch.zeros(6, 3, 3, dtype=torch.float64)
    tau, H, memory = walk(material, start, increments)
    seen, H_seen, memory_seen = walk(material, start, turned)
    # 1 + 1e-6 holds ten digits of the small strain; F and its rotation are rounded against the stiffness
    round_off = 1e-13 * stiffness(material) + 1e-12 * tau.abs().max()
    torch.testing.assert_close(seen, Q[1:] @ tau @ Q[1:].mT, rtol=0, atol=round_off)
    c = coefficients(material, 6)
    expected = material.energy(c, H, memory)
    torch.testing.assert_close(material.energy(c, H_seen, memory_seen), expected, rtol=1e-8, atol=round_off)


@pytest.mark.parametrize("size", [1e-6, 0.3])
def test_stress_is_the_derivative_of_the_stored_energy(material, size, rng):
    """Where nothing flows: for sand and metal, that is under slight compression and far inside the yield surface."""
    if size > 0.1 and any(name in repr(material) for name in ("VonMises", "DruckerPrager", "Snow", "Newtonian")):
        pytest.skip("flows at once at large strain")
    n = 6
    M = size * random(rng, n, 3, 3) - (1e-4 * ONE if size < 0.1 else 0)
    _, H, memory = walk(material, torch.zeros_like(M), [M])
    c = coefficients(material, n)
    _, tau, _ = advance(material, 0.0, torch.zeros_like(M), H, c, memory)
    A, step, instant = random(rng, n, 3, 3), min(1e-5, size), 1e-15

    def energy(sign):
        H_next, _, memory_next = advance(material, instant, sign * step / instant * A, H, c, memory)
        return material.energy(c, H_next, memory_next)

    power = (energy(1) - energy(-1)) / (2 * step)
    # central differences: step^2, and round-off 1e-16 of the stiffness over the step, which is 1e-6 of the small stress
    accuracy = 1e-7 if size > 0.1 else 1e-5
    torch.testing.assert_close((tau * A).sum((1, 2)), power, rtol=1e-5, atol=accuracy * tau.abs().max().item())


def small_strain_moduli(material) -> tuple[float, float]:
    """(mu, lam) [Pa] of the solid at once after it is strained, by the handbook."""
    example, mu, lam = material.example, 0.0, 0.0
    if "poissons_ratio" in example:
        E, nu = example["youngs_modulus"], example["poissons_ratio"]
        mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    if isinstance(material, MooneyRivlin):
        mu = 2 * (example["first_modulus"] + example["second_modulus"])
        lam = example["bulk_modulus"] - 2 / 3 * mu
    if isinstance(material, Yeoh):
        mu = 2 * example["linear_modulus"]
        lam = example["bulk_modulus"] - 2 / 3 * mu
    for suffix in ("", "_2", "_3"):
        if "branch_shear_modulus" + suffix in example:
            mu_N, K_N = (example[f"branch_{name}_modulus{suffix}"] for name in ("shear", "bulk"))
            mu, lam = mu + mu_N, lam + K_N - 2 / 3 * mu_N
    return mu, lam


def test_small_strains_have_the_moduli_of_the_handbook(material, rng):
    """Hooke's law; sand and snow under enough pressure to hold, and the fluid by its volume alone."""
    if isinstance(material, Mixture):
        pytest.skip("its parts are tested")
    mu, lam = small_strain_moduli(material)
    strain = 1e-7 * random(rng, 6, 3, 3)
    strain = strain + strain.mT
    strain = strain - (strain.diagonal(dim1=1, dim2=2).mean(1) + 2e-6)[:, None, None] * ONE
    (tau,), _, _ = walk(material, torch.zeros_like(strain), [strain], dt=1e-12)
    trace = strain.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    expected = 2 * mu * strain + lam * trace * ONE
    if isinstance(material, Newtonian):
        tau, expected = tau.diagonal(dim1=1, dim2=2).sum(1), 3 * material.example["bulk_modulus"] * trace[:, 0, 0]
    # the next order of strain, which bulk moduli of thirty shear moduli make 1e-4 of the shear
    torch.testing.assert_close(tau, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_stress_grows_with_all_that_has_its_unit(material, rng):
    """k times as stiff, k times the stress: by name what is a modulus, a viscosity, a stress at yield. So what is k
    times as heavy and is pushed k times as hard moves alike. In float64 to round-off, which iterations stop above."""
    walked = []
    increments = 0.02 * random(rng, 6, 5, 3, 3)
    for k in (1.0, 3.7):
        values = {n: torch.tensor(v * (k if is_stiff(n) else 1.0)).double() for n, v in material.example.items()}
        c = material.coefficients(placed(material, values, 5)).expand(-1, 5).contiguous()
        H, memory, stress = torch.zeros(5, 3, 3).double(), material.initial_memory(5, torch.float64), []
        for M in increments:
            H, tau, memory = advance(material, 0.01, M / 0.01, H, c, memory)
            stress.append(tau / k)
        walked.append(torch.stack(stress))
    torch.testing.assert_close(walked[1], walked[0], rtol=1e-7, atol=1e-9 * float(walked[0].abs().max()))


def test_a_stretch_before_anything_flows_grows_with_all_that_is_elastic(material, rng):
    """What the search over the stiffness and a field of stiffness multiply: by name moduli, those of further branches,
    and the coefficients of a series. Large stretches where nothing yields, and so fast that no dash-pot moves."""
    if any(name.endswith("viscosity") for name in material.parameters):
        pytest.skip("a fluid resists by its viscosity")
    H = (0.2 if material.recovers else 1e-6) * random(rng, 5, 3, 3)
    told = []
    for k in (1.0, 3.7):
        values = {n: torch.tensor(v * (k if is_elastic(n) else 1.0)).double() for n, v in material.example.items()}
        c = material.coefficients(placed(material, values, 5)).expand(-1, 5).contiguous()
        memory = material.initial_memory(5, torch.float64)
        told.append(advance(material, 1e-12, H / 1e-12, torch.zeros_like(H), c, memory)[1] / k)
    torch.testing.assert_close(told[1], told[0], rtol=1e-6, atol=1e-8 * float(told[0].abs().max()))


def test_no_energy_from_nothing(material, rng):
    """Work done on the body is never less than the energy it has gained."""
    n, steps, dt = 8, 400, 0.002
    phase = torch.linspace(0, 4 * math.pi, steps, dtype=torch.float64)
    A, B = 0.006 * random(rng, 2, n, 3, 3)
    c, H = coefficients(material, n), torch.zeros(n, 3, 3, dtype=torch.float64)
    memory, work, scale = material.initial_memory(n, torch.float64), torch.zeros(n), torch.zeros(n)
    _, before, _ = advance(material, 0.0, H, H, c, memory)
    for angle in phase:
        M = A * angle.sin() + B * (0.7 * angle).sin()  # starts gently: no large first step
        H, tau, memory = advance(material, dt, M / dt, H, c, memory)
        log_increment = M - M @ M / 2 + M @ M @ M / 3
        done = (0.5 * (tau + before) * log_increment).sum((1, 2))
        work, scale, before = work + done, scale + done.abs(), tau
        # 1 %: trapezoidal rule with 400 steps
        assert (work - material.energy(c, H, memory) >= -0.01 * scale).all()


def test_adjoint_is_the_derivative(material, rng):
    H, memory = states(material, rng)
    n = len(H)
    inputs = [0.5 * random(rng, n, 3, 3), H, coefficients(material, n), memory]
    scales = [torch.ones_like(H), torch.ones_like(H), inputs[2], torch.ones_like(memory)]
    unit = stiffness(material)
    weights = [random(rng, n, 3, 3), random(rng, n, 3, 3) / unit, random(rng, *memory.shape)]

    def functional(inputs):
        # no relaxation time of the samples: longer steps store the strain in another form
        H_next, tau, memory_next = advance(material, 0.04, *inputs)
        terms = (weights[0] * H_next).sum((1, 2)), (weights[1] * tau).sum((1, 2)), (weights[2] * memory_next).sum(0)
        return sum(terms)

    leaves = [x.clone().requires_grad_() for x in inputs]
    gradients = torch.autograd.grad(functional(leaves).sum(), leaves)
    for i, (gradient, scale) in enumerate(zip(gradients, scales, strict=True)):
        assert torch.isfinite(gradient).all()
        direction = scale * random(rng, *scale.shape)
        exact = gradient * direction
        exact = exact.sum((1, 2)) if i < 2 else exact.sum(0)

        def shifted(t, i=i, direction=direction):
            return functional([x + t * direction if j == i else x for j, x in enumerate(inputs)])

        wide, narrow = (
            (8 * (shifted(h) - shifted(-h)) - (shifted(2 * h) - shifted(-2 * h))) / (12 * h) for h in (1e-4, 1e-6)
        )
        # where they disagree, yielding begins or ends within the wider one
        slope = torch.where((wide - narrow).abs() < 1e-5 * (1 + narrow.abs()), wide, narrow)
        # fourth-order differences: h^4 times fifth derivatives, and round-off 1e-16/h; functionals are of order one
        torch.testing.assert_close(exact, slope, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_extreme_deformation_stays_finite(material, dtype, rng):
    extreme = [
        -0.99 * ONE,
        -ONE,
        -2 * ONE,
        torch.diag(torch.tensor([19.0, -0.99, 0.0])),
        torch.diag(torch.tensor([0.0, 0.0, -1.5])),
        torch.diag(torch.tensor([0.0, -0.3, -1.7])),
        torch.diag(torch.tensor([19.0, 19.0, 19.0])),
        torch.full((3, 3), 5.0),
        torch.tensor([[0.0, 50.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    ]
    M = torch.stack([x.double() for x in extreme]).to(dtype)
    M = torch.cat([M, (random_rotation(rng, len(M)).to(dtype) @ (ONE.to(dtype) + M)) - ONE.to(dtype)])
    for dt in (1e-7, 1.0, 1e6):
        leaves = [M / dt, torch.zeros_like(M), coefficients(material, len(M), dtype)]
        leaves = [x.clone().requires_grad_() for x in leaves]
        memory = material.initial_memory(len(M), dtype)
        results = advance(material, dt, *leaves, memory)
        again = advance(material, dt, 0.01 * leaves[0], results[0], leaves[2], results[2])
        unit = stiffness(material)
        loss = sum(x.sum() for x in (results[0], again[0], results[1] / unit, again[1] / unit, results[2], again[2]))
        for x in (*results, *again, *torch.autograd.grad(loss, leaves)):
            assert torch.isfinite(x).all()


def test_float32_follows_float64_in_a_stiff_body(material, rng):
    """A thousand steps of 1e-10 strain in a body of 1e9 Pa: float32 keeps nothing of 1 + 1e-10, nor of 1 + 1e-7."""
    A = torch.tensor([[[-1.0, 0.4, 0.1], [0.2, -0.7, 0.0], [0.3, -0.2, -0.9]]], dtype=torch.float64) * 1e-10
    values = {k: torch.tensor(v * 1e9 / 1e5 if k.endswith("modulus") else v) for k, v in material.example.items()}
    stress = {}
    for dtype in (torch.float32, torch.float64):
        c, H = material.coefficients(placed(material, values, 1)).to(dtype), torch.zeros(1, 3, 3, dtype=dtype)
        memory = material.initial_memory(1, dtype)
        for _ in range(1000):
            H, tau, memory = advance(material, 1e-6, (A / 1e-6).to(dtype), H, c, memory)
        stress[dtype] = tau.double()
    error = (stress[torch.float32] - stress[torch.float64]).abs().max() / stress[torch.float64].abs().max()
    assert error < 0.01  # as docs/method.md says, section 2; with b formed from 1 + H it is 0.05, with F stored 1


def test_parameters_out_of_range_are_named(material):
    good = {name: torch.tensor(value) for name, value in material.example.items()}
    assert set(good) == set(material.parameters)
    bad = [(name, math.nan) for name in good]
    bad += [(name, -1.0) for name in good if name.endswith(("modulus", "viscosity", "time"))]
    bad += [("poissons_ratio", value) for value in (0.5, -1.0) if "poissons_ratio" in good]
    for name, value in bad:
        with pytest.raises(ValueError, match=name):
            material.coefficients(good | {name: torch.tensor(value)})
    with pytest.raises(ValueError, match="unknown"):
        material.coefficients(good | {"colour": torch.tensor(1.0)})
    with pytest.raises(ValueError, match="missing"):
        material.coefficients({})


def test_coefficients_carry_gradients_and_broadcast(material):
    values = {name: torch.tensor(value).requires_grad_() for name, value in material.example.items()}
    first = material.parameters[0]
    values[first] = (values[first].detach() * torch.ones(5)).requires_grad_()
    rows = material.coefficients(placed(material, values, 5))
    assert rows.shape[1] == 5
    rows.sum().backward()
    assert all(torch.isfinite(v.grad).all() for v in values.values())
    assert material.wave_modulus(rows).shape == (5,)
    assert (material.wave_modulus(rows) > 0).all()
