"""tiny_video: a small diffusion model of clips that begin with a given first frame, trained by `make train-prior`.

    z0 = 2 x - 1 at the network's size                                      code [t, 3, h, w], there is no autoencoder
    z_t = alpha z0 + sigma n,   alpha^2 + sigma^2 = 1,   ln(sigma/alpha) between the ends of `ratio`
    x0_hat = network(z_t, first frame, ln(sigma/alpha))                     `space_time_transformer.py`

Its levels are high. A clip of 16 x 32 x 32 pixels in which a stem sways by some pixels is a point on a surface of three
or four dimensions (how fast, how far, to which side) in a space of 49152: that surface is seen through noise of many
times the contrast of a pixel, and below sigma = alpha nothing is left to be known but the clip itself.
"""

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from annotated_types import MinLen
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import Ascending, Device, Positive, Text, require_fields
from physics3d.priors.base import AbstractPrior, Level
from physics3d.priors.space_time_transformer import Architecture, SpaceTimeTransformer

CONFIG, WEIGHTS = "config.json", "model.safetensors"
OURS = Path(__file__).parent / "tiny_video_weights"  # come with the package


@dataclass(frozen=True, kw_only=True)
class TinyVideo(AbstractPrior):
    weights: Annotated[Text, MinLen(1)] | None = None  # folder that train-prior made; None: those of the package
    device: Device = "cpu"
    # sigma/alpha of the noise levels, spread uniformly in the logarithm
    ratio: Annotated[tuple[Positive, Positive], Ascending()] = (3.0, 30.0)

    needs_clip: ClassVar[bool] = False

    def __post_init__(self):
        require_fields(self, "prior")

    @property
    def folder(self) -> Path:
        """Raises ValueError where there are no weights."""
        folder = OURS if self.weights is None else Path(self.weights).expanduser()
        missing = [name for name in (CONFIG, WEIGHTS) if not (folder / name).is_file()]
        if missing:
            raise ValueError(
                f"prior.weights: {' and '.join(missing)} not in {folder}; make train-prior OUT=<folder> trains them in "
                "an hour or two, then set prior.weights=<folder>"
            )
        return folder

    def files(self) -> tuple[str, ...]:
        """Of the weights: part of the fingerprint of what is learned. Raises ValueError where there are none."""
        return tuple(str(self.folder / name) for name in (CONFIG, WEIGHTS))

    @cached_property
    def architecture(self) -> Architecture:
        """Raises ValueError as `folder` does."""
        return Architecture(**json.loads((self.folder / CONFIG).read_text())["architecture"])

    @property
    def trained_frames(self) -> int | None:
        """Of a clip that the network takes, neither more nor fewer."""
        return self.architecture.frames

    def require_frames(self, frames: int) -> None:
        if frames != self.trained_frames:
            raise ValueError(
                f"learn.frames is {frames}; tiny_video knows clips of {self.trained_frames} frames and no others: set "
                f"learn.frames={self.trained_frames}"
            )

    @cached_property
    def network(self) -> SpaceTimeTransformer:
        return load(self.folder).to(self.device)

    def condition(
        self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]
    ) -> Float[Tensor, "3 H W"]:
        """The first frame as a code; recorded clips are not used."""
        return self._small(first[None])[0].to(self.device)

    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t 3 H W"]:
        self.require_frames(len(video))
        return self._small(video)

    def level(self, share: float) -> Level:
        low, high = (math.log(ratio) for ratio in self.ratio)
        return level_of(math.exp(low + (high - low) * share))

    def x0_hat(self, z_t: Tensor, level: Level, condition: Float[Tensor, "3 H W"]) -> Float[Tensor, "t 3 H W"]:
        one = lambda value: torch.tensor([value], dtype=torch.float32, device=self.device)
        clip = z_t.to(device=self.device, dtype=torch.float32)[None]
        found = self.network(clip, condition.float()[None], one(level.alpha), one(level.sigma))
        return found[0].to(z_t)

    def _small(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t 3 H W"]:
        """The square in the middle, at the network's size, colours in -1..1."""
        height, width = video.shape[1:3]
        side, size = min(height, width), self.architecture.size
        top, left = (height - side) // 2, (width - side) // 2
        frames = video[:, top : top + side, left : left + side].permute(0, 3, 1, 2)
        if side != size:
            frames = torch.nn.functional.interpolate(
                frames, (size, size), mode="bilinear", antialias=True, align_corners=False
            )
        return 2 * frames - 1


def level_of(ratio: float) -> Level:
    """sigma/alpha -> the level with alpha^2 + sigma^2 = 1."""
    r = math.hypot(1.0, ratio)
    return Level(alpha=1 / r, sigma=ratio / r, time=math.log(ratio))


def save(network: SpaceTimeTransformer, folder: Path, about: dict[str, object]) -> None:
    """Write the weights, in half precision, and what is to be said about them; whole or not at all, weights first."""
    import os
    from dataclasses import asdict

    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    state = {name: value.detach().cpu().half().contiguous() for name, value in network.state_dict().items()}
    save_file(state, folder / f"{WEIGHTS}.new")
    os.replace(folder / f"{WEIGHTS}.new", folder / WEIGHTS)
    told = {"architecture": asdict(network.architecture), **about}
    (folder / f"{CONFIG}.new").write_text(json.dumps(told, indent=1) + "\n")
    os.replace(folder / f"{CONFIG}.new", folder / CONFIG)


def load(folder: Path) -> SpaceTimeTransformer:
    """The network of a folder, frozen, in single precision on the CPU. Raises ValueError if the files do not fit."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        network = SpaceTimeTransformer(Architecture(**json.loads((folder / CONFIG).read_text())["architecture"]))
        network.load_state_dict({name: value.float() for name, value in load_file(folder / WEIGHTS).items()})
    except (KeyError, TypeError, RuntimeError, OSError, ValueError, SafetensorError) as error:
        what = " ".join(str(error).split())[:200]
        raise ValueError(
            f"no weights of tiny_video can be read from {folder}: {what}; make train-prior again"
        ) from error
    return network.requires_grad_(False).eval()
