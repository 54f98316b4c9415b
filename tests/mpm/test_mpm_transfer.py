"""The transfers conserve what they must, reproduce linear fields, and agree with a plain dense version in torch."""

import numpy as np
import pytest
import torch
import warp as wp

from physics3d.mpm import transfer
from physics3d.mpm.columns import SPARE
from physics3d.warp_start import start_warp
from physics3d.warp_types import matrix, vector, vector4

DX, DT, SIDE, N = 0.1, 1e-3, 9, 40
WINDOW = (-2, -2, -2, SIDE, SIDE, SIDE)


def particles(dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    state = dict(u=0.03 * random(N, 3), v=random(N, 3), L=random(N, 3, 3), tau=1e3 * random(N, 3, 3))
    cell = torch.randint(0, 4, (N, 3), generator=generator, dtype=torch.int32)
    offset = torch.rand(N, 3, generator=generator, dtype=torch.float64).to(dtype)
    mass = torch.rand(N, generator=generator, dtype=torch.float64).to(dtype) + 0.1
    return state | dict(cell=cell, offset=offset, mass=mass, volume=1e-3 * mass)


def shape_functions(p):
    """Dense weights [p, node] and lever arms x_i - x_p [p, node, 3] over all nodes of the window."""
    axis = torch.arange(SIDE, dtype=torch.float64) + WINDOW[0]
    nodes = torch.cartesian_prod(axis, axis, axis)
    r = nodes - (p["cell"] + p["offset"] + p["u"] / DX)[:, None]
    a = r.abs()
    w = torch.where(a < 0.5, 0.75 - r**2, torch.where(a < 1.5, 0.5 * (1.5 - a) ** 2, 0.0)).prod(2)
    return w, r * DX


def scatter_dense(p):
    w, r = shape_functions(p)
    A = p["mass"][:, None, None] * p["L"] - DT * p["volume"][:, None, None] * 4 / DX**2 * p["tau"]
    momentum = p["mass"][:, None, None] * p["v"][:, None] + torch.einsum("pab,pnb->pna", A, r)
    return torch.cat([torch.einsum("pn,pna->na", w, momentum), (w * p["mass"][:, None]).sum(0)[:, None]], 1)


def gather_dense(p, node_velocity):
    w, r = shape_functions(p)
    return w @ node_velocity, 4 / DX**2 * torch.einsum("pn,na,pnb->pab", w, node_velocity, r)


def array(value, dtype):
    return wp.from_torch(value.contiguous(), dtype=dtype)


def padded(nodes):
    """With as much behind them as the fast forms read, whatever it is."""
    return torch.cat([nodes, torch.full((SPARE, nodes.shape[1]), float("nan"), dtype=nodes.dtype)])


def window():
    return wp.array(np.array(WINDOW, np.int32), dtype=wp.int32, device="cpu")


def scatter(p, adjoint=None, fast=False):
    """grid [node, 4], lost; or with the adjoint of the grid: adjoints of u, v, L, tau, mass, volume."""
    start_warp()
    real = wp.float64 if p["u"].dtype == torch.float64 else wp.float32
    vec3, vec4, mat33 = vector(real), vector4(real), matrix(real)
    # nodes add up in double precision
    grid, lost = wp.zeros(SIDE**3, dtype=wp.vec4d, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    clock = wp.array(np.array([[0.0, 1.0, DT]]), dtype=real, device="cpu")
    inputs = [0, DX, window(), clock, wp.zeros(1, dtype=int, device="cpu")]
    inputs += [array(p["mass"], real), array(p["volume"], real), array(p["cell"], wp.vec3i), array(p["offset"], vec3)]
    inputs += [array(p["u"], vec3), array(p["v"], vec3), array(p["L"], mat33), array(p["tau"], mat33)]
    if adjoint is None:
        wp.launch(transfer.scatter(real, wp.float64, fast), N, inputs=inputs, outputs=[grid, lost], device="cpu")
        return wp.to_torch(grid), int(lost.numpy()[0])
    offset, *found = [wp.zeros_like(value) for value in (*inputs[-5:], *inputs[5:7])]
    inputs.append(array(padded(adjoint), vec4))
    wp.launch(transfer.scatter_adjoint(real, fast), N, inputs=inputs, outputs=[offset, *found], device="cpu")
    torch.testing.assert_close(wp.to_torch(offset), wp.to_torch(found[0]) * DX)  # x in cells is offset + u/dx
    return [wp.to_torch(value) for value in found]


def gather(p, node_velocity, adjoint=None, fast=False):
    """v [p, 3], L [p, 3, 3]; or with their adjoints: adjoints of u and of the node velocities."""
    start_warp()
    real = wp.float64
    vec3, mat33 = vector(real), matrix(real)
    inputs = [0, DX, window(), array(p["cell"], wp.vec3i), array(p["offset"], vec3), array(p["u"], vec3)]
    inputs += [array(padded(node_velocity), vec3)]
    outputs = [wp.zeros(N, dtype=vec3, device="cpu"), wp.zeros(N, dtype=mat33, device="cpu")]
    if adjoint is None:
        wp.launch(transfer.gather(real, fast), N, inputs=inputs, outputs=outputs, device="cpu")
        return [wp.to_torch(value) for value in outputs]
    offset, found_u = [wp.zeros_like(value) for value in inputs[-3:-1]]
    onto = padded(torch.zeros(SIDE**3, 4 if fast else 3, dtype=torch.float64))
    found = [found_u, array(onto, vector4(real) if fast else vec3)]
    inputs += [array(adjoint[0], vec3), array(adjoint[1], mat33)]
    wp.launch(transfer.gather_adjoint(real, fast), N, inputs=inputs, outputs=[offset, *found], device="cpu")
    torch.testing.assert_close(wp.to_torch(offset), wp.to_torch(found[0]) * DX)
    return [wp.to_torch(found[0]), wp.to_torch(found[1])[: SIDE**3, :3]]


@pytest.mark.parametrize("fast", [False, True])
def test_scatter_agrees_with_its_dense_twin_forwards_and_backwards(fast):
    p = particles()
    grid, lost = scatter(p, fast=fast)
    assert lost == 0
    torch.testing.assert_close(grid, scatter_dense(p), atol=1e-11, rtol=1e-11)
    p["volume"] = p["volume"].clone()
    leaves = [p[name].requires_grad_() for name in ("u", "v", "L", "tau", "mass", "volume")]
    adjoint = torch.randn(grid.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = torch.autograd.grad((scatter_dense(p) * adjoint).sum(), leaves)
    detached = {name: value.detach() for name, value in p.items()}
    for found, gradient in zip(scatter(detached, adjoint, fast), expected):
        torch.testing.assert_close(found, gradient, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("fast", [False, True])
def test_gather_agrees_with_its_dense_twin_forwards_and_backwards(fast):
    p = particles()
    generator = torch.Generator().manual_seed(1)
    node_velocity = torch.randn(SIDE**3, 3, generator=generator, dtype=torch.float64)
    for found, expected in zip(gather(p, node_velocity, fast=fast), gather_dense(p, node_velocity)):
        torch.testing.assert_close(found, expected, atol=1e-11, rtol=1e-11)
    leaves = [p["u"].requires_grad_(), node_velocity.requires_grad_()]
    adjoint = [torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((N, 3), (N, 3, 3))]
    total = sum((value * a).sum() for value, a in zip(gather_dense(p, node_velocity), adjoint))
    expected = torch.autograd.grad(total, leaves)
    detached = {name: value.detach() for name, value in p.items()}
    for found, gradient in zip(gather(detached, node_velocity.detach(), adjoint, fast), expected):
        torch.testing.assert_close(found, gradient, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_scatter_conserves_mass_linear_and_angular_momentum(dtype, tolerance):
    p = particles(dtype)
    p["tau"] = p["tau"] + p["tau"].mT  # a Kirchhoff stress is symmetric, only then is there no torque
    p["tau"] *= 1e-3 if dtype == torch.float32 else 1.0
    grid, _ = scatter(p)
    grid = grid.double()
    p = {name: value.double() for name, value in p.items()}
    axis = torch.arange(SIDE, dtype=torch.float64) + WINDOW[0]
    nodes = torch.cartesian_prod(axis, axis, axis) * DX
    x = (p["cell"] + p["offset"]) * DX + p["u"]
    momentum = p["mass"][:, None] * p["v"]
    # affine part: sum_i w (x_i - x_p) x (L (x_i - x_p)) = dx^2/4 times twice the axial vector of L
    L = p["L"]
    axial = torch.stack([L[:, 2, 1] - L[:, 1, 2], L[:, 0, 2] - L[:, 2, 0], L[:, 1, 0] - L[:, 0, 1]], 1)
    spin = torch.linalg.cross(x, momentum) + p["mass"][:, None] * DX**2 / 4 * axial
    for found, expected in (
        (grid[:, 3].sum(), p["mass"].sum()),
        (grid[:, :3].sum(0), momentum.sum(0)),
        (torch.linalg.cross(nodes, grid[:, :3]).sum(0), spin.sum(0)),
    ):
        torch.testing.assert_close(found, expected, atol=tolerance * 40, rtol=tolerance)


def test_gather_is_exact_for_linear_velocity_fields():
    p = particles()
    A = torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    axis = torch.arange(SIDE, dtype=torch.float64) + WINDOW[0]
    v, L = gather(p, torch.cartesian_prod(axis, axis, axis) * DX @ A.T + 0.3)
    x = (p["cell"] + p["offset"]) * DX + p["u"]
    torch.testing.assert_close(v, x @ A.T + 0.3, atol=1e-12, rtol=0)
    torch.testing.assert_close(L, A.expand(N, 3, 3), atol=1e-11, rtol=0)


@pytest.mark.parametrize("where", [100.0, -100.0, 5.6, -1.6, float("nan")])
def test_a_particle_outside_the_window_is_counted_and_writes_nothing(where):
    p = particles()
    p["offset"][7], p["cell"][7], p["u"][7] = torch.tensor((0.5, 0.5, where)), 0, 0.0
    grid, lost = scatter(p)
    assert lost == 1
    assert float(grid[:, 3].sum()) == pytest.approx(float(p["mass"].sum() - p["mass"][7]), rel=1e-12)
