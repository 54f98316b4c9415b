"""A prior of which everything is known: videos are normal around a mean, every pixel by itself.

x ~ N(m, s^2 I),  alpha = 1   =>   x0_hat(z_t) = (s^2 z_t + sigma^2 m) / (s^2 + sigma^2)
                                   z0 - E_n x0_hat = c (z0 - m),   c = sigma^2 / (s^2 + sigma^2)
"""

import math
from dataclasses import dataclass

import torch

from physics3d.priors.base import AbstractPrior, Level


@dataclass(frozen=True, kw_only=True)
class GaussianPrior(AbstractPrior):
    mean: torch.Tensor  # [t, h, w, 3]
    deviation: float = 0.5
    sigma: tuple[float, float] = (0.2, 5.0)  # uniform in the logarithm
    frames: int | None = None

    @property
    def trained_frames(self):
        return self.frames

    def condition(self, first, clips):
        return None

    def encode(self, video):
        return video

    def level(self, share):
        return Level(alpha=1.0, sigma=self.sigma[0] * (self.sigma[1] / self.sigma[0]) ** share)

    def x0_hat(self, z_t, level, condition):
        s2, n2 = self.deviation**2, level.sigma**2
        return (s2 * z_t + n2 * self.mean.to(z_t)) / (s2 + n2)

    def shrinkage(self, share: float) -> float:
        """w c of the level at that share: what a step takes off z0 - m."""
        level = self.level(share)
        return self.weight(level) * level.sigma**2 / (self.deviation**2 + level.sigma**2)

    def expected(self) -> float:
        """The mean of that over all levels, by quadrature."""
        from scipy.integrate import quad

        return quad(self.shrinkage, 0, 1, epsabs=1e-10)[0]

    def expected_loss(self, video: torch.Tensor) -> float:
        """Of w/2 |z0 - x0_hat|^2 over levels and noise: bias and variance of the shrunken estimate."""
        from scipy.integrate import quad

        off = float(((video - self.mean.to(video)) ** 2).sum())

        def at(share: float) -> float:
            level = self.level(share)
            s2, n2 = self.deviation**2, level.sigma**2
            c = n2 / (s2 + n2)
            return 0.5 * self.weight(level) * (c**2 * off + video.numel() * (1 - c) ** 2 * n2)

        return quad(at, 0, 1, epsabs=1e-10)[0]

    def __hash__(self):
        return id(self)


def waving(shape: tuple[int, ...]) -> torch.Tensor:
    """A video in which everything moves."""
    t, h, w, c = shape
    time = torch.arange(t, dtype=torch.float64)[:, None, None, None]
    x = torch.arange(h * w * c, dtype=torch.float64).reshape(1, h, w, c)
    return 0.5 + 0.4 * torch.sin(x + 2 * math.pi * time / t)
