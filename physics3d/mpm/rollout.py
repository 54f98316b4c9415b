"""A whole trajectory as one differentiable function: the only place where torch meets the MPM solver.

    rollout(world, parameters, position, volume, ...) -> Trajectory

`limits` says how long a substep is and which scheme is taken, `frames` goes from frame to frame and back.
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.log import Log
from physics3d.mpm.frames import Frames
from physics3d.mpm.problem import Problem, check_inputs, region, sorted_by_cell
from physics3d.mpm.velocity_gradient import velocity_gradient
from physics3d.trajectory import Trajectory
from physics3d.warp_start import start_warp
from physics3d.world import World


def rollout(
    world: World,
    parameters: dict[str, Tensor],
    position: Float[Tensor, "p 3"],
    volume: Float[Tensor, " p"],
    *,
    velocity: Float[Tensor, "p 3"] | Float[Tensor, "3"] | None = None,
    excitation: tuple[AbstractBoundary, ...] = (),
    frames: int,
    frame_dt: float,
    device: str = "cpu",
    threads: int | None = None,
    log: Log,
) -> Trajectory:
    """Simulate `frames` frames, frame 0 being the initial state, frame_dt [s] apart.

    `position` [m] at rest, `volume` [m^3] at rest, `velocity` [m/s] at the start (None: at rest), `parameters` SI, each
    a scalar or one number per particle. The trajectory is differentiable with respect to parameters, velocity, position
    and the forces of boundaries where these are tensors that require it. `threads` (CPU only): None takes as many cores
    as there are particles to fill. Raises ValueError naming the field, the value and the remedy."""
    world.check()
    boundaries = (*world.boundaries, *excitation)
    check_inputs(position, volume, velocity, boundaries, frames, frame_dt)
    n, dtype = len(position), world.dtype
    if velocity is None:
        velocity = torch.zeros(3)
    lower, upper = region(world, position, velocity, frame_dt * (frames - 1))
    rest_volume = volume.detach().double().cpu()
    mass = world.density * rest_volume
    setting = Setting(
        position=position.detach().double().cpu(), mass=mass, volume=rest_volume, lower=lower, upper=upper, dx=world.dx
    )

    if velocity.ndim == 1:
        gradient = torch.zeros(n, 3, 3)
    else:
        x, v = position.double(), velocity.double().to(position.device)
        gradient = velocity_gradient(x / world.dx, v, mass.to(x.device)) / world.dx

    order = sorted_by_cell(setting.position, world.dx).to(device)
    back = torch.argsort(order)

    def place(value: Tensor) -> Tensor:
        return value.to(device=device, dtype=dtype)

    coefficients = world.material.coefficients({name: value.double().to(device) for name, value in parameters.items()})
    coefficients = place(coefficients.expand(len(coefficients), n)[:, order])
    # where a face lies, and how much of a particle a boundary selects, may depend on where particles are
    there = dataclasses.replace(setting, position=position.double().cpu())
    q = [boundary.parameters(there).to(torch.float64) for boundary in boundaries]
    selection = [boundary.selection(there) for boundary in boundaries]
    problem = Problem(
        world=world,
        setting=setting,
        boundaries=boundaries,
        widths=tuple(len(k) for k in q),
        order=order,
        frames=frames,
        frame_dt=frame_dt,
        device=device,
        threads=threads,
        log=log,
    )
    u, v, deformation, done = _Rollout.apply(
        coefficients,
        place(torch.cat(q)) if q else torch.zeros(0, dtype=dtype, device=device),
        place(velocity.to(device).expand(n, 3)[order]),
        place(gradient.to(device)[order]),
        position.to(device=device, dtype=torch.float64)[order],
        place(torch.stack(selection))[:, order] if selection else torch.zeros((0, n), dtype=dtype, device=device),
        problem,
    )
    rest = position.to(device=device, dtype=torch.float64)
    return Trajectory(
        rest_position=place(rest),
        position=place(rest + u[:, back].double()),
        velocity=v[:, back],
        deformation=deformation[:, back],
        fps=1.0 / frame_dt,
        health=done.health,
        substeps=max(done.counts, default=0),
        substep_dt=min((frame_dt / count for count in done.counts), default=frame_dt),
    )


class _Rollout(torch.autograd.Function):
    """(coefficients [k, p], q, velocity [p, 3], its gradient [p, 3, 3], position [p, 3], selection [boundary, p]) ->
    displacement and velocity [t, p, 3], deformation [t, p, 3, 3], and the frames as they were done."""

    @staticmethod
    def forward(ctx, coefficients, q, velocity, gradient, position, selection, problem: Problem):
        start_warp()
        inputs = (coefficients, q, velocity, gradient, position, selection)
        coefficients, q, velocity, gradient, position, selection = (value.detach() for value in inputs)
        ctx.frames = Frames(problem, coefficients, q, position, selection.contiguous(), keep=any(ctx.needs_input_grad))
        u, v, deformation = ctx.frames.forward(velocity, gradient)
        ctx.mark_non_differentiable(v)
        return u, v, deformation, ctx.frames

    @staticmethod
    def backward(ctx, adjoint_u, _v, adjoint_F, _):
        return (*ctx.frames.backward(adjoint_u, adjoint_F), None)
