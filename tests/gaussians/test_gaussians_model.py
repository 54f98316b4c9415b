"""Covariances are those of the scales along the turned axes."""

import torch

from physics3d.gaussians.model import Gaussians


def test_covariance_is_rotation_times_variances_times_rotation_transposed():
    g = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)
    model = Gaussians(
        mean=draw(50, 3), log_scale=draw(50, 3), quaternion=draw(50, 4), opacity_logit=draw(50), sh=draw(50, 1, 3)
    )
    R = model.rotation()
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    expected = R @ torch.diag_embed(torch.exp(2 * model.log_scale)) @ R.mT
    torch.testing.assert_close(model.covariance(), expected)
    assert torch.equal(model.covariance(), model.covariance().mT)  # exactly symmetric
