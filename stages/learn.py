"""Particles + video prior -> material: score distillation through renderer and simulator
(`physics3d/learning/fit.py`)."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from physics3d.filling.fill import Body
from physics3d.gaussians.deform import Backdrop, render_deformed
from physics3d.gaussians.model import Gaussians
from physics3d.learning.fields import GlobalField
from physics3d.learning.fit import Chain, fit, physical, polish, search, sensitivity
from physics3d.log import Log
from physics3d.mpm.rollout import rollout
from physics3d.priors.base import AbstractPrior
from physics3d.scenes.base import Capture, Take
from physics3d.video import contact_sheet, to_uint8
from physics3d.world import Estimate, World


@dataclass(frozen=True, kw_only=True)
class Learn:
    """Learns global material parameters, and if asked the initial velocity, from the take with the role "learn"."""

    world: World
    prior: AbstractPrior
    learn: tuple[str, ...]  # parameters that may change; the others keep the value of world.start
    ties: tuple[
        tuple[str, ...], ...
    ] = ()  # groups that share one factor, e.g. [[youngs_modulus, branch_shear_modulus]]
    learn_velocity: bool = False  # one initial velocity for the whole body
    steps: int = 30  # of gradient descent
    polish: int = 0  # Gauss-Newton steps after the descent; one costs a forward run per parameter and two
    learning_rate: float = 0.1  # first step of theta: 0.1 is ten per cent of a parameter
    duration: float | None = None  # only the first part of the take is used [s]; None: all of it
    frames: int = 15  # of the take, evenly spaced over the duration
    frames_per_step: int = 0  # drawn anew for each step, spread over all of them; 0: all (diffusion priors need all)
    views_per_step: int = 1  # cameras drawn anew for each step; 0: all; held-out cameras are never used
    image_scale: float = 0.5  # pixels rendered per pixel of the take, along each side
    search: int = 0  # stiffness factors tried before descending: a grid of that many, so that no period is skipped
    search_span: float = 10.0  # ... between 1/span and span, equally spaced in the logarithm
    stay: float = 0.01  # pull to the start: cost of a factor e, in units of half the loss at the start
    span: float = 100.0  # a parameter stays within start/span .. start*span
    largest_gradient: float = 3.0  # clip of the global norm, in units of the loss at the start per unit of theta
    device: str = "cpu"
    seed: int = 0

    def __post_init__(self):
        counts = ("steps", "polish", "frames_per_step", "views_per_step", "search")
        for name, lowest in (("frames", 2), *((name, 0) for name in counts)):
            if getattr(self, name) < lowest:
                raise ValueError(f"learn.{name} is {getattr(self, name)}; it must be at least {lowest}")
        for name in ("learning_rate", "image_scale", "largest_gradient"):
            if not getattr(self, name) > 0:
                raise ValueError(f"learn.{name} is {getattr(self, name):g}; it must be positive")
        if not self.search_span > 1 or not self.stay >= 0:
            raise ValueError(
                f"learn.search_span ({self.search_span:g}) must be above 1 and learn.stay ({self.stay:g}) >= 0"
            )

    def __call__(self, capture: Capture, gaussians: Gaussians, body: Body, *, log: Log) -> Estimate:
        """Raises ValueError if there is no take to learn from, or a name, frame count or camera does not fit."""
        take = capture.take("learn")
        if take is None:
            raise ValueError(
                f"capture {capture.name} has no take with role learn; leave out the learning, or record a motion"
            )
        if take.excitation is None:
            raise ValueError(f"take {take.name}: nobody knows what set it in motion, and a start is not learned yet")
        start = self.world.estimate()
        indices = self.indices(take)
        seconds = int(indices[-1]) / take.fps
        field = GlobalField(
            start=start.parameters,
            learn=self.learn,
            ties=self.ties,
            span=self.span,
            start_velocity=start.velocity,
            velocity_scale=self.natural_speed(body, seconds) if self.learn_velocity else None,
        )
        chain = self.chain(capture, gaussians, body, take, field, indices)
        log.info(
            f"learning {', '.join(field.names)} from take {take.name}: {len(indices)} frames over {seconds:.2f} s, "
            f"{len(chain.clips)} camera(s), {len(body.position)} particles"
        )
        theta = field.zero()
        if self.search:
            theta = self.searched(chain, field, log)
        history: dict[str, list[float]] = {}
        if self.steps:
            theta, history = fit(
                chain,
                field,
                theta,
                steps=self.steps,
                learning_rate=self.learning_rate,
                views_per_step=self.views_per_step,
                frames_per_step=self.frames_per_step,
                stay=self.stay,
                largest_gradient=self.largest_gradient,
                seed=self.seed,
                log=log,
            )
        if self.polish:
            theta = polish(chain, field, theta, steps=self.polish, stay=self.stay, seed=self.seed, log=log)
        learned = replace(
            start,
            parameters={name: v.detach().to(torch.float32) for name, v in field.parameters(theta).items()},
            velocity=field.velocity(theta).detach().to(torch.float32),
            history=self.history(field, history),
        )
        self.report(capture, chain, field, theta, log)
        if log.folder is not None:
            log.image("parameters", curves(capture, learned.history))
            frames = torch.arange(len(indices))
            with torch.no_grad():
                view = next(iter(chain.clips))
                clip = chain.render(chain.simulate(theta), view, frames)
            log.image(
                "reference_above_learned", contact_sheet(to_uint8(torch.cat([chain.clips[view], clip], 1)), columns=5)
            )
        return learned

    def indices(self, take: Take) -> Tensor:
        """The frames of the take that are used: every stride-th, from the first."""
        total = len(take.videos[0])
        if self.duration is not None:
            total = min(total, math.floor(self.duration * take.fps + 1e-6) + 1)
        if self.frames > total:
            raise ValueError(
                f"learn.frames is {self.frames}, but take {take.name} has {total} frames"
                f"{'' if self.duration is None else f' in {self.duration:g} s'}; lower it or raise learn.duration"
            )
        stride = (total - 1) // (self.frames - 1)
        return torch.arange(self.frames) * stride

    def natural_speed(self, body: Body, seconds: float) -> float:
        """Its own size per duration of the clip [m/s]: the unit in which the initial velocity is learned."""
        size = body.position.amax(0) - body.position.amin(0)
        return float(size.norm()) / seconds

    def chain(
        self, capture: Capture, gaussians: Gaussians, body: Body, take: Take, field: GlobalField, indices: Tensor
    ) -> Chain:
        """What `fit` needs: how theta becomes a motion, a motion a clip, and the clips to compare with."""
        views = [i for i in range(len(take.cameras)) if i not in take.held_out_cameras]
        if not views:
            raise ValueError(f"take {take.name}: all cameras are held out; leave one to learn from")
        cameras = {i: take.cameras[i].scaled(self.image_scale) for i in views}
        clips = {}
        for i in views:
            video = take.videos[i][indices].permute(0, 3, 1, 2).to(self.device, torch.float32) / 255
            size = (cameras[i].height, cameras[i].width)
            clips[i] = torch.nn.functional.interpolate(video, size, mode="area").permute(0, 2, 3, 1)
        model, embedding = gaussians.to(self.device), body.embedding
        rest, volume = body.position.to(self.device), body.volume.to(self.device)
        background = torch.tensor(capture.background, dtype=torch.float32, device=self.device)
        backdrops = {i: Backdrop.of(model, embedding, cameras[i], background=background) for i in views}

        def simulate(theta: Tensor):
            return rollout(
                self.world,
                self.world.material.per_part(field.parameters(theta), body.part, body.parts),
                rest,
                volume,
                velocity=field.velocity(theta),
                excitation=(*body.held(self.world.boundaries), *(take.excitation or ())),
                frames=len(indices),
                frame_dt=int(indices[1]) / take.fps,
                device=self.device,
                log=Log(None),
            )

        def render(motion, view: int, frames: Tensor) -> Tensor:
            draw = lambda x, F: (
                render_deformed(
                    model, embedding, rest, x, F, cameras[view], background=background, backdrop=backdrops[view]
                ).color
            )
            return torch.stack([draw(motion.position[i], motion.deformation[i]) for i in frames.tolist()]).float()

        return Chain(simulate=simulate, render=render, clips=clips, prior=self.prior)

    def searched(self, chain: Chain, field: GlobalField, log: Log) -> Tensor:
        directions = torch.tensor([float(name.split("+")[0].endswith("modulus")) for name in field.names]).double()
        if not directions.any():
            raise ValueError(
                f"learn.search = {self.search} looks for a stiffness, but no modulus is learned; set it to 0"
            )
        limit = math.log(self.search_span)
        return search(
            chain, field, directions, np.linspace(-limit, limit, self.search).tolist(), seed=self.seed, log=log
        )

    def history(self, field: GlobalField, history: dict[str, list[float]]) -> dict[str, list[float]]:
        """Components of theta -> physical values per step."""
        if not history:
            return {}
        thetas = torch.tensor([history[name] for name in field.names], dtype=torch.float64).T
        values = [physical(field, theta) for theta in thetas]
        return {"loss": history["loss"], "gradient": history["gradient"]} | {
            n: [v[n] for v in values] for n in values[0]
        }

    def report(self, capture: Capture, chain: Chain, field: GlobalField, theta: Tensor, log: Log) -> None:
        """One line per component: from, to, truth, how visible it is and how far it can be trusted."""
        seen = sensitivity(chain, field, theta, seed=self.seed)
        before, after = physical(field, field.zero()), physical(field, theta)
        for name in field.names:
            rms, error = seen[name]
            log.metric(f"sensitivity/{name}", rms)
            if math.isfinite(error):
                log.metric(f"standard_error/{name}", error)
            for part in name.split("+"):
                truth = f", truth {capture.truth[part]:.4g}" if part in capture.truth else ""
                log.info(
                    f"{part}: {before[part]:.4g} -> {after[part]:.4g}{truth}; a factor e changes the picture by "
                    f"{rms:.2g} of 255, standard error at least {error:.2g} of a factor e"
                )


def curves(capture: Capture, history: dict[str, list[float]]):
    """A figure: every parameter against the step, the truth dashed where it is known, and the loss."""
    from matplotlib.figure import Figure

    names = [name for name in history if name != "gradient"]
    figure = Figure(figsize=(3.2 * max(1, len(names)), 2.8), layout="constrained")
    for i, name in enumerate(names):
        axis = figure.add_subplot(1, len(names), i + 1)
        axis.plot(history[name], lw=1.5)
        if name in capture.truth:
            axis.axhline(capture.truth[name], ls="--", color="0.4", label="truth")
            axis.legend(frameon=False)
        if max(history[name]) > 5 * min(history[name]) > 0:
            axis.set_yscale("log")
        axis.set(title=name, xlabel="step")
    return figure
