"""Particles + video prior -> material: score distillation through renderer and simulator
(`physics3d/learning/fit.py`), from a recorded motion, or from an imagined one where the prior needs no recording."""

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Ge, Gt, Le
from torch import Tensor

from physics3d.checks import (
    Device,
    Duration,
    Frames,
    Length,
    NamesOf,
    NotNegative,
    Positive,
    Seed,
    Text,
    Whole,
    at_least_one,
    require_fields,
)
from physics3d.filling.body import Body
from physics3d.filling.in_world import look_ahead, say_resolution
from physics3d.gaussians.model import Gaussians
from physics3d.learning.chain import chain_of, is_forced
from physics3d.learning.course import Point, history
from physics3d.learning.curves import curves
from physics3d.learning.fields import AXES, DENSITY, AbstractField, GlobalField, is_elastic, is_stiff, physical
from physics3d.learning.film_next import film_next
from physics3d.learning.fit import fit
from physics3d.learning.imagined import Imagined
from physics3d.learning.interval import Beyond, Told, intervals, of_branches, posterior, told, words
from physics3d.learning.likelihood import Ratio, ratios
from physics3d.learning.linear import Shown, shown
from physics3d.learning.loss import Chain
from physics3d.learning.mirror import NEAR, across, angular_frequency
from physics3d.learning.polish import polish
from physics3d.learning.rivals import rivals, widened
from physics3d.learning.search import search
from physics3d.learning.stiffness_field import WIDTH, StiffnessField, asked_for, is_node, picture, smooth, trilinear
from physics3d.learning.unknown_cause import learned_free
from physics3d.learning.valley import reaches
from physics3d.learning.which_model import compared, other_end
from physics3d.log import Log
from physics3d.pictures import contact_sheet, titled, to_uint8
from physics3d.priors.base import AbstractPrior
from physics3d.priors.estimators.base import AbstractEstimator
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.scenes.base import Capture, Footage, Outline, Take
from physics3d.truth import truth_of
from physics3d.world import Estimate, Interval, World

Span = Annotated[float, Gt(1), Le(1e12)]  # a factor
Width = Annotated[float, Gt(0), Le(20)]
USUAL_FRAMES = 15  # of a clip, for priors that take any number
USUAL_STEPS = 15  # of gradient descent, where nothing is polished
SOFTER = 4.0  # than what the search found: a thing that a wall stopped looks as much stiffer where walls are not felt
MATTERS = 0.02  # of the density, by which what is known of it would change the answer
LOOKS = 2  # along the valley: a lower place is polished once, and looked around from again


@dataclass(frozen=True, kw_only=True)
class Learn:
    """Learns global material parameters, and if asked the initial velocity, from the take with the role "learn"."""

    world: World
    prior: AbstractPrior
    estimator: AbstractEstimator = dataclasses.field(default_factory=ScoreDistillation)
    learn: tuple[Text, ...]  # parameters that may change; the others keep the value of world.start
    ties: tuple[
        tuple[Text, ...], ...
    ] = ()  # groups that share one factor, e.g. [[youngs_modulus, branch_shear_modulus]]
    learn_velocity: bool = False  # one initial velocity for the whole body
    # of gradient descent; None: none where the polish begins from a search and does without, else USUAL_STEPS
    steps: Whole | None = None
    polish: Whole = 0  # Levenberg steps after the descent; one costs two forward runs per parameter and two
    learning_rate: Annotated[float, Gt(0), Le(10)] = 0.1  # first step of theta: 0.1 is ten per cent of a parameter
    duration: Duration | None = None  # only the first part of the take is used [s]; None: all of it
    # of the take, spread over the duration; None: as many as the prior was trained on, USUAL_FRAMES if it takes any
    frames: Frames | None = None
    imagined: Imagined | None = None  # the motion to learn from where none was recorded
    frames_per_step: Whole = 0  # drawn anew for each step, spread over all of them; 0: all (diffusion priors need all)
    views_per_step: Whole = 1  # cameras drawn anew for each step; 0: all; held-out cameras are never used
    image_scale: Annotated[float, Gt(0), Le(16)] = 0.5  # pixels rendered per pixel of the take, along each side
    # stiffness factors tried before descending: a grid of that many, so that no period is skipped
    search: Literal[0] | Annotated[int, Ge(2), Le(10_000)] = 0
    search_span: Span = 10.0  # ... between 1/span and span, equally spaced in the logarithm
    stay: NotNegative = 0.002  # pull to the start: cost of a factor e, in halves of the loss there, or of the polish
    span: Span = 100.0  # a parameter stays within start/span .. start*span
    # of what is thought likely beforehand around the start: standard deviations in the logarithm; 2.3 is a factor 10
    guess_widths: dict[str, Width] = dataclasses.field(default_factory=dict)  # of single parameters
    guess_width: Width = 2.3  # of the others
    beyond: Beyond = dataclasses.field(default_factory=Beyond)  # widths of what the clip does not show
    largest_gradient: Positive = 3.0  # clip of the global norm, in units of the loss at the start per unit of theta
    zones: Annotated[int, Ge(1), Le(16)] = 4  # of stiffness, where the cause of the motion is unknown
    # of a field of stiffness, along the body's longest side; taken where the clip asks for it. 0: none
    nodes: Literal[0] | Annotated[int, Ge(2), Le(32)] = 0
    # within which a stiffness per particle is alike [m]; taken likewise, in the place of nodes. None: no such field
    smooth: Length | None = None
    device: Device = "cpu"
    seed: Seed = 0

    RULES = (
        at_least_one("learn", "ties", "learn_velocity"),
        NamesOf("learn", "world.start"),
        NamesOf("ties", "world.start"),
        NamesOf("guess_widths", "world.start"),
    )

    def __post_init__(self):
        require_fields(self, "learn")
        self.field(self.world.estimate(), speed=1.0)

    def fits(self, outline: Outline) -> None:
        """Raise ValueError if a take of this outline is too short, or the prior too large for its device, as far as
        that is known."""
        recorded = [take for take in outline.takes or () if take.role == "learn"]
        if not recorded and outline.takes is not None and self.imagined is not None and not self.prior.needs_clip:
            recorded = [self.imagined.footage]
        for take in recorded:
            if memory := self.prior.memory(len(self.spread(take))):
                memory.require()

    def __call__(self, capture: Capture, gaussians: Gaussians, body: Body, *, log: Log) -> Estimate:
        """Raises ValueError if there is no take to learn from, or a name, frame count or camera does not fit."""
        take = capture.take("learn")
        if take is None and self.imagined is not None and not self.prior.needs_clip:
            falls = any(self.world.gravity) or any(self.world.velocity)
            take = self.imagined.take(capture, gaussians, falls=falls, device=self.device)
        if take is None:
            raise ValueError(
                f"capture {capture.name} has no take with role learn; leave out the learning, record a motion, or take "
                "a prior that needs none"
            )
        if take.excitation is None:
            width = self.guess_widths.get("youngs_modulus", self.guess_width)
            free = learned_free(
                self.world, capture, gaussians, body, zones=self.zones, width=width, beyond=self.beyond, log=log
            )
            self.tell(free.intervals, log)
            return free
        start = self.world.estimate()
        section = look_ahead(body, self.world, take.excitation, log)
        indices = self.spread(take.footage)
        if memory := self.prior.memory(len(indices)):
            log.info(f"the prior takes {memory.require()}")
        seconds = int(indices[-1]) / take.fps
        whole = self.field(
            start, speed=self.natural_speed(body, seconds), density=self.world.density if self.weighs(take) else None
        )

        world = self.world

        def chained(field: AbstractField, log: Log, world: World) -> Chain:
            return chain_of(
                world,
                self.prior,
                self.estimator,
                field,
                capture,
                gaussians,
                body,
                take,
                indices,
                image_scale=self.image_scale,
                device=self.device,
                log=log,
            )

        chain = chained(whole, log, world)
        trained = self.prior.trained_frames
        if trained not in (None, len(indices)):
            log.warn(f"{len(indices)} frames are shown to a prior that was trained on clips of {trained}")
        log.info(
            f"learning {', '.join(whole.names)} from take {take.name}: {len(indices)} frames over {seconds:.2f} s, "
            f"{len(chain.clips)} camera(s), {len(body.position)} particles"
        )
        theta, stay = whole.zero(), self.pull(whole)
        course: list[Point] = []
        if self.search:
            theta, course = self.searched(chain, whole, log)
        if chain.passes_a_wall(whole.bound(theta - math.log(SOFTER) * stiffer(whole))):
            log.info(f"{SOFTER:g} times as soft as found without walls it reaches one, so what was filmed may have")
            world = replace(world, solver="grid")
            chain = replace(chained(whole, log, world), journal=chain.journal)
            theta, course = self.searched(chain, whole, log) if self.search else (whole.zero(), [])
        if chain.too_stiff is None and self.world.solver == "auto":  # otherwise said already
            say_resolution(section, self.world.dx, log)
        polished = self.polish > 0 and chain.comparable
        steps = self.steps
        if steps is None:
            steps = 0 if polished and self.search else USUAL_STEPS
        if steps:
            theta, descent = self.descended(chain, whole, theta, steps, log)
            course += descent
        if self.polish and not polished:
            log.info("no polish: single losses of this prior and estimator cannot be compared")
        elif polished:
            theta, points = self.polished(chain, whole, theta, stay, log)
            theta, points = self.crossed(chain, whole, theta, points, stay, log)
            course += points
        seen = shown(chain, whole, theta, seed=self.seed) if chain.certain else None
        said = self.said(whole, seen, log) if seen else None
        if seen and said and whole.density is not None:
            firmer = self.firmer(chain, whole, theta, seen, said)
            if (firmer > stay).any():
                log.info("what is known of the density holds it more than the clip does: polished once more")
                theta, points = self.polished(chain, whole, theta, stay := firmer, log)
                course += points
                seen = shown(chain, whole, theta, seed=self.seed)
                said = self.said(whole, seen, log)
        for look in range(LOOKS if polished else 0):
            assert seen is not None and said is not None  # what is comparable is certain
            said, lower = self.looked_along(chain, whole, theta, seen, said, log)
            if lower is None or look == LOOKS - 1:
                break
            log.info("along the valley the clip is explained better: the polish goes on from there")
            theta, points = self.polished(chain, whole, whole.bound(theta + torch.from_numpy(lower)), stay, log)
            course += points
            seen = shown(chain, whole, theta, seed=self.seed)
            said = self.said(whole, seen, log)
        field: AbstractField = whole
        known = history(whole, course)
        varying = self.varying(body)
        if varying is not None and seen is None:
            log.info("no field of stiffness: residuals tell whether a clip asks for one, and this prior has none")
        elif varying is not None and seen is not None:
            finer = StiffnessField(whole=whole, weights=varying)
            over, more = replace(chained(finer, Log(None), world), journal=chain.journal), finer.zero()
            more[: len(theta)] = theta
            more, descent = self.descended(over, finer, more, self.steps or USUAL_STEPS, log)
            if polished:
                more, points = self.polished(over, finer, more, self.pull(finer), log)
                descent += points
            losses = chain.measure(theta, self.seed), over.measure(more, self.seed)
            if asked_for(losses, finer, seen.evidence, log):
                field, theta, chain, seen = finer, more, over, shown(over, finer, more, seed=self.seed)
                said = self.said(finer, seen, log)
                known = {name: [*known.get(name, []), *curve] for name, curve in history(finer, descent).items()}
        beyond = self.beyond.of(section, self.world.dx, None if chain.too_stiff is None else chain.too_stiff())
        if beyond.grid > self.beyond.modes and chain.too_stiff is not None:
            log.info(
                f"splines further apart say that stiffness is up to {100 * beyond.grid:.0f} % off by their distance"
            )
        if seen is not None:
            motion = chain.motion(theta)
            beyond = beyond.shaped(body, motion.deformation, motion.velocity, log)
        omega = self.swing(chain, theta)
        equal, models, recordings = self.alike(chain, field, theta, seen, omega, course, stay, log)
        learned = replace(
            start,
            models=models,
            film_next=recordings,
            parameters={name: v.detach().to(torch.float32) for name, v in field.parameters(theta).items()},
            velocity=field.velocity(theta).detach().to(torch.float32),
            density=physical(field, theta).get(DENSITY),
            history=known,
            intervals=self.intervals(field, theta, seen, said, course, equal, beyond, omega, log)
            if seen and said
            else {},
        )
        self.report(capture, field, learned, seen, log)
        if log.folder is not None:
            if isinstance(field, StiffnessField):
                log.image("stiffness", picture(body.position, learned.parameters))
            if course:
                log.image("parameters", curves(capture, learned))
            with torch.no_grad():
                view = next(iter(chain.clips))
                clip = chain.render(chain.simulate(theta), view, chain.frames)
            both = [titled(to_uint8(chain.clips[view]), "recorded"), titled(to_uint8(clip), "learned")]
            log.image("reference_above_learned", contact_sheet(torch.cat(both, 1), columns=5))
        return learned

    def descended(
        self, chain: Chain, field: AbstractField, theta: Tensor, steps: int, log: Log
    ) -> tuple[Tensor, list[Point]]:
        """Where gradient descent ends, and its course."""
        return fit(
            chain,
            field,
            theta,
            steps=steps,
            learning_rate=self.learning_rate,
            views_per_step=self.views_per_step,
            frames_per_step=self.frames_per_step,
            stay=self.stay,
            largest_gradient=self.largest_gradient,
            seed=self.seed,
            log=log,
        )

    def polished(
        self, chain: Chain, field: AbstractField, theta: Tensor, stay: Tensor, log: Log
    ) -> tuple[Tensor, list[Point]]:
        """Where Levenberg's steps end, and their course."""
        return polish(chain, field, theta, steps=self.polish, stay=stay, seed=self.seed, log=log)

    def firmer(self, chain: Chain, field: GlobalField, theta: Tensor, seen: Shown, said: Told) -> Tensor:
        """`pull`, stronger for the density where residuals say so, and that matters.

        With the deviation v of what the clip says of it, by residuals that are counted as often as they are
        independent, and a width sigma of what is known, the pull is v^2/sigma^2 of the curvature that is left to the
        loss along the density when all else makes good what it can; the answer moves by v^2/(v^2 + sigma^2)."""
        i = field.names.index(DENSITY)
        before, pixels = self.before(field), sum(clip.numel() for clip in chain.clips.values())
        v = before[i] * math.hypot(*(said.axes[i] * said.deviation))
        if v**2 / (v**2 + before[i] ** 2) * abs(float(theta[i])) < MATTERS:
            return self.pull(field)
        left = 1 / (np.linalg.pinv(seen.evidence.JJ / pixels, hermitian=True)[i, i])
        stay = self.pull(field)
        stay[i] = max(float(stay[i]), v**2 / before[i] ** 2 * left / max(chain.measure(theta, self.seed), 1e-12))
        return stay

    def crossed(
        self, chain: Chain, field: GlobalField, theta: Tensor, points: list[Point], stay: Tensor, log: Log
    ) -> tuple[Tensor, list[Point]]:
        """The better one of theta, where a polish with these points ended, and the end of one that begins across from
        it, in the other valley of the relaxation time; with both courses."""
        places = across(field, theta, self.swing(chain, theta))
        if not places:
            return theta, points
        there = places[0] if len(places) == 1 else min(places, key=lambda place: chain.tried(place, self.seed))
        time = lambda at: physical(field, at)["shear_relaxation_time"]
        log.info(f"a relaxation time of {time(there):.3g} s damps the swing as {time(theta):.3g} s do: tried as well")
        other, more = self.polished(chain, field, there, stay, log)
        ends = [
            Point(way="across", theta=at, loss=way[-1].loss if way else chain.measure(at, self.seed))
            for at, way in ((theta, points), (other, more))
        ]
        worse, better = sorted(ends, key=lambda end: end.loss, reverse=True)
        if abs(math.log(time(other) / time(theta))) < math.log(NEAR):  # it came back: one valley
            return better.theta, [*points, *more, replace(better, way="polish")]
        log.info(f"{time(better.theta):.3g} s explain the clip better: loss {better.loss:.5g}, not {worse.loss:.5g}")
        return better.theta, [*points, *more, worse, replace(better, way="polish")]

    def swing(self, chain: Chain, theta: Tensor) -> float:
        """Angular frequency [1/s] of the motion at theta."""
        answer = lambda: angular_frequency(chain.motion(theta))
        return chain.journal.ask("angular frequency", theta, answer=answer)

    def alike(
        self,
        chain: Chain,
        field: AbstractField,
        theta: Tensor,
        seen: Shown | None,
        omega: float,
        course: list[Point],
        stay: Tensor,
        log: Log,
    ) -> tuple[list[Point], dict[str, float], dict[str, float]]:
        """(what was tried and explains the clip as well; ln of the odds for what was learned against simpler models and
        other valleys; what further recordings should add to them where the clip leaves a tie)."""
        if seen is None or not course:
            return [], {}, {}
        against: dict[int, Ratio] = {}

        def told_apart(points: list[Point]) -> list[bool]:
            padded = lambda at: torch.cat([at, theta.new_zeros(len(theta) - len(at))])
            found = ratios(chain, theta, [(padded(point.theta), point.loss) for point in points], seed=self.seed)
            against.update((id(point), one) for point, one in zip(points, found))
            return [one.told_apart for one in found]

        equal = rivals(course, told_apart)
        if not (self.polish and chain.comparable and isinstance(field, GlobalField)):
            return equal, {}, {}
        how: dict[str, Any] = dict(omega=omega, steps=self.polish, stay=stay, seed=self.seed, log=log)
        verdicts = compared(chain, field, theta, **how)
        verdicts += [other_end(field, end, against[id(end)]) for end in equal if end.way == "across"]
        recordings = film_next(chain, theta, verdicts, seed=self.seed, log=log)
        return equal, {verdict.model.name: verdict.odds for verdict in verdicts}, recordings

    def said(self, field: AbstractField, seen: Shown, log: Log) -> Told:
        """What the clip says around what was learned."""
        return told(seen.evidence, before=self.before(field), log=log)

    def looked_along(
        self, chain: Chain, field: AbstractField, theta: Tensor, seen: Shown, said: Told, log: Log
    ) -> tuple[Told, np.ndarray | None]:
        """`reaches` along the valley around theta, and where it is lower."""
        pixels = sum(clip.numel() for clip in chain.clips.values())
        return reaches(
            said,
            before=self.before(field),
            rise=lambda d: float(d @ seen.evidence.JJ @ d) / (2 * pixels),
            loss=lambda d: chain.tried(field.bound(theta + torch.from_numpy(d)), self.seed),
            log=log,
        )

    def before(self, field: AbstractField) -> np.ndarray:
        """Widths of what was thought of every component of theta."""
        return np.array([self.width(name.split("+")[0]) for name in field.names])

    def spread(self, take: Footage) -> Tensor:
        """Which frames of the take are used: the first, and others spread over all of the duration.

        They are equally far apart where what that leaves at the end is shorter than one stride, else to a frame."""
        total = take.frames
        if self.duration is not None:
            total = min(total, math.floor(self.duration * take.fps + 1e-6) + 1)
        count, why = self.frames, ""
        if count is None:
            count = self.prior.trained_frames
            why = " (null: as many as the prior was trained on)" if count else ""
            count = count or min(USUAL_FRAMES, total)
        if count > total:
            raise ValueError(
                f"learn.frames is {count}{why}, but take {take.name} has {total} frames"
                f"{'' if self.duration is None else f' in {self.duration:g} s'}; lower it or raise learn.duration"
            )
        self.prior.require_frames(self.frames_per_step or count)
        stride, rest = divmod(total - 1, count - 1)
        if rest < stride:
            return torch.arange(count) * stride
        return torch.linspace(0, total - 1, count, dtype=torch.float64).round().long()

    def weighs(self, take: Take) -> bool:
        """Whether the density is learned besides: it is uncertain, a force that is known in newtons tells it, and a
        polish looks for it. Priors that know no recording say nothing of a force."""
        asked = self.polish > 0 and self.estimator.descends and self.prior.needs_clip
        return asked and self.beyond.density > 0 and is_forced(self.world, take)

    def pull(self, field: AbstractField) -> Tensor:
        """`stay` of every component [k]. That of the density is as much stronger as less is unknown of it: as of a
        number that is thought to be within `guess_width`, `stay` is the pull."""
        known = lambda name: self.guess_width / self.beyond.density if name == DENSITY else 1.0
        return torch.tensor([self.stay * known(name) ** 2 for name in field.names], dtype=torch.float64)

    def field(self, start: Estimate, *, speed: float, density: float | None = None) -> GlobalField:
        """What theta means; `speed` [m/s] is the unit of an initial velocity, `density` [kg/m^3] is given where it is
        learned. Raises ValueError as GlobalField does."""
        return GlobalField(
            start=start.parameters,
            learn=self.learn,
            ties=self.ties,
            span=self.span,
            start_velocity=start.velocity,
            velocity_scale=speed if self.learn_velocity else None,
            density=density,
        )

    def varying(self, body: Body) -> Tensor | None:
        """Weights [p, k] of the field of stiffness that is asked for; None for one stiffness."""
        if self.smooth is not None:
            return smooth(body.position, self.smooth)
        return trilinear(body.position, self.nodes) if self.nodes else None

    def natural_speed(self, body: Body, seconds: float) -> float:
        """Its own size per duration of the clip [m/s]: the unit in which the initial velocity is learned."""
        size = body.position.amax(0) - body.position.amin(0)
        return float(size.norm()) / seconds

    def searched(self, chain: Chain, field: GlobalField, log: Log) -> tuple[Tensor, list[Point]]:
        """The best of the factors on all moduli together; the start if no modulus is learned, which is said."""
        directions = stiffer(field)
        if not directions.any():
            log.info(f"no coarse search over the stiffness: no modulus is learned, only {', '.join(field.names)}")
            return field.zero(), []
        limit = math.log(self.search_span)
        offsets = np.linspace(-limit, limit, self.search).tolist()
        return search(chain, field, directions, offsets, seed=self.seed, log=log)

    def intervals(
        self,
        field: AbstractField,
        theta: Tensor,
        seen: Shown,
        said: Told,
        course: list[Point],
        equal: list[Point],
        beyond: Beyond,
        omega: float,
        log: Log,
    ) -> dict[str, Interval]:
        """Of every learned number; `course`: what was tried, `equal`: and does as well; `beyond`: what pictures do not
        show; `omega` of the motion [1/s]."""
        unit = field.velocity_scale or 1.0
        speed = [float(v) / unit for v in field.velocity(theta)] if field.velocity_scale else []
        stiff = np.array([float(is_stiff(name)) for name in field.names])
        mass = np.array([float(name == DENSITY) for name in field.names])
        values = {name: float(value.mean()) for name, value in field.parameters(theta).items()}
        fast = np.zeros(len(field.names))
        fast[[name in AXES for name in field.names]] = speed
        after = posterior(
            theta.detach().numpy(),
            said,
            before=self.before(field),
            beyond=beyond.covariance(stiff, fast, seen.push, of_branches(field.names, values, omega), seen.grid, mass),
        )
        return intervals(field, widened(after, course, equal, log), theta.detach().numpy())

    def width(self, name: str) -> float:
        """Of what is thought of a component of theta before the clip."""
        if name == DENSITY:
            return self.beyond.density
        return WIDTH if is_node(name) else self.guess_widths.get(name, self.guess_width)

    def report(self, capture: Capture, field: AbstractField, learned: Estimate, seen: Shown | None, log: Log) -> None:
        """One line per number: from, to, truth, how visible it is and between what it lies, as far as that is known."""
        before = physical(field, field.zero())
        after = {name: float(value.mean()) for name, value in learned.parameters.items()}
        after |= dict(zip(AXES, learned.velocity.tolist()))
        if learned.density is not None:
            after[DENSITY] = learned.density
        for i, name in enumerate(n for n in field.names if not is_node(n)):  # nodes are the last ones
            visible = ""
            if seen is not None:
                log.metric(f"sensitivity/{name}", 255 * float(seen.rms[i]))
                visible = f"; a factor e changes the picture by {255 * float(seen.rms[i]):.2g} of 255"
            for part in name.split("+"):
                true = truth_of(part, capture.truth)
                truth = "" if true is None else f", truth {true:.4g}"
                log.info(f"{part}: {before[part]:.4g} -> {after[part]:.4g}{truth}{visible}")
        if seen is None:
            log.info(
                "no intervals: what a video model holds probable is no recording, and how far it is wrong nobody knows"
            )
        self.tell(learned.intervals, log)

    def tell(self, found: dict[str, Interval], log: Log) -> None:
        """The intervals, in words and as metrics."""
        for name, one in found.items():
            log.info(f"{name}: {words(one)}")
            log.metric(f"interval/{name}/low", one.low)
            log.metric(f"interval/{name}/high", one.high)
            log.metric(f"interval/{name}/deviation", one.deviation)


def stiffer(field: GlobalField) -> Tensor:
    """The direction [k] of all moduli together; zero if none is learned."""
    return torch.tensor([float(is_elastic(name)) for name in field.names]).double()
