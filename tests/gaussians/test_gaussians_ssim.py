"""Our SSIM is the published one, and is differentiable."""

import pytest
import torch

from physics3d.gaussians.ssim import ssim


def pictures():
    g = torch.Generator().manual_seed(0)
    x = torch.rand(24, 31, 3, generator=g, dtype=torch.float64)
    return x, (x + 0.2 * torch.randn(x.shape, generator=g, dtype=torch.float64)).clamp(0, 1)


def test_agrees_with_the_definition_written_as_a_loop():
    x, y = pictures()
    i = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-(i[:, None] ** 2 + i[None] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    values = []
    for r in range(24 - 10):
        for c in range(31 - 10):
            a, b = x[r : r + 11, c : c + 11], y[r : r + 11, c : c + 11]
            ma, mb = (window * a).sum((0, 1)), (window * b).sum((0, 1))
            va, vb = (window * (a - ma) ** 2).sum((0, 1)), (window * (b - mb) ** 2).sum((0, 1))
            cov = (window * (a - ma) * (b - mb)).sum((0, 1))
            top = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4)
            values.append(top / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    assert ssim(x, y).item() == pytest.approx(torch.stack(values).mean().item(), abs=1e-12)


def test_equal_pictures_score_one():
    x, _ = pictures()
    assert ssim(x, x).item() == pytest.approx(1, abs=1e-12)


def test_gradient_is_finite_differences():
    x, y = pictures()
    assert torch.autograd.gradcheck(lambda a: ssim(a, y[:12, :13]), x[:12, :13].requires_grad_())


def test_pictures_smaller_than_the_window_are_refused():
    with pytest.raises(ValueError, match="at least 11 px"):
        ssim(torch.rand(10, 20, 3), torch.rand(10, 20, 3))
