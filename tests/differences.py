"""A gradient against central differences, in double precision."""

import torch


def derivative(loss, inputs: dict[str, torch.Tensor], name: str, direction: torch.Tensor, step: float) -> float:
    with torch.no_grad():
        ahead = loss(**(inputs | {name: inputs[name] + step * direction}))
        behind = loss(**(inputs | {name: inputs[name] - step * direction}))
    return float(ahead - behind) / (2 * step)


def compare(loss, inputs: dict[str, torch.Tensor], *, tolerance: float) -> None:
    """Adjoint against central differences along one random direction per input."""
    generator = torch.Generator().manual_seed(1)
    inputs = {name: value.double().requires_grad_() for name, value in inputs.items()}
    gradients = torch.autograd.grad(loss(**inputs), list(inputs.values()))
    for (name, value), gradient in zip(inputs.items(), gradients):
        assert torch.isfinite(gradient).all(), name
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        scale = float(value.detach().abs().max().clamp(min=0.1))
        # differences of two step sizes tell their own error: truncation and round-off
        coarse, fine = (derivative(loss, inputs, name, direction, scale * h) for h in (4e-6, 2e-6))
        adjoint = float((gradient * direction).sum())
        noise = 2 * abs(coarse - fine)
        assert abs(adjoint - fine) <= tolerance * abs(fine) + noise, (name, adjoint, coarse, fine)
        assert noise <= 1e-5 * abs(fine) + 1e-12, f"{name}: the differences {coarse}, {fine} are no reference"
