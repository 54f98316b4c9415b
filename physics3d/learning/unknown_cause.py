"""A take whose cause nobody knows: what its camera sees of the body, and the material that makes it swing so."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.filling.body import Body
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.register import register
from physics3d.journal import Journal
from physics3d.learning.free_body import estimate, reduced
from physics3d.learning.free_interval import free_intervals, free_posterior
from physics3d.learning.free_motion import FreeMotion, Material, Reduced, fit
from physics3d.learning.identify import Oscillations, Swing, another_take, identified
from physics3d.learning.interval import Beyond
from physics3d.learning.seen_modes import Look, Observed, Sight, observe, observe_again, sight
from physics3d.log import Log
from physics3d.modes.model import Model
from physics3d.motion.decay import Decay, fit_decay
from physics3d.motion.release import free_decay
from physics3d.motion.shapes import moving, shapes
from physics3d.motion.thing import standing
from physics3d.scenes.base import Capture, Take
from physics3d.world import Estimate, World

SHAPES = 3  # of the flow, that the clip's frequencies are read off
LEAST, PERIODS = 12, 1.5  # frames, and of the largest oscillation, that a motion is learned from
LOOKS, SAME = 3, 0.02  # at the frames after the first, at most; by less of the motion two of them say the same
SMALL_SLOPE = 1e-4  # of a field of displacement, whose strain is linear
BESIDE = 0.05  # of what moves; flow runs over outlines, so that of a thin thing most is beside it


@dataclass(frozen=True, kw_only=True)
class Swung:
    """A body with its first take, ready to be fitted."""

    reduced: Reduced
    model: Model
    sight: Sight
    picture: Tensor  # uint8 [h, w, 3], in which the body is where its Gaussians are
    take: Take


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What the frames seen of a take show."""

    clip: Observed
    flow: Float[np.ndarray, "t h w 2"]  # from the picture in which the body is where its Gaussians are [px]
    weight: Float[np.ndarray, "t n"]  # of the pixels of the sight
    release: int  # frame from which the thing is free; time 0 of the swing
    reference: float | None  # time of that picture, in the same clip [s]; None: there the body is at rest
    swing: Swing
    since: Float[np.ndarray, " m"]  # amplitudes of the swing in the picture that the flow counts from [m]

    def places(self) -> Float[np.ndarray, "k m"]:
        """Amplitudes since that picture, in the frames from the release on [m]."""
        count = len(self.flow) - self.release
        return np.stack([self.swing.at(i / self.clip.fps) for i in range(count)]) - self.since

    @property
    def window(self) -> Observed:
        """The frames from the release on."""
        return self.clip.window(self.release, len(self.flow))


def frames_seen(take: Take) -> int:
    """How many of its first frames may be looked at."""
    return take.seen or len(take.videos[0]) // 2


def swung(world: World, capture: Capture, gaussians: Gaussians, body: Body, *, zones: int, log: Log) -> Swung:
    """Raises ValueError if the first take is too short, or as `reduced` and `sight` do."""
    take = capture.take("learn")
    assert take is not None and take.posed is not None
    if frames_seen(take) < LEAST:
        raise ValueError(f"take {take.name}: {frames_seen(take)} frames are seen; a motion needs at least {LEAST}")
    camera = found_by(capture, take, gaussians, log)
    centre = body.position.double().mean(0, keepdim=True)
    scale = float(camera.fx / camera.project(centre)[1])
    small, model = reduced(world, body, zones=zones, scale=scale, log=log)
    return Swung(
        reduced=small,
        model=model,
        sight=sight(gaussians, body, camera, model.values),
        picture=take.videos[0][take.posed],
        take=take,
    )


def by_its_own_camera(body: Swung, capture: Capture, take: Take, gaussians: Gaussians, rides: Body, log: Log) -> Swung:
    """Another take, whose camera and picture of the thing at rest are its own."""
    assert take.posed is not None
    seen = sight(gaussians, rides, found_by(capture, take, gaussians, log), body.model.values)
    return replace(body, sight=seen, picture=take.videos[0][take.posed], take=take)


def found_by(capture: Capture, take: Take, gaussians: Gaussians, log: Log) -> Camera:
    """The camera of a take, refined by what stands still in it where photographs show that too. Structure from motion
    places a clip by one frame, in which the thing moves and its surroundings are few: some pixels are left."""
    assert take.posed is not None
    camera, picture = take.cameras[0], take.videos[0][take.posed]
    if not take.at_rest or capture.single_object:
        return camera

    def refined() -> tuple[Tensor, float, float, float]:
        still = standing(take.videos[0], picture)
        found = register(gaussians, camera, picture, still, background=capture.background)
        return found.camera.world_to_camera, found.moved, found.before, found.after

    pose, moved, before, after = Journal(log).ask("camera", take.name, camera.world_to_camera, answer=refined)
    log.info(
        f"{take.name}: its camera is refined by what stands still: what is in the middle of the picture moves by "
        f"{moved:.1f} px, and pictures differ by {after:.3f} of the colours, {before:.3f} before"
    )
    return replace(camera, world_to_camera=pose)


def first_take(body: Swung, log: Log) -> Seen:
    """The frames seen of the take that is learned from. Raises ValueError if nothing swings in them."""
    frames = body.take.videos[0][: frames_seen(body.take)]
    seen = _looked_at(body, frames, body.take.fps, lambda look: _told(body, look))
    said(seen.swing, seen.release, log)
    return seen


def other_take(
    body: Swung, take: Take, modes: Oscillations, known: Float[np.ndarray, " m"] | None, *, release: int, seen: int
) -> Seen:
    """The first `seen` frames of another take of the same thing, by its camera. `known`: as for `another_take`."""

    def told(look: Look) -> Seen:
        clip, u, weight = look
        swing = another_take(body.reduced, clip.window(release, seen), modes, known)
        since = np.zeros(len(modes.shape)) if known is None else known
        return Seen(clip=clip, flow=u, weight=weight, release=release, reference=None, swing=swing, since=since)

    return _looked_at(body, take.videos[0][:seen], take.fps, told)


def _looked_at(body: Swung, frames: Tensor, fps: float, told: Callable[[Look], Seen]) -> Seen:
    """What is told of the frames, looked at again (`observe_again`) until they tell the same."""
    size = lambda q: float(np.einsum("tm,mn,tn->", q, body.sight.gram, q))
    seen = told(observe(body.sight, frames, fps, reference=body.picture))
    places = seen.places()
    for _ in range(LOOKS):
        look = observe_again(body.sight, frames, fps, reference=body.picture, seen=seen.flow, places=places)
        before, seen = places, told(look)
        places = seen.places()
        both = min(len(before), len(places))  # the release may be another
        if size(places[-both:] - before[-both:]) <= SAME**2 * size(places[-both:]):
            break
    return seen


def _told(body: Swung, look: Look) -> Seen:
    """What a look tells: from where on the thing is free, and its oscillations."""
    (clip, u, weight), take = look, body.take
    where = moving(u)
    if where is None:
        raise ValueError(f"take {take.name}: nothing moves in the {len(u)} frames that are seen")
    share = float(where[body.sight.thing].sum() / where.sum())
    if share < BESIDE:
        raise ValueError(
            f"take {take.name}: only {100 * share:.0f} % of what moves is where the thing is seen; the clip shows "
            "something else that moves, or the prompts name another thing: set scene.prompts"
        )
    where &= body.sight.thing
    signal = shapes(u, np.ones(u.shape[:3], np.float32), where, count=SHAPES).signal
    decay, release = free_decay(signal, take.fps)
    later = min(take.release, _latest(decay, len(u), take.fps))
    if release < later:
        release = later  # known from elsewhere, a person or the whole clip
        decay = fit_decay(signal, take.fps, first=release)
    if decay.main() is None:
        raise ValueError(
            f"take {take.name}: what moves does not swing; a material is learned from what has been let go"
        )
    assert take.posed is not None
    reference = None if take.at_rest else (take.posed - release) / take.fps
    swing = identified(body.reduced, clip.window(release, len(u)), decay, reference=reference)
    since = np.zeros(len(swing.modes.shape)) if reference is None else swing.at(reference)
    return Seen(clip=clip, flow=u, weight=weight, release=release, reference=reference, swing=swing, since=since)


def _latest(decay: Decay, count: int, fps: float) -> int:
    """The last of `count` frames from which enough of the largest oscillation is seen. A whole clip says late where its
    decay is that of modes to the last hundredth, which no wide swing is: of a short clip little would be left."""
    main = decay.main()
    least = LEAST if main is None else max(LEAST, math.ceil(PERIODS * fps / decay.frequency[main]))
    return count - least


def learned_free(
    world: World,
    capture: Capture,
    gaussians: Gaussians,
    body: Body,
    *,
    zones: int,
    width: float,
    beyond: Beyond,
    log: Log,
) -> Estimate:
    """The material, from the frames seen of the first take. `width`: of the stiffness that is likely beforehand, in the
    logarithm; `beyond`: what the frames do not show."""
    ready = swung(world, capture, gaussians, body, zones=zones, log=log)
    seen = first_take(ready, log)
    take, release, swing = ready.take, seen.release, seen.swing
    material, motion = fit(
        ready.reduced,
        seen.clip,
        release=release,
        reference=None if take.at_rest else take.posed,
        frequency=float(swing.modes.frequency[0]),
        large=swing.large,
        log=log,
    )
    report(motion, material, log)
    i, j = ready.sight.pixel.T
    after = free_posterior(
        ready.reduced,
        material,
        seen.window,
        sight=ready.sight,
        flow=seen.flow[release:, i, j].astype(float),
        weight=seen.weight[release:],
        reference=seen.reference,
        large=swing.large,
        width=width,
        beyond=beyond.of(None, world.dx, ready.model.too_stiff()).shaped(
            body, *deformed(ready.model, seen.places()), log
        ),
        log=log,
    )
    found = estimate(world, material, ready.reduced.zone)
    assumed(world, found, beyond, log)
    return replace(found, intervals=free_intervals(found, material, after))


def assumed(world: World, found: Estimate, beyond: Beyond, log: Log) -> None:
    """What a motion without a known force does not tell, in words."""
    ratio = float(found.parameters["youngs_modulus"].double().mean()) / world.density
    log.info(
        f"the motion tells E/rho, {ratio:.3g} m^2/s^2, times a length squared; assumed: its density is "
        f"{world.density:g} kg/m^3 within {100 * beyond.density:.0f} % (scene.density, or scene.thing for what it is "
        f"made of), and sizes are right within {100 * beyond.length:.0f} %"
    )


def deformed(
    model: Model, amplitude: Float[np.ndarray, "k m"]
) -> tuple[Float[Tensor, "k p 3 3"], Float[Tensor, "k p 3"]]:
    """F and displacement [m] of the particles, of amplitudes in the body's basis that are made as small as strain is in
    modes: large ones would count turns as stretch."""
    q = amplitude.reshape(len(amplitude), model.count, 3)
    slope = np.einsum("par,kri->kpia", model.slopes.reshape(-1, 3, model.count), q, optimize=True)
    small = SMALL_SLOPE / max(float(np.abs(slope).max()), 1e-300)
    displacement = small * np.einsum("pr,kri->kpi", model.values, q, optimize=True)
    return torch.from_numpy(np.eye(3) + small * slope), torch.from_numpy(displacement)


def said(swing: Swing, release: int, log: Log) -> None:
    """The oscillations that are seen, in words and numbers."""
    modes, large = swing.modes, swing.modes.large
    pairs = ", ".join(f"{f:.3g} Hz (damping {d:.2g} 1/s)" for f, d in zip(modes.frequency, modes.damping))
    log.info(
        f"free from frame {release} on; oscillations seen, of small swings: {pairs}; at first they are "
        f"{100 * large.slower:.1f} % slower and die out {100 * large.sooner:.0f} % faster, as the "
        f"{'square of the ' if large.exponent == 2 else ''}amplitude"
    )
    log.info(f"they explain {100 * (1 - swing.unexplained):.1f} % of the motion that is seen")


def report(motion: FreeMotion, material: Material, log: Log) -> None:
    """The modes that are seen, in words and numbers."""
    loud = np.argsort(-motion.loudness)[:3]
    for k in loud:
        log.info(
            f"mode at {motion.frequency[k]:.3g} Hz, damping {motion.damping[k]:.2g} 1/s: {motion.loudness[k]:.2g} px"
        )
    log.info(f"the material explains {100 * (1 - motion.unexplained):.1f} % of the motion that is seen")
    log.metric("explained", 1 - motion.unexplained)
    for name in ("frequency", "damping"):
        log.metric(f"{name}_of_the_loudest_mode", float(getattr(motion, name)[loud[0]]))
    log.metric("branch_ratio", float(np.exp(material.ratio)))
