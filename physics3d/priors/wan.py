"""Wan (Wan Team 2025): text to video, or text and first image to video, by flow matching.

    z0 = (VAE.encode(2 x - 1).mode() - mean) / std             code [1 + (t - 1)/4, c, h/p, w/p], p = 8 or 16
    z_t = (1 - s) z0 + s n,   out = uncond + guidance (cond - uncond),   x0_hat = z_t - s out
    s(u) = k u / (1 + (k - 1) u),   time = 1000 s              u uniform, k the shift of the weights' schedule

The VAE is causal in time: its first code is of the first frame alone, every other one of four frames and all before
them, so that clips have 4 n + 1 frames. A model that takes an image (2.2 TI2V) has the image's code in the place of
the first one, and is told that there the time is 0.

The sentence is read once, by an encoder of 5.7e9 parameters: on the CPU, for its few words are quickly read and its
weights would not be worth moving to a GPU, and it is gone before the other weights are loaded. What fills the memory
after that is the VAE's way back to the pixels. It goes in pieces of four frames, layer by layer: what each hands to
the next is kept, all else recomputed.
"""

import gc
import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Annotated, Any, NamedTuple

import torch
from annotated_types import MultipleOf
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from physics3d.checks import Ascending, Device, Frames, Pixels, Share, Text, require_fields
from physics3d.priors.base import AbstractPrior, Level, x0_from
from physics3d.priors.memory import Memory, encoding, estimating, lent, parameter_bytes, together
from physics3d.priors.weights import Precision, hollow_pipeline, load_pipeline, pipeline_files

WORDS = 512  # of a sentence, as the networks were trained; shorter ones are followed by zeros
PIECE = 4  # frames that make one code
TOKENS = ("tokenizer",)
READER = ("text_encoder", "tokenizer")
REST = ("transformer", "transformer_2", "vae")


class WanCondition(NamedTuple):
    text: Tensor  # [2, WORDS, c] of the empty sentence and of the prompt
    first: Tensor | None  # [1, c, h/p, w/p] code of the first image


@dataclass(frozen=True, kw_only=True)
class Wan(AbstractPrior):
    prompt: Text  # what is seen and how it moves, e.g. "a carnation sways gently after being poked"
    model: Text = "Wan-AI/Wan2.1-T2V-1.3B-Diffusers"  # folder or hub repository
    first_image: bool = False  # whether it is told the first image too; Wan2.2-TI2V-5B takes one
    clip_frames: Frames = 81  # of the clips that it was trained on; 2.2: 121
    precision: Precision = "bfloat16"  # of the network and the text encoder; float32 on a CPU
    vae_precision: Precision = "bfloat16"  # of the VAE, from the pixels and back; float32 takes twice as much
    offload: bool = False  # whether the network waits in the machine's memory while the VAE works
    device: Device = "cuda"
    height: Annotated[Pixels, MultipleOf(16)] = 480  # what the network sees [px]; 2.2: a multiple of 32
    width: Annotated[Pixels, MultipleOf(16)] = 832
    guidance: float = 5.0
    # range of the schedule u that is drawn from, uniformly
    time: Annotated[tuple[Share, Share], Ascending()] = (0.02, 0.98)

    def __post_init__(self):
        require_fields(self, "prior")

    def files(self) -> tuple[str, ...]:
        """Of the weights, fetched if they are not on this machine: part of the fingerprint of what is learned."""
        from diffusers import WanPipeline

        return pipeline_files(WanPipeline, self.model, key="prior.model", variant=None)

    @property
    def dtypes(self) -> dict[str, torch.dtype]:
        return {"default": getattr(torch, self.precision), "vae": getattr(torch, self.vae_precision)}

    @cached_property
    def pipeline(self) -> Any:
        """Without the text encoder."""
        from diffusers import WanPipeline

        pipe = self.suited(
            load_pipeline(WanPipeline, self.model, key="prior.model", dtype=self.dtypes, variant=None, without=READER)
        )
        for module in (pipe.vae, pipe.transformer):
            module.requires_grad_(False).eval()
        for module in (pipe.vae,) if self.offload else (pipe.vae, pipe.transformer):
            module.to(self.device)
        return pipe

    def suited(self, pipe: Any) -> Any:
        """The pipeline without its decoder, and with an encoder that recomputes. Raises ValueError if it is of another
        kind than these options say."""
        if pipe.transformer is None or pipe.transformer_2 is not None:
            raise ValueError(
                f"prior.model={self.model} has two networks, one for each half of the schedule; take one that has one, "
                "Wan-AI/Wan2.1-T2V-1.3B-Diffusers or Wan-AI/Wan2.2-TI2V-5B-Diffusers"
            )
        if self.first_image and not pipe.config.expand_timesteps:
            raise ValueError(
                f"prior.first_image is true, but prior.model={self.model} is told no image as its first code; take "
                "Wan-AI/Wan2.2-TI2V-5B-Diffusers, or prior.first_image=false"
            )
        if pipe.transformer.config.in_channels != pipe.vae.config.z_dim:
            raise ValueError(
                f"prior.model={self.model} takes {pipe.transformer.config.in_channels} channels, its codes have "
                f"{pipe.vae.config.z_dim}: it wants more than a video and a sentence; take "
                "Wan-AI/Wan2.1-T2V-1.3B-Diffusers or Wan-AI/Wan2.2-TI2V-5B-Diffusers"
            )
        for name, patch in zip(("height", "width"), pipe.transformer.config.patch_size[1:]):
            size, unit = getattr(self, name), pipe.vae.config.scale_factor_spatial * patch
            if size % unit:
                raise ValueError(f"prior.{name} is {size}; take a multiple of {unit} for prior.model={self.model}")
        pipe.vae.decoder, encoder = None, pipe.vae.encoder
        encoder.down_blocks = nn.ModuleList(map(Recomputed, encoder.down_blocks))
        encoder.mid_block = Recomputed(encoder.mid_block)
        return pipe

    def memory(self, frames: int) -> Memory:
        return needed(self, frames)

    @cached_property
    def embedding(self) -> Float[Tensor, "2 l c"]:
        """Of the empty sentence and of the prompt."""
        from diffusers import WanPipeline

        pipe = load_pipeline(
            WanPipeline, self.model, key="prior.model", dtype=self.dtypes["default"], variant=None, without=REST
        )
        # no longer than it is: what pads a sentence is masked from it, and takes as long to read
        length = min(WORDS, max(len(pipe.tokenizer(text).input_ids) for text in (self.prompt, "")))
        with torch.no_grad():
            given, none = pipe.encode_prompt(self.prompt, "", max_sequence_length=length, device=torch.device("cpu"))
        del pipe
        gc.collect()  # a pipeline refers to itself: its gigabytes would stay for a while
        return torch.nn.functional.pad(torch.cat([none, given]), (0, 0, 0, WORDS - length)).to(self.device)

    @torch.no_grad()
    def condition(self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]) -> WanCondition:
        """The embedded sentence and, with `first_image`, the code of the image; the clips are not used."""
        text = self.embedding  # before the other weights are loaded
        return WanCondition(text, self.code(first[None]) if self.first_image else None)

    @property
    def trained_frames(self) -> int:
        return self.clip_frames

    def require_frames(self, frames: int) -> None:
        if frames % 4 != 1 or frames == 1:
            below = max(5, frames - (frames - 1) % 4)
            near = f"{below} or {below + 4}" if frames > 5 else f"{below}"
            raise ValueError(
                f"learn.frames is {frames}; Wan takes 4 n + 1 of them: take {near} (it was trained on "
                f"{self.clip_frames})"
            )

    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "T c H W"]:
        self.require_frames(len(video))
        return self.code(video)

    def code(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "T c H W"]:
        vae = self.pipeline.vae
        frames = torch.nn.functional.interpolate(
            video.permute(0, 3, 1, 2), (self.height, self.width), mode="bilinear", antialias=True, align_corners=False
        )
        pixels = (2 * frames - 1).to(vae.device, vae.dtype).transpose(0, 1)[None]
        means = encoded(vae, pixels)[0, : vae.config.z_dim].float().transpose(0, 1)  # then as many log variances
        mean, std = (
            torch.tensor(v).to(means)[:, None, None] for v in (vae.config.latents_mean, vae.config.latents_std)
        )
        return (means - mean) / std

    def level(self, share: float) -> Level:
        schedule = self.pipeline.scheduler.config
        shift = schedule.get("flow_shift", schedule.get("shift"))
        u = self.time[0] + (self.time[1] - self.time[0]) * share
        sigma = shift * u / (1 + (shift - 1) * u)
        return Level(alpha=1 - sigma, sigma=sigma, time=schedule.num_train_timesteps * sigma)

    def x0_hat(self, z_t: Tensor, level: Level, condition: WanCondition) -> Tensor:
        pipe, first = self.pipeline, condition.first
        sample, time = z_t, torch.tensor([level.time])
        if first is not None:
            sample = torch.cat([first, z_t[1:]])
            patch = pipe.transformer.config.patch_size
            T, _, H, W = z_t.shape
            time = torch.full((T // patch[0], H // patch[1] * W // patch[2]), level.time)
            time[0] = 0  # known without noise
            time = time.reshape(1, -1)
        with lent(pipe.transformer, self.device, back=self.offload) as network:
            # not that of its first parameter: some are kept in float32
            video = sample.transpose(0, 1)[None].to(pipe.transformer.dtype)
            # one after the other: half the memory of both at once
            without, given = (
                network(video, time.to(video.device), text[None].to(video), return_dict=False)[0][0].float()
                for text in condition.text
            )
        out = (without + self.guidance * (given - without)).transpose(0, 1)
        estimate = x0_from(pipe.scheduler.config.get("prediction_type", "flow_prediction"), out, z_t, level)
        return estimate if first is None else torch.cat([first, estimate[1:]])


def encoded(vae: Any, pixels: Float[Tensor, "1 3 t h w"]) -> Float[Tensor, "1 c T H W"]:
    """Means and log variances, as the VAE's own `_encode` gives them, with little memory for the way back.

    Every causal convolution keeps the last frames that it saw for the next piece. Pieces are recomputed in groups of
    about sqrt(n), then one by one, then layer by layer: what is kept after 2 sqrt(n) pieces is in memory at once.
    """
    from diffusers.models.autoencoders.autoencoder_kl_wan import WanCausalConv3d, patchify

    if vae.config.patch_size is not None:
        pixels = patchify(pixels, vae.config.patch_size)
    first, rest = pixels[:, :, :1], pixels[:, :, 1:]
    pieces = [first, *(rest.split(PIECE, 2) if rest.shape[2] else ())]
    kept: list[Any] = [None] * sum(isinstance(m, WanCausalConv3d) for m in vae.encoder.modules())
    many = math.ceil(math.sqrt(len(pieces)))
    codes = []
    for i in range(0, len(pieces), many):
        code, kept = checkpoint(group, vae.encoder, pieces[i : i + many], kept, use_reentrant=False)
        codes += code
    return vae.quant_conv(torch.cat(codes, 2))


def group(encoder: Any, pieces: list[Tensor], kept: list[Any]) -> tuple[list[Tensor], list[Any]]:
    """Codes of pieces that follow each other, and what the convolutions keep for the next one."""
    codes = []
    for piece in pieces:
        code, kept = checkpoint(one, encoder, piece, kept, use_reentrant=False)
        codes.append(code)
    return codes, kept


def one(encoder: Any, piece: Tensor, kept: list[Any]) -> tuple[Tensor, list[Any]]:
    kept = list(kept)  # the encoder writes into it, and is run several times
    return encoder(piece, feat_cache=kept, feat_idx=[0]), kept


class Recomputed(nn.Module):
    """A layer of the encoder whose activations are recomputed on the way back."""

    def __init__(self, layer: nn.Module):
        super().__init__()
        self.layer = layer

    def forward(self, x: Tensor, feat_cache: list[Any], feat_idx: list[int]) -> Tensor:
        def run(x: Tensor, kept: list[Any], at: int) -> tuple[Tensor, list[Any], int]:
            kept, index = list(kept), [at]
            return self.layer(x, feat_cache=kept, feat_idx=index), kept, index[0]

        x, feat_cache[:], feat_idx[0] = checkpoint(run, x, list(feat_cache), feat_idx[0], use_reentrant=False)
        return x


@cache
def needed(prior: Wan, frames: int) -> Memory:
    """Two pieces and two blocks of the network are rehearsed: the others are as large."""
    from diffusers import WanPipeline

    pipe = prior.suited(
        hollow_pipeline(WanPipeline, prior.model, key="prior.model", dtype=prior.dtypes, variant=None, without=TOKENS)
    )
    text, network, vae = map(parameter_bytes, (pipe.text_encoder, pipe.transformer, pipe.vae))
    pipe.transformer.blocks = pipe.transformer.blocks[:2]
    twin = replace(prior, offload=False)
    words = torch.zeros(2, WORDS, pipe.transformer.config.text_dim, device="meta", dtype=pipe.transformer.dtype)
    vars(twin).update(pipeline=pipe, embedding=words)
    scale = pipe.vae.config.scale_factor_spatial
    pieces = 1 + (frames - 1) // PIECE
    groups = math.ceil(math.sqrt(pieces))
    video = frames * prior.height * prior.width * 3 * 4
    kept = 2 * kept_bytes(pipe.vae, prior.height, prior.width)
    way_back = encoding(twin, 1 + PIECE) + video + (groups - 1) * kept
    code = (pieces, pipe.vae.config.z_dim, prior.height // scale, prior.width // scale)
    forth = estimating(twin, code) + video + groups * kept // 2
    return together(
        prior.device,
        offload=prior.offload,
        always=vae,
        network=network,
        way_back=way_back,
        forth=forth,
        beside=text,
    )


def kept_bytes(vae: Any, height: int, width: int) -> int:
    """What the convolutions keep after a piece of a video of that size, the VAE being on the meta device [byte]."""
    kept: list[Any] = [None] * len(list(vae.encoder.modules()))
    patch = vae.config.patch_size or 1
    size = (1, vae.config.in_channels, PIECE, height // patch, width // patch)
    with torch.no_grad():
        for frames in (1, PIECE):
            _, kept = one(vae.encoder, torch.zeros(size, dtype=vae.dtype, device="meta")[:, :, :frames], kept)
    return sum(k.numel() * k.element_size() for k in kept if k is not None)
