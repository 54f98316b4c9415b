"""Exposures of photographs, learned beside the Gaussians: image_i = g_i colour + b_i per channel.

The means over the photographs are held at ln g = 0, b = 0.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.rasterize import Rendered


class Exposure:
    """Gain and offset per photograph and channel [photographs, 3], and one step of Adam on those of one photograph."""

    def __init__(self, count: int, device: torch.device):
        self.values = torch.zeros(2, count, 3, device=device)  # ln of the gain, offset
        self.mean, self.square = torch.zeros_like(self.values), torch.zeros_like(self.values)

    def of(self, i: int) -> Float[Tensor, "2 3"]:
        return self.values[:, i].clone().requires_grad_()

    @staticmethod
    def applied(drawn: Rendered, values: Float[Tensor, "2 3"], behind: Float[Tensor, " 3"]) -> Float[Tensor, "h w 3"]:
        """The background is not part of the photograph: it keeps its colour."""
        beside = (1 - drawn.alpha)[..., None] * behind
        return torch.exp(values[0]) * (drawn.color - beside) + values[1] * drawn.alpha[..., None] + beside

    def step(self, i: int, gradient: Float[Tensor, "2 3"], size: float) -> None:
        # each photograph comes by rarely: its second moment forgets faster than the Gaussians'
        self.mean[:, i].lerp_(gradient, 0.2)
        self.square[:, i].lerp_(gradient.square(), 0.05)
        self.values[:, i] -= size * self.mean[:, i] / (self.square[:, i].sqrt() + 1e-12)
        self.values -= self.values.mean(1, keepdim=True)

    def state(self) -> tuple[Tensor, Tensor, Tensor]:
        """All that a checkpoint has to keep of it."""
        return self.values, self.mean, self.square

    def restore(self, state: tuple[Tensor, Tensor, Tensor]) -> None:
        self.values, self.mean, self.square = (part.to(self.values) for part in state)
