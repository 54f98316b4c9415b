"""The gradient with which a body starts is exact where it can be known."""

import pytest
import torch

from physics3d.mpm.velocity_gradient import velocity_gradient


@pytest.mark.parametrize("thickness", [0, 3])
def test_velocity_gradient_is_exact_for_linear_fields_and_finite_on_a_sheet(thickness):
    generator = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(300, 3, generator=generator, dtype=torch.float64)
    x[:, 2] *= thickness / 4
    A = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    L = velocity_gradient(x, x @ A.T + 0.7, torch.rand(300, generator=generator, dtype=torch.float64) + 0.1)
    known = 3 if thickness else 2  # across the sheet nothing is known, and zero is said
    torch.testing.assert_close(L[:, :, :known], A[:, :known].expand(300, 3, known), atol=1e-6, rtol=0)
    assert float(L[:, :, known:].abs().sum()) < 1e-6
