"""Many laboratory tests in one launch: what the machine prescribes in, what it measures out, exact derivatives.

    tension    F = diag(a, b, b), sides free of traction: tau_22 = 0
    shear      x = X + g Y
    prescribed: the stretch a, the shear g, or a stress: nominal tau_11/a, true tau_11/J, in shear tau_12     [Pa]

One row of a table is one step of the model, F_next = (I + M) F, as in `driver.py`, which is the plain twin of this.
What is not prescribed (b, a, g) is found in the kernel, row by row, by a secant in a bracket, to rounding; a load that
is prescribed is borne by every row.

Derivatives with respect to the coefficients c are carried forward. With z the state, u what was found and g(z, u, c) =
0 the conditions that it meets, a step z' = f(z, u, c) gives

    du = -g_u^-1 (g_z dz + g_c dc),   dz' = f_z dz + f_u du + f_c dc

The partial derivatives are those of a single step, by its exact adjoint, of all rows and all tests at once; what is
left to do one after another is a product of small matrices per row. Cost: that of the rows.
"""

import functools
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.material_points import advance
from physics3d.warp_start import start_warp
from physics3d.warp_types import matrix

STRETCH, NOMINAL, TRUE, SHEAR, SHEAR_STRESS = range(5)  # what is prescribed
REAL = torch.float64


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """What machines do to s specimens in t rows; shorter tests are filled up with rows that are not counted."""

    prescribes: Int[Tensor, " s"]  # STRETCH, NOMINAL, TRUE, SHEAR or SHEAR_STRESS
    rows: Int[Tensor, " s"]  # number of rows, the first of which is at rest
    dt: Float[Tensor, "t s"]  # length of the step that ends at a row [s]; that of the first is not read
    given: Float[Tensor, "t s"]  # stretch, shear, or stress [Pa] at the end of the step


@dataclass(frozen=True, kw_only=True)
class Histories:
    """What became of the specimens; rows behind the last of a test hold nothing of use."""

    stretch: Float[Tensor, "t s"]  # a
    side: Float[Tensor, "t s"]  # b
    shear: Float[Tensor, "t s"]  # g
    tau: Float[Tensor, "t s 3 3"]  # Kirchhoff stress [Pa]
    lost: Bool[
        Tensor, " s"
    ]  # no deformation was found that meets the conditions; from there on the rest is not computed
    increment: Float[Tensor, "t s 3 3"]  # M of the step that ends at a row
    H: Float[Tensor, "t s 3 3"]  # F - I
    memory: Float[Tensor, "t m s"]

    @property
    def nominal(self) -> Float[Tensor, "t s"]:
        """tau_11/a [Pa]."""
        return self.tau[..., 0, 0] / self.stretch

    @property
    def true(self) -> Float[Tensor, "t s"]:
        """tau_11/J [Pa]."""
        return self.tau[..., 0, 0] / (self.stretch * self.side**2)


def histories(material: AbstractMaterial, coefficients: Float[Tensor, "k s"], schedule: Schedule) -> Histories:
    """Run all tests, each on a specimen with its column of coefficients, in float64 on the CPU."""
    start_warp()
    t, s = schedule.given.shape
    memory = torch.zeros((t, max(material.memory_rows, 1), s), dtype=REAL)
    memory[0, : material.memory_rows] = material.initial_memory(s, REAL)
    H, M, tau = (torch.zeros((t, s, 3, 3), dtype=REAL) for _ in range(3))
    lost = torch.zeros(s, dtype=torch.int32)
    columns = coefficients.detach().to(REAL).contiguous()
    mat33 = matrix(wp.float64)
    as_matrices = [wp.from_torch(x, dtype=mat33) for x in (H, M, tau)]
    numbers = (schedule.dt, schedule.given, columns)
    wp.launch(
        _kernel(material.advance(wp.float64)),
        s,
        inputs=[
            *(wp.from_torch(x.to(torch.int32).contiguous()) for x in (schedule.prescribes, schedule.rows)),
            *(wp.from_torch(x.to(REAL).contiguous()) for x in numbers),
            wp.from_torch(material.wave_modulus(columns).contiguous()),
        ],
        outputs=[*as_matrices, *(wp.from_torch(x) for x in (memory, lost))],
        device="cpu",
    )
    return Histories(
        stretch=1 + H[..., 0, 0],
        side=1 + H[..., 1, 1],
        shear=H[..., 0, 1],
        tau=tau,
        lost=lost > 0,
        increment=M,
        H=H,
        memory=memory[:, : material.memory_rows],
    )


def sensitivities(
    material: AbstractMaterial, coefficients: Float[Tensor, "k s"], schedule: Schedule, done: Histories
) -> Float[Tensor, "t s 6 k"]:
    """d(a, b, g, tau_11, tau_22, tau_12)/dc of the tests in `done`; zero in the first row."""
    t, s = schedule.given.shape
    k, m = len(coefficients), material.memory_rows
    steps = (t - 1) * s
    state = torch.zeros((t, s, 3 + m, k), dtype=REAL)
    out = torch.zeros((t, s, 6, k), dtype=REAL)
    if not steps:
        return out
    H, M = done.H[:-1], done.increment[1:]
    local = _local(material, coefficients.detach().to(REAL), schedule, done)  # [t-1, s, 3 + m, 3 + 3 + m + k]
    by_u, by_z, by_c = local[..., :3], local[..., 3 : 6 + m], local[..., 6 + m :]

    # H' = H + M + M H in the coordinates a, b, g; (1 + M) and (1 + H) are diagonal but for the shear
    one_M = 1 + torch.stack([M[..., 0, 0], M[..., 1, 1], torch.zeros_like(M[..., 0, 0])], -1)
    one_H = 1 + torch.stack([H[..., 0, 0], H[..., 1, 1], torch.zeros_like(H[..., 0, 0])], -1)
    f_z = torch.zeros((t - 1, s, 3 + m, 3 + m), dtype=REAL)
    f_u = torch.zeros((t - 1, s, 3 + m, 3), dtype=REAL)
    f_c = torch.zeros((t - 1, s, 3 + m, k), dtype=REAL)
    f_z[..., :3, :3], f_u[..., :3, :] = torch.diag_embed(one_M), torch.diag_embed(one_H)
    f_z[..., 3:, :], f_u[..., 3:, :], f_c[..., 3:, :] = by_z[..., 3:, :], by_u[..., 3:, :], by_c[..., 3:, :]

    # conditions: rows of d(tau_11, tau_22, tau_12) and of what is prescribed
    a, b = (1 + done.H[1:, :, i, i] for i in (0, 1))
    tau_11 = done.tau[1:, :, 0, 0]
    mode = schedule.prescribes.expand(t - 1, s)
    tension, loaded = mode <= TRUE, (mode == NOMINAL) | (mode == TRUE)
    unit = torch.eye(3, dtype=REAL)

    def conditions(tau: Tensor, z: Tensor) -> Tensor:
        """Three rows: of u_a, u_b and u_g; z is the derivative of a, b, g at the end of the step."""
        axial = tau[..., 0, :] - (tau_11 / a)[..., None] * z[..., 0, :]
        axial = axial - torch.where(mode == TRUE, 2 * tau_11 / b, 0.0)[..., None] * z[..., 1, :]
        first = torch.where(loaded[..., None], axial, 0.0)
        second = torch.where(tension[..., None], tau[..., 1, :], 0.0)
        third = torch.where((mode == SHEAR_STRESS)[..., None], tau[..., 2, :], 0.0)
        return torch.stack([first, second, third], -2)

    g_u = conditions(by_u[..., :3, :], f_u)
    # what is prescribed does not move: its condition is u = 0
    free = torch.stack([loaded, tension, mode == SHEAR_STRESS], -1)
    scale = material.wave_modulus(coefficients.detach().to(REAL)).expand(s)[:, None, None]
    g_u = torch.where(free[..., None], g_u, scale * unit)
    counted = torch.arange(1, t)[:, None] < schedule.rows
    counted &= ~done.lost
    g_u = torch.where(counted[..., None, None], g_u, scale * unit)
    g_z, g_c = conditions(by_z[..., :3, :], f_z), conditions(by_c[..., :3, :], f_c)
    u_z, u_c = -torch.linalg.solve(g_u, g_z), -torch.linalg.solve(g_u, g_c)
    T, Q = f_z + f_u @ u_z, f_c + f_u @ u_c
    for at, T_r, Q_r, after in zip(state.numpy(), T.numpy(), Q.numpy(), state[1:].numpy()):
        np.matmul(T_r, at, out=after)  # small matrices: NumPy has less to do around them than torch
        after += Q_r
    tau_z, tau_c = by_z[..., :3, :] + by_u[..., :3, :] @ u_z, by_c[..., :3, :] + by_u[..., :3, :] @ u_c
    out[1:, :, :3] = state[1:, :, :3]
    out[1:, :, 3:] = tau_z @ state[:-1] + tau_c
    out[1:] = torch.where(counted[..., None, None], out[1:], 0.0)
    return out


def _local(
    material: AbstractMaterial, coefficients: Float[Tensor, "k s"], schedule: Schedule, done: Histories
) -> Float[Tensor, "steps s outputs inputs"]:
    """Partial derivatives of every single step: outputs tau_11, tau_22, tau_12 and the memory; inputs the increments
    (M_11; M_22 and M_33; M_12), the same of H, the memory and the coefficients."""
    t, s = schedule.given.shape
    k, m = len(coefficients), material.memory_rows
    outputs, n = 3 + m, (t - 1) * s
    # steps that are not counted are harmless ones
    dt = torch.where(torch.arange(1, t)[:, None] < schedule.rows, schedule.dt[1:].to(REAL), 1.0).reshape(n)

    def copies(x: Tensor) -> Tensor:
        """[n, ...] -> [outputs n, ...], a leaf of its own."""
        return x.expand(outputs, *x.shape).reshape(-1, *x.shape[1:]).clone().requires_grad_()

    M, H = copies(done.increment[1:].reshape(n, 3, 3)), copies(done.H[:-1].reshape(n, 3, 3))
    memory = copies(done.memory[:-1].transpose(1, 2).reshape(n, m))
    c = copies(coefficients.expand(k, s).T.expand(t - 1, s, k).reshape(n, k))
    every = dt.repeat(outputs)
    with torch.enable_grad():
        _, tau, memory_next = advance(material, every, M / every[:, None, None], H, c.T, memory.T)
        found = torch.cat([tau[:, [0, 1, 0], [0, 1, 1]], memory_next.T], 1).reshape(outputs, n, outputs)
        adjoint = torch.autograd.grad(found.diagonal(dim1=0, dim2=2).sum(), (M, H, memory, c))
    dM, dH, dmemory, dc = adjoint

    def coordinates(d: Tensor) -> Tensor:
        return torch.stack([d[:, 0, 0], d[:, 1, 1] + d[:, 2, 2], d[:, 0, 1]], -1)

    rows = torch.cat([coordinates(dM), coordinates(dH), dmemory, dc], 1)
    return rows.reshape(outputs, t - 1, s, -1).permute(1, 2, 0, 3)


@functools.cache
def _kernel(function: wp.Function) -> wp.Kernel:
    real, mat33 = wp.float64, matrix(wp.float64)

    @wp.func
    def increment(mode: int, axial: real, side: real):
        M = mat33()
        if mode >= wp.static(SHEAR):
            M[0, 1] = axial
        else:
            M[0, 0] = axial
            M[1, 1] = side
            M[2, 2] = side
        return M

    @wp.func
    def converged(tried: int, slope: real, size: real, miss: real, scale: real):
        """As near as increments are known, or as rounding of the parts of the stress lets it come."""
        loose = real(1e-15)
        if tried > 8:
            loose = real(1e-12)
        if tried > 40:
            loose = real(1e-11)
        near = wp.abs(miss) <= loose * scale
        if slope > real(0.0):
            near = near or wp.abs(miss) <= real(2e-16) * size * slope
        return near

    @wp.func
    def next_guess(x: real, miss: real, slope: real, lower: real, upper: real):
        """Along the slope, or the middle of the bracket where that leads out of it."""
        result = (lower + upper) / real(2.0)
        if slope > real(0.0):
            newton = x - miss / slope
            if newton > lower and newton < upper:
                result = newton
        return result

    @wp.func
    def free_side(
        p: int, r: int, mode: int, dt: real, axial: real, guess: real, scale: real,
        coefficients: wp.array2d(dtype=real), H: wp.array2d(dtype=mat33), memory: wp.array3d(dtype=real),
    ):  # fmt: skip
        """(side, H and tau there, whether it is free); the memory of row r is that there. Nothing is sought in
        shear."""
        # a number given to another name is the same variable in Warp; real(x) is a copy of it
        side, before, miss_before, slope = real(guess), real(guess), real(0.0), real(scale)
        lower, upper = real(-0.9), real(2.0)
        found = int(0)  # noqa: UP018, RUF046 -- a variable, to Warp
        H_next, tau = mat33(), mat33()
        for tried in range(80):
            if found == 0:
                M = increment(mode, axial, side)
                H_tried, tau_tried = function(p, dt, M / dt, H[r - 1, p], coefficients, memory[r - 1], memory[r])
                H_next, tau = H_tried, tau_tried
                miss = tau[1, 1]
                if mode >= wp.static(SHEAR):
                    miss = real(0.0)
                # of steps that rounding does not drown
                if wp.abs(side - before) > real(1e-7) * wp.max(wp.abs(side), wp.abs(axial)):
                    slope = (miss - miss_before) / (side - before)
                if converged(tried, slope, wp.max(wp.abs(side), wp.abs(axial)), miss, scale):
                    found = 1
                else:
                    if miss < real(0.0):
                        lower = real(side)
                    else:
                        upper = real(side)
                    before = real(side)
                    miss_before = real(miss)
                    side = next_guess(side, miss, slope, lower, upper)
        return side, H_next, tau, found

    @wp.kernel(module="unique", enable_backward=False)
    def march(
        # in
        prescribes: wp.array(dtype=int),  # [s]
        rows: wp.array(dtype=int),  # [s]
        dt: wp.array2d(dtype=real),  # [t, s] [s]
        given: wp.array2d(dtype=real),  # [t, s] 1 or Pa
        coefficients: wp.array2d(dtype=real),  # [k, s] of the material
        stiffness: wp.array(dtype=real),  # [s] wave modulus [Pa]
        # out
        H: wp.array2d(dtype=mat33),  # [t, s] F - I
        increments: wp.array2d(dtype=mat33),  # [t, s]
        stress: wp.array2d(dtype=mat33),  # [t, s] [Pa]
        memory: wp.array3d(dtype=real),  # [t, m, s]
        lost: wp.array(dtype=int),  # [s] row at which nothing was found, 0: none
    ):
        p = wp.tid()
        mode, scale = prescribes[p], stiffness[p]
        loaded = mode == wp.static(NOMINAL) or mode == wp.static(TRUE) or mode == wp.static(SHEAR_STRESS)
        for r in range(1, rows[p]):
            if lost[p] == 0:
                H_r = H[r - 1, p]
                a, b = real(1.0) + H_r[0, 0], real(1.0) + H_r[1, 1]
                axial, side = real(0.0), real(0.0)
                if mode == wp.static(SHEAR):
                    axial = given[r, p] - H_r[0, 1]
                elif mode == wp.static(STRETCH):
                    axial = given[r, p] / a - real(1.0)
                before, miss_before, slope = real(0.0), real(0.0), scale / real(3.0)
                lower, upper = real(-0.9), real(10.0)
                if mode == wp.static(SHEAR_STRESS):
                    lower = real(-10.0)
                H_next, tau = mat33(), mat33()
                found = int(0)  # noqa: UP018, RUF046 -- a variable, to Warp
                for tried in range(80):
                    if found == 0:
                        side_tried, H_tried, tau_tried, freed = free_side(
                            p, r, mode, dt[r, p], axial, side, scale, coefficients, H, memory
                        )
                        side, H_next, tau = side_tried, H_tried, tau_tried
                        miss = real(0.0)
                        if loaded:
                            borne = tau[0, 1]
                            if mode != wp.static(SHEAR_STRESS):
                                borne = tau[0, 0] / (a * (real(1.0) + axial))
                            if mode == wp.static(TRUE):
                                borne = borne / (b * b * (real(1.0) + side) * (real(1.0) + side))
                            miss = borne - given[r, p]
                        if wp.abs(axial - before) > real(1e-7) * wp.abs(axial):
                            slope = (miss - miss_before) / (axial - before)
                        if freed == 1 and (not loaded or converged(tried, slope, wp.abs(axial), miss, scale)):
                            found = 1
                        else:
                            if miss < real(0.0):
                                lower = real(axial)
                            else:
                                upper = real(axial)
                            before = real(axial)
                            miss_before = real(miss)
                            axial = next_guess(axial, miss, slope, lower, upper)
                            if not loaded:
                                found = -1  # nothing else can be tried
                if found == 1:
                    H[r, p] = H_next
                    stress[r, p] = tau
                    increments[r, p] = increment(mode, axial, side)
                else:
                    lost[p] = r

    return march
