"""Polar decomposition against SciPy, near the identity, at equal stretches and inverted."""

import functools

import numpy as np
import pytest
import scipy.linalg
import torch
import warp as wp
from matrices import TOLERANCE, deformations

from physics3d.materials.tensors import polar
from physics3d.warp_types import matrix


@functools.cache
def kernel(real):
    mat33, stretch = matrix(real), polar.stretch(real)

    @wp.kernel(module="unique")
    def evaluate(H: wp.array(dtype=mat33), Y: wp.array(dtype=mat33)):
        p = wp.tid()
        Y[p] = stretch(H[p])

    return evaluate


def stretch(real, H):
    mat33 = matrix(real)
    Y = wp.zeros(len(H), dtype=mat33, device="cpu")
    wp.launch(kernel(real), len(H), [wp.array(H, dtype=mat33, device="cpu"), Y], device="cpu")
    return Y.numpy().astype(np.float64)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_stretch_is_the_symmetric_polar_factor(real):
    H, unrotated = deformations(np.random.default_rng(0))
    Y = stretch(real, H)
    for i, h in enumerate(H):
        _, V = scipy.linalg.polar(np.eye(3) + h, side="left")
        # a small strain keeps its digits unless the body has turned: then H itself has rounded it
        size = np.abs(h).max() if i < unrotated else 1 + np.abs(h).max()
        np.testing.assert_allclose(
            Y[i], V - np.eye(3), rtol=0, atol=20 * TOLERANCE[real] * size + 1e-14
        )  # SciPy: absolute 1e-14


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_inverted_element_keeps_a_rotation(real):
    """V has a negative smallest eigenvalue when J < 0, so that the energy pulls the element back through flat."""
    rng = np.random.default_rng(1)
    s = np.array([[1.5, 1.0, -0.3], [1.0, 0.9, -0.5], [2.0, 1.2, 0.0]])
    A, B = scipy.stats.special_ortho_group(3, seed=rng).rvs(3), scipy.stats.special_ortho_group(3, seed=rng).rvs(3)
    H = A @ (s[:, :, None] * B) - np.eye(3)
    V = A @ (s[:, :, None] * A.transpose(0, 2, 1))
    np.testing.assert_allclose(stretch(real, H), V - np.eye(3), rtol=0, atol=20 * TOLERANCE[real])


@pytest.mark.parametrize("size", [1e-4, 0.3, 2.0])
def test_distance_of_the_stretches_from_one(size):
    """sum (s - 1)^2 of signed stretches, inverted ones included, against torch's singular values."""
    H = size * torch.randn(500, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    H[:3] = torch.stack([torch.zeros(3, 3), 0.1 * torch.eye(3), torch.diag(torch.tensor([0.2, 0.2, -0.1]))])
    U, s, Vt = torch.linalg.svd(torch.eye(3, dtype=torch.float64) + H)
    s[:, 2] *= torch.linalg.det(U @ Vt)
    expected = ((s - 1) ** 2).sum(1)
    torch.testing.assert_close(polar.stretch_distance(H), expected, rtol=1e-9, atol=1e-9 * size**2)
