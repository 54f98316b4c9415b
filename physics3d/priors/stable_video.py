"""Stable Video Diffusion (Blattmann et al. 2023): image to video, a v_prediction network in Karras' sigma space
(alpha = 1).

    z0 = VAE.encode(2 x - 1).mode() * scaling_factor                               code [t, 4, h/8, w/8]
    out = UNet(z_t / sqrt(s^2 + 1) beside the image's code, time ln(s)/4, CLIP embedding of the image,
               [fps - 1, motion bucket, noise strength])
    x0_hat = z_t / (s^2 + 1) - s out / sqrt(s^2 + 1)

The image's code is not scaled and is that of image + noise_strength * n. The unconditional branch has zeros for the
CLIP embedding and the image's code; guidance rises linearly over the frames. As in diffusers' pipeline, but as one
call with a gradient through the encoder.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Annotated, Any, NamedTuple

import torch
from annotated_types import Ge, Le, MultipleOf
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from physics3d.checks import Ascending, Device, NotNegative, Pixels, Positive, Rate, Text, require_fields
from physics3d.priors.base import AbstractPrior, Level, x0_from
from physics3d.priors.memory import Memory, encoding, estimating, lent, parameter_bytes, together
from physics3d.priors.weights import Precision, hollow_pipeline, load_pipeline, pipeline_files, pipeline_folder


class ImageCondition(NamedTuple):
    embedding: Tensor  # [1, 1, c] CLIP
    latent: Tensor  # [4, h/8, w/8], unscaled


@dataclass(frozen=True, kw_only=True)
class StableVideo(AbstractPrior):
    # folder or hub repository; trained on 14 frames (-xt: 25)
    model: Text = "stabilityai/stable-video-diffusion-img2vid"
    variant: Text | None = "fp16"  # which weight files; None for the plain ones
    precision: Precision = "float16"  # float32 on a CPU
    offload: bool = False  # whether the networks wait in the machine's memory while the VAE works
    device: Device = "cuda"
    height: Annotated[Pixels, MultipleOf(8)] = 576  # what the network sees [px]
    width: Annotated[Pixels, MultipleOf(8)] = 1024
    fps: Annotated[Rate, Ge(1)] = 7.0  # [1/s], told to the network
    motion_bucket: Annotated[int, Ge(0), Le(255)] = 127  # how much motion to expect
    noise_strength: NotNegative = 0.02  # noise on the conditioning image
    guidance: tuple[float, float] = (1.0, 3.0)  # first and last frame
    # noise levels, drawn uniformly in the logarithm
    sigma: Annotated[tuple[Positive, Positive], Ascending()] = (0.3, 30.0)

    def __post_init__(self):
        require_fields(self, "prior")

    def files(self) -> tuple[str, ...]:
        """Of the weights, fetched if they are not on this machine: part of the fingerprint of what is learned."""
        from diffusers import StableVideoDiffusionPipeline

        return pipeline_files(StableVideoDiffusionPipeline, self.model, key="prior.model", variant=self.variant)

    @cached_property
    def pipeline(self) -> Any:
        from diffusers import StableVideoDiffusionPipeline

        dtype = getattr(torch, self.precision)
        pipe = load_pipeline(
            StableVideoDiffusionPipeline, self.model, key="prior.model", dtype=dtype, variant=self.variant
        )
        for module in (pipe.unet, pipe.vae, pipe.image_encoder):
            module.requires_grad_(False).eval()
            if module is pipe.vae or not self.offload:
                module.to(self.device)
        return pipe

    def memory(self, frames: int) -> Memory:
        return needed(self, frames)

    @torch.no_grad()
    def condition(self, first: Float[Tensor, "h w 3"], clips: tuple[Float[Tensor, "t h w 3"], ...]) -> ImageCondition:
        """CLIP embedding and code of the first image; the recorded clips are not used."""
        pipe, like = self.pipeline, next(self.pipeline.vae.parameters())
        image = self.resize(first[None]).to(like)
        size = pipe.feature_extractor.crop_size
        small = torch.nn.functional.interpolate(
            image.float(), (size["height"], size["width"]), mode="bicubic", antialias=True, align_corners=False
        )
        mean, std = (
            torch.tensor(v).to(small)[:, None, None]
            for v in (pipe.feature_extractor.image_mean, pipe.feature_extractor.image_std)
        )
        with lent(pipe.image_encoder, self.device, back=self.offload) as encoder:
            embedding = encoder(((small - mean) / std).to(like)).image_embeds[:, None]
        noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0)).to(image)
        latent = pipe.vae.encode(2 * image - 1 + self.noise_strength * noise).latent_dist.mode()[0]
        return ImageCondition(embedding, latent)

    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t c H W"]:
        if len(video) < 2:
            raise ValueError(
                "Stable Video Diffusion needs at least 2 frames; raise learn.frames (it was trained on 14 or 25)"
            )
        vae, like = self.pipeline.vae, next(self.pipeline.vae.parameters())
        frames = 2 * self.resize(video).to(like) - 1
        # frame by frame, its activations recomputed in the backward pass: the encoder is what fills the memory
        codes = [checkpoint(lambda x: vae.encode(x).latent_dist.mode(), f[None], use_reentrant=False) for f in frames]
        return torch.cat(codes).float() * vae.config.scaling_factor

    def resize(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t 3 H W"]:
        return torch.nn.functional.interpolate(
            video.permute(0, 3, 1, 2), (self.height, self.width), mode="bilinear", antialias=True, align_corners=False
        )

    @property
    def trained_frames(self) -> int:
        """As the configuration beside its weights says: 14, or 25 of the one that ends in -xt."""
        from diffusers import StableVideoDiffusionPipeline, UNetSpatioTemporalConditionModel

        folder = pipeline_folder(StableVideoDiffusionPipeline, self.model, key="prior.model", variant=self.variant)
        return int(UNetSpatioTemporalConditionModel.load_config(folder, subfolder="unet")["num_frames"])

    def level(self, share: float) -> Level:
        low, high = (math.log(s) for s in self.sigma)
        sigma = math.exp(low + (high - low) * share)
        return Level(alpha=1.0, sigma=sigma, time=math.log(sigma) / 4)

    def x0_hat(self, z_t: Tensor, level: Level, condition: ImageCondition) -> Tensor:
        pipe, like = self.pipeline, condition.latent
        sample = (z_t / math.hypot(1.0, level.sigma)).to(like)
        latent = condition.latent.expand(len(z_t), -1, -1, -1)
        both = torch.stack([torch.cat([sample, torch.zeros_like(latent)], 1), torch.cat([sample, latent], 1)])
        embedding = torch.cat([torch.zeros_like(condition.embedding), condition.embedding])
        ids = torch.tensor([[self.fps - 1, self.motion_bucket, self.noise_strength]] * 2).to(like)
        time = torch.tensor(level.time).to(like)
        with lent(pipe.unet, self.device, back=self.offload) as unet:
            without, given = unet(both, time, encoder_hidden_states=embedding, added_time_ids=ids, return_dict=False)[
                0
            ].float()
        scale = torch.linspace(*self.guidance, len(z_t)).to(given)[:, None, None, None]
        return x0_from(pipe.scheduler.config.prediction_type, without + scale * (given - without), z_t, level)


@cache
def needed(prior: StableVideo, frames: int) -> Memory:
    """All frames wait for the way back of one."""
    from diffusers import StableVideoDiffusionPipeline

    dtype = getattr(torch, prior.precision)
    pipe = hollow_pipeline(
        StableVideoDiffusionPipeline, prior.model, key="prior.model", dtype=dtype, variant=prior.variant
    )
    twin = replace(prior, offload=False)
    vars(twin).update(pipeline=pipe)
    vae, unet, clip = map(parameter_bytes, (pipe.vae, pipe.unet, pipe.image_encoder))
    video = 2 * 4 * frames * 3 * prior.height * prior.width
    scale = 2 ** (len(pipe.vae.config.block_out_channels) - 1)
    code = (frames, pipe.vae.config.latent_channels, prior.height // scale, prior.width // scale)
    return together(
        prior.device,
        offload=prior.offload,
        always=vae,
        network=unet if prior.offload else unet + clip,
        way_back=encoding(twin, 2) + video,
        forth=estimating(twin, code) + video,
    )
