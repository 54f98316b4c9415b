"""Training of a denoiser of clips, and drawing from it.

    L = E w(r) |x0_hat(alpha z0 + sigma n) - z0|^2 / V,   r = sigma/alpha uniform in the logarithm,   w = 1 + (KNEE/r)^2

V is the mean of |z0 - still|^2, how much there is to be known. w is about one over the error of a perfect denoiser: V
where the noise hides everything, and as r^2 falls where a clip can be told from its neighbours. Adam with a warm-up and
a cosine to zero; what is kept are weights averaged over the last steps. Half the clips are seen in a mirror,
and all with their colours exchanged at random: there are more of them then.

The state is written every minute, whole or not at all, with the state of the random numbers: a training that was killed
goes on where it was and ends, on the same machine, with the same bits.
"""

import json
import math
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.checks import Ascending, Count, Device, Positive, Seed, Whole, require_fields
from physics3d.log import Log
from physics3d.priors.space_time_transformer import Architecture, SpaceTimeTransformer

KNEE = 10.0
STATE = "training.pt"
LARGEST_GRADIENT = 1.0


@dataclass(frozen=True, kw_only=True)
class Training:
    """How long, how fast, where."""

    steps: Count = 2000
    batch: Count = 16
    learning_rate: Positive = 1.5e-3
    warm_up: Whole = 50  # steps
    average: Count = 100  # steps over which weights are averaged, at the end
    ratio: Annotated[tuple[Positive, Positive], Ascending()] = (1.0, 60.0)  # sigma/alpha
    seed: Seed = 0
    device: Device = "cpu"

    def __post_init__(self):
        require_fields(self, "training")


def train(
    clips: UInt8[Tensor, "n t h w 3"],
    architecture: Architecture,
    options: Training,
    *,
    folder: Path,
    every: float = 60.0,
    log: Log,
) -> tuple[SpaceTimeTransformer, list[float]]:
    """The averaged network, and the loss of every step. The state is in `folder`, written every so many seconds.

    Raises ValueError if the clips have another size than the architecture, or the folder the state of another training.
    """
    if clips.shape[1:] != (architecture.frames, architecture.size, architecture.size, 3):
        raise ValueError(
            f"the clips are {tuple(clips.shape[1:])}, the architecture takes {architecture.frames} frames of "
            f"{architecture.size} x {architecture.size} px; make them anew in another folder"
        )
    run = _Run(clips, architecture, options)
    state = folder / STATE
    if state.exists():
        run.restore(state)
        log.info(f"goes on at step {len(run.losses)} of {options.steps}")
    last = time.monotonic()
    bar = log.progress(range(len(run.losses), options.steps), "training")
    for step in bar:
        loss = run.step(step)
        if step % 10 == 0:
            bar.set_postfix(loss=f"{sum(run.losses[-50:]) / len(run.losses[-50:]):.4f}")
            log.metric("loss", loss, step)
        if time.monotonic() - last > every:
            run.keep(state)
            last = time.monotonic()
    run.keep(state)
    return run.averaged, run.losses


class _Run:
    """Everything that changes from step to step."""

    def __init__(self, clips: Tensor, architecture: Architecture, options: Training):
        self.clips, self.options = clips, options
        self.asked = json.dumps([asdict(architecture), asdict(options), list(clips.shape)])
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            self.network = SpaceTimeTransformer(architecture).to(options.device)
            self.averaged = SpaceTimeTransformer(architecture).to(options.device)
        self.averaged.load_state_dict(self.network.state_dict())
        self.averaged.requires_grad_(False).eval()
        self.adam = torch.optim.AdamW(
            self.network.parameters(), lr=options.learning_rate, betas=(0.9, 0.98), weight_decay=0.01
        )
        self.generator = torch.Generator().manual_seed(options.seed)
        self.losses: list[float] = []
        self.scale = motion(clips)

    def step(self, step: int) -> float:
        options = self.options
        z0 = batch(self.clips, options.batch, self.generator).to(options.device)
        ratio = ratios(options.ratio, options.batch, self.generator).to(options.device)
        noise = torch.randn(z0.shape, generator=self.generator).to(options.device)
        warm = min(1.0, (step + 1) / max(1, options.warm_up))
        for group in self.adam.param_groups:
            group["lr"] = options.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / options.steps))
        self.adam.zero_grad()
        loss = (denoising_error(self.network, z0, ratio, noise) * weight(ratio)).mean() / self.scale
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), LARGEST_GRADIENT)
        self.adam.step()
        share = max(1 / (step + 1), 1 / options.average)
        with torch.no_grad():
            for mean, new in zip(self.averaged.parameters(), self.network.parameters()):
                mean.lerp_(new, share)
        self.losses.append(float(loss.detach()))
        return self.losses[-1]

    def keep(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        state = {
            "asked": self.asked,
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "adam": self.adam.state_dict(),
            "generator": self.generator.get_state(),
            "losses": self.losses,
        }
        new = path.with_suffix(".new")
        torch.save(state, new)
        os.replace(new, path)

    def restore(self, path: Path) -> None:
        """Raises ValueError if it is of another training."""
        state = torch.load(path, map_location=self.options.device, weights_only=True)
        if state["asked"] != self.asked:
            raise ValueError(f"{path} is of a training with other options; give them again, or another folder")
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self.adam.load_state_dict(state["adam"])
        self.generator.set_state(state["generator"].cpu())
        self.losses = list(state["losses"])


def denoising_error(
    network: SpaceTimeTransformer, z0: Float[Tensor, "b t 3 h w"], ratio: Float[Tensor, " b"], noise: Tensor
) -> Float[Tensor, " b"]:
    """|x0_hat - z0|^2 of every clip, whose first frame the network is told."""
    alpha = 1 / torch.sqrt(1 + ratio**2)
    sigma = ratio * alpha
    wide = lambda a: a[:, None, None, None, None]
    found = network(wide(alpha) * z0 + wide(sigma) * noise, z0[:, 0], alpha, sigma)
    return ((found - z0) ** 2).flatten(1).sum(1)


def weight(ratio: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    return 1 + (KNEE / ratio) ** 2


def motion(clips: UInt8[Tensor, "n t h w 3"]) -> float:
    """V: the mean over the clips of |z0 - still|^2."""
    total = 0.0
    for clip in clips.split(64):
        z0 = codes(clip)
        total += float(((z0 - z0[:, :1]) ** 2).sum())
    return max(total / len(clips), 1e-12)


def codes(clips: UInt8[Tensor, "n t h w 3"]) -> Float[Tensor, "n t 3 h w"]:
    """0..255 -> -1..1."""
    return clips.permute(0, 1, 4, 2, 3).float() / 127.5 - 1


def batch(clips: Tensor, count: int, generator: torch.Generator) -> Float[Tensor, "b t 3 h w"]:
    """Drawn with repetition, half of them mirrored, red, green and blue in any order."""
    which = torch.randint(len(clips), (count,), generator=generator)
    mirrored = torch.rand(count, generator=generator) < 0.5
    order = torch.rand(count, 3, generator=generator).argsort(1)
    z0 = codes(clips[which])
    z0 = torch.where(mirrored[:, None, None, None, None], z0.flip(-1), z0)
    return torch.gather(z0, 2, order[:, None, :, None, None].expand_as(z0))


def ratios(span: tuple[float, float], count: int, generator: torch.Generator) -> Float[Tensor, " b"]:
    """Uniform in the logarithm, one from each of `count` equal parts of the span."""
    low, high = (math.log(ratio) for ratio in span)
    share = (torch.arange(count) + torch.rand(count, generator=generator)) / count
    return torch.exp(low + (high - low) * share)


@torch.no_grad()
def draw(
    network: SpaceTimeTransformer,
    still: Float[Tensor, "b 3 h w"],
    *,
    ratio: tuple[float, float],
    steps: int,
    generator: torch.Generator,
) -> Float[Tensor, "b t 3 h w"]:
    """Clips that begin with these pictures: DDIM (Song et al. 2021, eq. 12 with no new noise) from the upper end of
    sigma/alpha to the lower one in equal steps of its logarithm, and the estimate there."""
    frames = network.architecture.frames
    z = torch.randn(len(still), frames, *still.shape[1:], generator=generator).to(still)
    found = z
    levels = torch.exp(torch.linspace(math.log(ratio[1]), math.log(ratio[0]), steps)).to(still)
    for i, r in enumerate(levels):
        alpha, sigma = (value.expand(len(still)) for value in (1 / torch.sqrt(1 + r**2), r / torch.sqrt(1 + r**2)))
        found = network(z, still, alpha, sigma)
        if i + 1 < len(levels):
            z = ddim(z, found, float(r), float(levels[i + 1]))
    return found


def ddim(z: Tensor, x0_hat: Tensor, ratio: float, next_ratio: float) -> Tensor:
    """One step: the same noise, less of it."""
    alpha, after = 1 / math.hypot(1, ratio), 1 / math.hypot(1, next_ratio)
    noise = (z - alpha * x0_hat) / (ratio * alpha)
    return after * x0_hat + next_ratio * after * noise
