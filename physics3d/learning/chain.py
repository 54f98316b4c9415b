"""How theta becomes a motion, a motion a clip, and which clips of a take it is compared with."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.body import Body
from physics3d.gaussians.deform import Backdrop, render_deformed
from physics3d.gaussians.model import Gaussians
from physics3d.journal import Journal
from physics3d.learning.fields import AbstractField, is_stiff
from physics3d.learning.film_next import recordings
from physics3d.learning.loss import COARSER, Chain
from physics3d.log import Log
from physics3d.priors.base import AbstractPrior
from physics3d.priors.estimators.base import AbstractEstimator
from physics3d.scenes.base import Capture, Take
from physics3d.solver import Motion, motion_of
from physics3d.world import World

# positions, deformation gradients, number of the camera -> pictures [t, h, w, 3]
Draw = Callable[[Tensor, Tensor, int], Tensor]


def chain_of(
    world: World,
    prior: AbstractPrior,
    estimator: AbstractEstimator,
    field: AbstractField,
    capture: Capture,
    gaussians: Gaussians,
    body: Body,
    take: Take,
    indices: Tensor,
    *,
    image_scale: float,
    device: str,
    log: Log,
) -> Chain:
    """Of the frames `indices`, ascending from 0, of the cameras of the take that are not held out.

    Pictures are drawn at `image_scale` of the take's size. Where modes serve the body, they move it whatever theta is,
    through walls that they do not feel: trials that one solver moves and then the other have steps in their loss, and
    cost the time of both. `Chain.passes_a_wall` tells where that is wrong. Raises ValueError if all cameras are held
    out.
    """
    rest, volume = body.position.to(device), body.volume.to(device)
    clips, draw = filmed(capture, gaussians, body, take, indices, image_scale=image_scale, device=device)
    # rolled out at the largest step of which all frames are multiples
    step = math.gcd(*indices.tolist())
    at = (indices // step).tolist()

    part = lambda values: world.material.per_part(values, body.part, body.parts)
    first = part(field.parameters(field.zero()))

    def moved(excitation: tuple[AbstractBoundary, ...], log: Log) -> Motion:
        found = motion_of(
            world,
            rest,
            volume,
            excitation=(*body.held, *excitation),
            part=part,
            matter=body.matter,
            device=device,
            log=log,
        )
        return replace(found, feels_walls=False)

    timing: dict[str, Any] = dict(frames=at[-1] + 1, frame_dt=step / take.fps)
    motion = moved(take.excitation or (), log)
    motion.report(first)

    def rolled(by: Motion, theta: Tensor, *, more: float = 0.0, **other: Any):
        """The motion by theta, known forces being exp(more) times what is said."""
        lighter = -field.heavier(theta)
        if more + lighter:
            by = replace(
                by,
                world=replace(by.world, boundaries=stronger(by.world.boundaries, more + lighter)),
                excitation=stronger(by.excitation, more + lighter),
                modes=None if by.modes is None else by.modes.pushed(math.exp(more + lighter)),
            )
        values = per_mass(field.parameters(theta), lighter)
        return by(part(values), velocity=field.velocity(theta), log=Log(None), **timing | other)

    def simulate(theta: Tensor):
        return rolled(motion, theta)

    def pushed(theta: Tensor, more: float):
        return rolled(replace(motion, log=Log(None)), theta, more=more)

    def by_larger_cells(theta: Tensor):
        return rolled(replace(motion, world=replace(world, dx=COARSER * world.dx), log=Log(None)), theta)

    def render(motion, view: int, frames: Tensor) -> Tensor:
        there = [at[i] for i in frames.tolist()]
        return draw(motion.position[there], motion.deformation[there], view)

    def staged(excitation: tuple[AbstractBoundary, ...], times: float):
        def made():
            other = motion if excitation == take.excitation else moved(excitation, log.hushed())
            return lambda theta: rolled(other, theta, frame_dt=times * timing["frame_dt"])

        return made

    seconds = int(indices[-1]) / take.fps
    others = recordings(take.excitation or (), seconds)
    return Chain(
        simulate=simulate,
        render=render,
        clips=clips,
        prior=prior,
        estimator=estimator,
        pushed=pushed if is_forced(world, take) else None,
        coarser=by_larger_cells if motion.modes is None else None,
        recordings={name: staged(excitation, times) for name, (excitation, times) in others.items()},
        passes_a_wall=lambda theta: motion.passes_a_wall(
            part(per_mass(field.parameters(theta), -field.heavier(theta))), velocity=field.velocity(theta), **timing
        ),
        too_stiff=None if motion.modes is None else motion.modes.model.too_stiff,
        journal=Journal(log),
    )


def filmed(
    capture: Capture,
    gaussians: Gaussians,
    body: Body,
    take: Take,
    indices: Tensor,
    *,
    image_scale: float,
    device: str,
) -> tuple[dict[int, Tensor], Draw]:
    """(clips by number of the camera, float [t, h, w, 3] of the frames `indices`; what draws positions [t, p, 3] and
    deformation gradients [t, p, 3, 3] as such a camera sees them), at `image_scale` of the take's size.

    Raises ValueError if all cameras are held out.
    """
    views = [i for i in range(len(take.cameras)) if i not in take.held_out_cameras]
    if not views:
        raise ValueError(f"take {take.name}: all cameras are held out; leave one to learn from")
    cameras = {i: take.cameras[i].scaled(image_scale) for i in views}
    clips = {}
    for i in views:
        video = take.videos[i][indices].permute(0, 3, 1, 2).to(device, torch.float32) / 255
        size = (cameras[i].height, cameras[i].width)
        clips[i] = torch.nn.functional.interpolate(video, size, mode="area").permute(0, 2, 3, 1)
    model, embedding, rest = gaussians.to(device), body.embedding, body.position.to(device)
    background = torch.tensor(capture.background, dtype=torch.float32, device=device)
    backdrops = {i: Backdrop.of(model, embedding, cameras[i], background=background) for i in views}

    def draw(position: Tensor, deformation: Tensor, view: int) -> Tensor:
        pictures = [
            render_deformed(
                model, embedding, rest, x, F, cameras[view], background=background, backdrop=backdrops[view]
            ).color
            for x, F in zip(position, deformation)
        ]
        return torch.stack(pictures).float()

    return clips, draw


def is_forced(world: World, take: Take) -> bool:
    """Whether a force that is known in newtons drives the motion: then it tells how heavy the thing is."""
    known = (*world.boundaries, *(take.excitation or ()))
    return stronger(known, 1.0) != known


def per_mass(values: dict[str, Tensor], lighter: float) -> dict[str, Tensor]:
    """Parameters by which a body of the density that was given moves as one exp(-lighter) times as heavy by `values`,
    forces being made smaller alike: with rho, stress and force times the same factor motion is the same."""
    if not lighter:
        return values
    return {name: math.exp(lighter) * value if is_stiff(name) else value for name, value in values.items()}


def stronger(boundaries: tuple[AbstractBoundary, ...], more: float) -> tuple[AbstractBoundary, ...]:
    """The same with forces exp(more) times as large; motions and accelerations stay."""
    times = math.exp(more)
    return tuple(
        replace(b, force=(times * float(b.force[0]), times * float(b.force[1]), times * float(b.force[2])))
        if isinstance(b, Impulse) and b.force is not None and any(map(float, b.force))
        else b
        for b in boundaries
    )
