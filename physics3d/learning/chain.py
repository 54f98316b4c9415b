"""How theta becomes a motion, a motion a clip, and which clips of a take it is compared with."""

import math
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
from physics3d.learning.fields import AbstractField
from physics3d.learning.loss import Chain
from physics3d.log import Log
from physics3d.priors.base import AbstractPrior
from physics3d.priors.estimators.base import AbstractEstimator
from physics3d.scenes.base import Capture, Take
from physics3d.solver import Motion, motion_of
from physics3d.world import World

LONGER = 3.0  # than the clip, is what could be filmed next
PULL = 1 / 3  # of the force of a push, that pulls steadily


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

    Pictures are drawn at `image_scale` of the take's size. Raises ValueError if all cameras are held out.
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
    model, embedding = gaussians.to(device), body.embedding
    rest, volume = body.position.to(device), body.volume.to(device)
    background = torch.tensor(capture.background, dtype=torch.float32, device=device)
    backdrops = {i: Backdrop.of(model, embedding, cameras[i], background=background) for i in views}
    # rolled out at the largest step of which all frames are multiples
    step = math.gcd(*indices.tolist())
    at = (indices // step).tolist()

    part = lambda values: world.material.per_part(values, body.part, body.parts)
    first = part(field.parameters(field.zero()))

    def moved(excitation: tuple[AbstractBoundary, ...], timing: dict[str, Any], log: Log) -> Motion:
        motion = motion_of(
            world,
            rest,
            volume,
            excitation=(*body.held, *excitation),
            part=part,
            matter=body.matter,
            device=device,
            log=log,
        )
        return motion.settled(first, velocity=field.velocity(field.zero()), **timing)

    timing: dict[str, Any] = dict(frames=at[-1] + 1, frame_dt=step / take.fps)
    motion = moved(take.excitation or (), timing, log)
    motion.report(first)

    def simulate(theta: Tensor):
        return motion(part(field.parameters(theta)), velocity=field.velocity(theta), log=Log(None), **timing)

    def pushed(theta: Tensor, more: float):
        stronger = replace(
            motion,
            world=replace(world, boundaries=_stronger(world.boundaries, more)),
            excitation=(*body.held, *_stronger(take.excitation or (), more)),
            modes=None if motion.modes is None else motion.modes.pushed(math.exp(more)),
            log=Log(None),
        )
        return stronger(part(field.parameters(theta)), velocity=field.velocity(theta), log=Log(None), **timing)

    def render(motion, view: int, frames: Tensor) -> Tensor:
        draw = lambda x, F: (
            render_deformed(
                model, embedding, rest, x, F, cameras[view], background=background, backdrop=backdrops[view]
            ).color
        )
        return torch.stack([draw(motion.position[at[i]], motion.deformation[at[i]]) for i in frames.tolist()]).float()

    def filmed(excitation: tuple[AbstractBoundary, ...], times: float):
        def made():
            slower = timing | dict(frame_dt=times * timing["frame_dt"])
            other = motion if excitation == take.excitation else moved(excitation, slower, Log(None))
            return lambda theta: other(
                part(field.parameters(theta)), velocity=field.velocity(theta), log=Log(None), **slower
            )

        return made

    known = (*world.boundaries, *(take.excitation or ()))
    seconds = int(indices[-1]) / take.fps
    others = recordings(take.excitation or (), seconds)
    forced = _stronger(known, 1.0) != known
    return Chain(
        simulate=simulate,
        render=render,
        clips=clips,
        prior=prior,
        estimator=estimator,
        pushed=pushed if forced else None,
        recordings={name: filmed(excitation, times) for name, (excitation, times) in others.items()},
        on_grid=motion.modes is None,
        journal=Journal(log),
    )


def recordings(
    excitation: tuple[AbstractBoundary, ...], seconds: float
) -> dict[str, tuple[tuple[AbstractBoundary, ...], float]]:
    """What a person could film next of a thing that was filmed for so long [s], in words -> (what sets it going, how
    many times as long it is filmed)."""
    long = LONGER * seconds
    found: dict[str, tuple[tuple[AbstractBoundary, ...], float]] = {
        f"the same again, filmed for {long:.2g} s": (excitation, LONGER)
    }
    pushes = [b for b in excitation if isinstance(b, Impulse) and b.force is not None and any(map(float, b.force))]
    if len(pushes) != 1:  # several together have no side
        return found
    push = pushes[0]
    assert push.force is not None
    x, y, z = map(float, push.force)
    other = lambda **change: tuple(replace(b, **change) if b is push else b for b in excitation)
    found["a push as strong, from another side"] = (
        other(force=(-y, x, z) if math.hypot(x, y) > abs(z) else (z, x, y)),
        1,
    )
    weight = PULL * math.hypot(x, y, z)
    found[f"a steady pull of {weight:.2g} N where it was pushed, as by a weight on a thread, for {long:.2g} s"] = (
        other(force=(PULL * x, PULL * y, PULL * z), duration=long),
        LONGER,
    )
    return found


def _stronger(boundaries: tuple[AbstractBoundary, ...], more: float) -> tuple[AbstractBoundary, ...]:
    """The same with forces exp(more) times as large; motions and accelerations stay."""
    times = math.exp(more)
    return tuple(
        replace(b, force=(times * float(b.force[0]), times * float(b.force[1]), times * float(b.force[2])))
        if isinstance(b, Impulse) and b.force is not None and any(map(float, b.force))
        else b
        for b in boundaries
    )
