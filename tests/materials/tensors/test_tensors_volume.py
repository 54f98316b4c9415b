"""Volume change, its derivative and what it leaves of a strain, against NumPy and torch."""

import functools

import numpy as np
import pytest
import torch
import warp as wp
from matrices import TOLERANCE, deformations, strains

from physics3d.materials.tensors import volume
from physics3d.warp_types import matrix


@functools.cache
def kernel(real):
    mat33 = matrix(real)
    log_det, inverse = volume.log_det(real), volume.unimodular_inverse(real)
    change, cofactor = volume.volume_change(real), volume.cofactor(real)

    @wp.kernel(module="unique")
    def evaluate(
        H: wp.array(dtype=mat33),
        X: wp.array(dtype=mat33),
        W: wp.array(dtype=mat33),
        C: wp.array(dtype=mat33),
        scalars: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        W[p] = inverse(X[p])
        C[p] = cofactor(wp.identity(n=3, dtype=real) + H[p])
        scalars[p, 0] = log_det(X[p])
        scalars[p, 1] = change(H[p])

    return evaluate


def evaluate(real, H, X):
    """(unimodular inverse of X, cofactor of I + H, ln det (I + X), J - 1 of H)."""
    mat33, n = matrix(real), len(H)
    W, C = (wp.zeros(n, dtype=mat33, device="cpu") for _ in range(2))
    scalars = wp.zeros((n, 2), dtype=real, device="cpu")
    inputs = [wp.array(A, dtype=mat33, device="cpu") for A in (H, X)]
    wp.launch(kernel(real), n, [*inputs, W, C, scalars], device="cpu")
    return [out.numpy().astype(np.float64) for out in (W, C, scalars)]


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_strain_without_its_volume(real):
    X = strains(np.random.default_rng(2))
    W, _, scalars = evaluate(real, 0 * X, X)
    for i, x in enumerate(X):
        values, Q = np.linalg.eigh(x)
        log = 0.5 * np.log1p(values)
        # relative to the strain; the smallest principal value is known to round-off of the largest
        condition = (1 + values.max()) / (1 + values.min())
        accuracy = 20 * TOLERANCE[real] * condition
        np.testing.assert_allclose(scalars[i, 0], 2 * log.sum(), rtol=0, atol=accuracy * np.abs(log).max() + 1e-16)
        w = np.expm1(2 * log.mean() - 2 * log)
        size = max(np.abs(w).max(), np.abs(x).max())
        np.testing.assert_allclose(W[i], (Q * w) @ Q.T, rtol=0, atol=accuracy * size + 1e-16)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_volume_change_keeps_the_digits_of_small_strains(real):
    H = deformations(np.random.default_rng(3))[0]
    _, C, scalars = evaluate(real, H, 0 * H)
    H = H.astype(np.float32).astype(np.float64) if real is wp.float32 else H
    for i, h in enumerate(H):
        size = np.abs(h).max()
        minors = sum(np.linalg.det(h[np.ix_(ij, ij)]) for ij in ((0, 1), (1, 2), (0, 2)))
        exact = np.trace(h) + minors + np.linalg.det(h)
        np.testing.assert_allclose(scalars[i, 1], exact, rtol=0, atol=10 * TOLERANCE[real] * (size + size**3))
        F = np.eye(3) + h
        expected = np.linalg.det(F) * np.linalg.inv(F).T
        np.testing.assert_allclose(C[i], expected, rtol=0, atol=10 * TOLERANCE[real] * (1 + size) ** 2)


@pytest.mark.parametrize("size", [1e-4, 0.3, 2.0])
def test_determinant_of_many_matrices_agrees_with_torch(size):
    F = torch.eye(3, dtype=torch.float64) + size * torch.randn(
        500, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    torch.testing.assert_close(volume.determinant(F), torch.linalg.det(F), rtol=1e-12, atol=1e-12)
