"""A gradient against central differences, in double precision."""

import torch


def derivative(loss, inputs: dict[str, torch.Tensor], directions: dict[str, torch.Tensor], step: float) -> float:
    with torch.no_grad():
        ahead = loss(**{name: value + step * directions[name] for name, value in inputs.items()})
        behind = loss(**{name: value - step * directions[name] for name, value in inputs.items()})
    return float(ahead - behind) / (2 * step)


def compare(loss, inputs: dict[str, torch.Tensor], *, tolerance: float) -> None:
    """Adjoint against central differences along one random direction of all inputs together.

    Each goes its way to its own scale, less far if the loss feels it more than others and in the sense in which the
    loss grows: all have the same share of the derivative, none hides behind another and none cancels another."""
    generator = torch.Generator().manual_seed(1)
    inputs = {name: value.double().requires_grad_() for name, value in inputs.items()}
    gradients = torch.autograd.grad(loss(**inputs), list(inputs.values()))
    directions, felt = {}, {}
    for (name, value), gradient in zip(inputs.items(), gradients):
        assert torch.isfinite(gradient).all(), name
        scale = float(value.detach().abs().max().clamp(min=0.1))
        directions[name] = scale * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        felt[name] = float((gradient * directions[name]).sum())
    # what is not felt at all, says the adjoint, goes all its way
    least = min(abs(c) for c in felt.values() if abs(c) >= 1e-6 * max(map(abs, felt.values())))
    share = {name: least / c if abs(c) >= least else 1.0 for name, c in felt.items()}
    directions = {name: share[name] * direction for name, direction in directions.items()}
    adjoint = sum(share[name] * felt[name] for name in inputs)
    # differences of two step sizes tell their own error: truncation and round-off
    coarse, fine = (derivative(loss, inputs, directions, h) for h in (4e-6, 2e-6))
    noise = 2 * abs(coarse - fine)
    assert abs(adjoint - fine) <= tolerance * abs(fine) + noise, (felt, adjoint, coarse, fine)
    assert noise <= 1e-5 * abs(fine) + 1e-12, f"the differences {coarse}, {fine} are no reference"
