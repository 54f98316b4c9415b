"""ModelScope text to video (Wang et al. 2023): an epsilon network on the variance-preserving schedule, guided by a
sentence.

    z0 = VAE.encode(2 x - 1).mode() * scaling_factor                   code [t, 4, h/8, w/8]
    alpha_t = sqrt(abar_t), sigma_t = sqrt(1 - abar_t)
    out = uncond + guidance (cond - uncond),   x0_hat = (z_t - sigma_t out) / alpha_t

diffusers keeps its pipeline under `pipelines.deprecated`; weights and networks are unchanged.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Annotated, Any

import torch
from annotated_types import MultipleOf
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from physics3d.checks import Ascending, Device, Pixels, Share, Text, require_fields
from physics3d.priors.base import AbstractPrior, Level, x0_from
from physics3d.priors.memory import Memory, encoding, estimating, lent, parameter_bytes, together
from physics3d.priors.weights import Precision, hollow_pipeline, load_pipeline, pipeline_files


@dataclass(frozen=True, kw_only=True)
class ModelScope(AbstractPrior):
    prompt: Text  # what is seen and how it moves, e.g. "a carnation sways gently after being poked"
    model: Text = "ali-vilab/text-to-video-ms-1.7b"  # folder or hub repository
    variant: Text | None = "fp16"  # which weight files; None for the plain ones
    precision: Precision = "float16"  # float32 on a CPU
    offload: bool = False  # whether the networks wait in the machine's memory while the VAE works
    device: Device = "cuda"
    height: Annotated[Pixels, MultipleOf(8)] = 256  # what the network sees [px]
    width: Annotated[Pixels, MultipleOf(8)] = 256
    guidance: float = 9.0
    # range of the schedule that is drawn from, uniformly
    time: Annotated[tuple[Share, Share], Ascending()] = (0.02, 0.98)

    def __post_init__(self):
        require_fields(self, "prior")

    def files(self) -> tuple[str, ...]:
        """Of the weights, fetched if they are not on this machine: part of the fingerprint of what is learned."""
        from diffusers.pipelines.deprecated.text_to_video_synthesis import TextToVideoSDPipeline

        return pipeline_files(TextToVideoSDPipeline, self.model, key="prior.model", variant=self.variant)

    @cached_property
    def pipeline(self) -> Any:
        from diffusers.pipelines.deprecated.text_to_video_synthesis import TextToVideoSDPipeline

        dtype = getattr(torch, self.precision)
        pipe = load_pipeline(TextToVideoSDPipeline, self.model, key="prior.model", dtype=dtype, variant=self.variant)
        for module in (pipe.unet, pipe.vae, pipe.text_encoder):
            module.requires_grad_(False).eval()
            if module is pipe.vae or not self.offload:
                module.to(self.device)
        return pipe

    def memory(self, frames: int) -> Memory:
        return needed(self, frames)

    @cached_property
    def embedding(self) -> Float[Tensor, "2 l c"]:
        """Of the empty sentence and of the prompt."""
        with torch.no_grad(), lent(self.pipeline.text_encoder, self.device, back=self.offload):
            given, without = self.pipeline.encode_prompt(self.prompt, self.device, 1, True, "")
        return torch.cat([without, given])

    def condition(self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]) -> Tensor:
        """The embedded sentence; neither the image nor the clips are used."""
        return self.embedding

    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t c H W"]:
        if len(video) < 2:
            raise ValueError("ModelScope needs at least 2 frames; raise learn.frames (it was trained on 16)")
        vae, like = self.pipeline.vae, next(self.pipeline.vae.parameters())
        frames = torch.nn.functional.interpolate(
            video.permute(0, 3, 1, 2), (self.height, self.width), mode="bilinear", antialias=True, align_corners=False
        )
        # frame by frame, its activations recomputed in the backward pass: the encoder is what fills the memory
        codes = [
            checkpoint(lambda x: vae.encode(x).latent_dist.mode(), f[None], use_reentrant=False)
            for f in 2 * frames.to(like) - 1
        ]
        return torch.cat(codes).float() * vae.config.scaling_factor

    @property
    def trained_frames(self) -> int:
        return 16

    def level(self, share: float) -> Level:
        schedule = self.pipeline.scheduler.alphas_cumprod
        low, high = (round(t * (len(schedule) - 1)) for t in self.time)
        index = min(low + int(share * (high + 1 - low)), high)
        return Level(alpha=math.sqrt(schedule[index]), sigma=math.sqrt(1 - schedule[index]), time=float(index))

    def x0_hat(self, z_t: Tensor, level: Level, condition: Tensor) -> Tensor:
        with lent(self.pipeline.unet, self.device, back=self.offload) as unet:
            like = next(unet.parameters())
            both = z_t.transpose(0, 1)[None].expand(2, -1, -1, -1, -1).to(like)  # the network wants [batch, c, t, h, w]
            time = torch.tensor(level.time).to(like.device)
            out = unet(both, time, encoder_hidden_states=condition.to(like), return_dict=False)[0].float()
        without, given = out.transpose(1, 2)
        return x0_from(
            self.pipeline.scheduler.config.prediction_type, without + self.guidance * (given - without), z_t, level
        )


@cache
def needed(prior: ModelScope, frames: int) -> Memory:
    """All frames wait for the way back of one."""
    from diffusers.pipelines.deprecated.text_to_video_synthesis import TextToVideoSDPipeline

    dtype = getattr(torch, prior.precision)
    pipe = hollow_pipeline(TextToVideoSDPipeline, prior.model, key="prior.model", dtype=dtype, variant=prior.variant)
    words = (2, pipe.tokenizer.model_max_length, pipe.text_encoder.config.hidden_size)
    twin = replace(prior, offload=False)
    vars(twin).update(pipeline=pipe, embedding=torch.zeros(words, device="meta", dtype=dtype))
    vae, unet, text = map(parameter_bytes, (pipe.vae, pipe.unet, pipe.text_encoder))
    video = 2 * 4 * frames * 3 * prior.height * prior.width
    scale = 2 ** (len(pipe.vae.config.block_out_channels) - 1)
    code = (frames, pipe.vae.config.latent_channels, prior.height // scale, prior.width // scale)
    return together(
        prior.device,
        offload=prior.offload,
        always=vae,
        network=unet if prior.offload else unet + text,
        way_back=encoding(twin, 2) + video,
        forth=estimating(twin, code) + video,
    )
