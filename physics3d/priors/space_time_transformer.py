"""A small transformer that takes noise off a clip whose first frame is known: how everything differs from that frame.

    d = z_t - alpha s        what is left of the noisy clip z_t when the still clip s, the first frame at all times, is
                             taken away: alpha (z0 - s) + sigma n
    x0_hat = s + f(d, s, ln(sigma/alpha))

f sees tokens of `patch` x `patch` pixels of `span` frames, d beside s; all tokens of the clip attend to each other. The
level of noise scales and shifts what every layer gets and gates what it adds (adaLN-Zero, Peebles and Xie 2023). f
begins as zero: before any training the network believes that nothing moves. It answers with the clip, not with noise or
v: a patch has more numbers than a token, and noise does not fit through, clips do (Li and He 2025, "Back to basics: let
denoising generative models denoise"). v = (alpha z_t - x0_hat)/sigma, where anybody needs it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from physics3d.checks import Count, Pixels, require_fields


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Sizes of the network and of the clips that it takes."""

    frames: Count = 16
    size: Pixels = 32  # of the square pictures [px]
    patch: Pixels = 8  # [px]
    span: Count = 2  # frames in a token
    width: Count = 128  # numbers that stand for a token, a multiple of 32
    layers: Count = 4

    def __post_init__(self):
        require_fields(self, "architecture")
        if self.size % self.patch:
            raise ValueError(f"architecture.patch is {self.patch}; take a divisor of architecture.size ({self.size})")
        if self.frames % self.span:
            raise ValueError(f"architecture.span is {self.span}; take a divisor of architecture.frames ({self.frames})")
        if self.width % HEAD:
            raise ValueError(f"architecture.width is {self.width}; take a multiple of {HEAD}")


HEAD = 32  # numbers of a token that one attention head sees
WAVES = 64  # numbers that tell the level of noise


class SpaceTimeTransformer(nn.Module):
    """f above, and x0_hat."""

    def __init__(self, architecture: Architecture):
        super().__init__()
        self.architecture = a = architecture
        pixels, side = 3 * a.patch**2, a.size // a.patch
        self.noisy, self.still = nn.Linear(a.span * pixels, a.width), nn.Linear(pixels, a.width)
        self.when = nn.Parameter(0.02 * torch.randn(a.frames // a.span, 1, a.width))
        self.where = nn.Parameter(0.02 * torch.randn(1, side**2, a.width))
        self.level = nn.Sequential(nn.Linear(WAVES, a.width), nn.SiLU(), nn.Linear(a.width, a.width), nn.SiLU())
        self.layers = nn.ModuleList(Layer(a.width) for _ in range(a.layers))
        self.last = nn.Linear(a.width, 2 * a.width)  # scale and shift before the answer
        self.answer = nn.Linear(a.width, a.span * pixels)
        for layer in (self.last, self.answer):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self,
        z_t: Float[Tensor, "b t 3 h w"],
        still: Float[Tensor, "b 3 h w"],
        alpha: Float[Tensor, " b"],
        sigma: Float[Tensor, " b"],
    ) -> Float[Tensor, "b t 3 h w"]:
        """x0_hat of clips with colours in -1..1."""
        frames = still[:, None].expand_as(z_t)
        patch, span = self.architecture.patch, self.architecture.span
        noisy = tokens(z_t - alpha[:, None, None, None, None] * frames, patch, span)
        x = self.noisy(noisy) + self.still(tokens(still[:, None], patch, 1)) + self.when + self.where
        b, t, n, width = x.shape
        x = x.reshape(b, t * n, width)
        level = self.level(waves(torch.log(sigma / alpha)))
        for layer in self.layers:
            x = layer(x, level)
        scale, shift = self.last(level)[:, None].chunk(2, -1)
        x = self.answer(norm(x) * (1 + scale) + shift)
        return frames + pictures(x.reshape(b, t, n, -1), patch, span).to(z_t.dtype)


class Layer(nn.Module):
    """Attention over all tokens, then a perceptron on each."""

    def __init__(self, width: int):
        super().__init__()
        self.level = nn.Linear(width, 6 * width)
        self.ask, self.attended = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.think = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width)
        )
        nn.init.zeros_(self.level.weight)
        nn.init.zeros_(self.level.bias)

    def forward(self, x: Float[Tensor, "b n w"], level: Float[Tensor, "b w"]) -> Float[Tensor, "b n w"]:
        scale_1, shift_1, gate_1, scale_2, shift_2, gate_2 = self.level(level)[:, None].chunk(6, -1)
        b, n, width = x.shape
        parts = self.ask(norm(x) * (1 + scale_1) + shift_1).reshape(b, n, 3, width // HEAD, HEAD)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        seen = nn.functional.scaled_dot_product_attention(query, key, value)
        x = x + gate_1 * self.attended(seen.transpose(1, 2).reshape(b, n, width))
        return x + gate_2 * self.think(norm(x) * (1 + scale_2) + shift_2)


def norm(x: Tensor) -> Tensor:
    """Every token to mean 0 and variance 1."""
    return nn.functional.layer_norm(x, x.shape[-1:])


def waves(level: Float[Tensor, " b"]) -> Float[Tensor, "b k"]:
    """Sines and cosines of ln(sigma/alpha), of periods from 2 pi to 2 pi/20."""
    angle = level[:, None] * torch.exp(torch.linspace(0, math.log(20.0), WAVES // 2)).to(level)
    return torch.cat([angle.sin(), angle.cos()], 1)


def tokens(x: Float[Tensor, "b t 3 h w"], patch: int, span: int) -> Float[Tensor, "b k n d"]:
    """Blocks of `span` frames and of patches, row by row."""
    b, t, c, h, w = x.shape
    x = x.reshape(b, t // span, span, c, h // patch, patch, w // patch, patch)
    x = x.permute(0, 1, 4, 6, 2, 3, 5, 7)
    return x.reshape(b, t // span, (h // patch) * (w // patch), span * c * patch**2)


def pictures(x: Float[Tensor, "b k n d"], patch: int, span: int) -> Float[Tensor, "b t 3 h w"]:
    """The inverse of `tokens`, of square pictures."""
    b, k, n, _ = x.shape
    side = math.isqrt(n)
    x = x.reshape(b, k, side, side, span, 3, patch, patch)
    return x.permute(0, 1, 4, 5, 2, 6, 3, 7).reshape(b, k * span, 3, side * patch, side * patch)
