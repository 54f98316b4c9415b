"""The harmonics are orthonormal, hold 3DGS's constant term, and never give negative colour."""

import pytest
import torch

from physics3d.gaussians.sh import C0, sh_basis, sh_color


def test_basis_is_orthonormal_on_the_sphere():
    # exact quadrature: Gauss-Legendre in z, equal steps in the azimuth, both beyond degree 6
    import numpy as np

    z, wz = np.polynomial.legendre.leggauss(8)
    phi = 2 * np.pi * np.arange(16) / 16
    Z, P = np.meshgrid(z, phi, indexing="ij")
    r = np.sqrt(1 - Z**2)
    d = torch.tensor(np.stack([r * np.cos(P), r * np.sin(P), Z], -1).reshape(-1, 3))
    weight = torch.tensor(np.repeat(wz, 16) * 2 * np.pi / 16)
    Y = sh_basis(d, 16)
    torch.testing.assert_close(Y.T @ (weight[:, None] * Y), torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)


def test_signs_are_those_of_3dgs():
    """Y_1 = -C1 y, C1 z, -C1 x, where textbooks (and some viewers) have plus."""
    Y = sh_basis(torch.tensor([[1.0, 2.0, 4.0]]), 4)[0]
    assert Y[1] / Y[2] == -0.5 and Y[3] / Y[2] == -0.25 and Y[2] > 0


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_constant_term_alone_is_the_same_from_everywhere(k):
    sh = torch.zeros(5, k, 3)
    sh[:, 0] = (torch.tensor([0.2, 0.5, 0.9]) - 0.5) / C0
    direction = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)) * 10
    torch.testing.assert_close(sh_color(sh, direction), torch.tensor([0.2, 0.5, 0.9]).expand(5, 3))


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_gradients_are_finite_differences(k):
    g = torch.Generator().manual_seed(k)
    sh, direction = (torch.randn(4, *shape, generator=g, dtype=torch.float64) for shape in ((k, 3), (3,)))
    sh[:, 0] += 2  # away from the kink at black
    assert torch.autograd.gradcheck(sh_color, (sh.requires_grad_(), direction.requires_grad_()))


def test_colour_is_never_negative():
    assert (sh_color(torch.full((2, 1, 3), -9.0), torch.ones(2, 3)) == 0).all()


def test_other_counts_are_refused():
    with pytest.raises(ValueError, match="5 coefficients"):
        sh_color(torch.zeros(2, 5, 3), torch.ones(2, 3))
