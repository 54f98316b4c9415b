"""Eigenvalues and eigenvectors of symmetric matrices against LAPACK."""

import functools

import numpy as np
import pytest
import torch
import warp as wp
from matrices import TOLERANCE, strains

from physics3d.materials.tensors import eigen
from physics3d.warp_types import matrix, vector


@functools.cache
def kernel(real):
    mat33, vec3, decompose = matrix(real), vector(real), eigen.eigen(real)

    @wp.kernel(module="unique")
    def evaluate(X: wp.array(dtype=mat33), x: wp.array(dtype=vec3), Q: wp.array(dtype=mat33)):
        p = wp.tid()
        values, vectors = decompose(X[p])
        x[p] = values
        Q[p] = vectors

    return evaluate


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_eigenvectors_are_orthonormal_and_rebuild_the_matrix(real):
    X, mat33 = strains(np.random.default_rng(4)), matrix(real)
    x = wp.zeros(len(X), dtype=vector(real), device="cpu")
    Q = wp.zeros(len(X), dtype=mat33, device="cpu")
    wp.launch(kernel(real), len(X), [wp.array(X, dtype=mat33, device="cpu"), x, Q], device="cpu")
    x, Q = x.numpy().astype(np.float64), Q.numpy().astype(np.float64)
    size = np.abs(X).max((1, 2))
    np.testing.assert_allclose(Q.transpose(0, 2, 1) @ Q, np.broadcast_to(np.eye(3), X.shape), atol=20 * TOLERANCE[real])
    for i in range(len(X)):
        accuracy = 20 * TOLERANCE[real] * size[i] + 1e-300
        np.testing.assert_allclose(np.sort(x[i]), np.linalg.eigvalsh(X[i]), rtol=0, atol=accuracy)
        np.testing.assert_allclose((Q[i] * x[i]) @ Q[i].T, X[i], rtol=0, atol=accuracy)


@pytest.mark.parametrize("size", [1e-4, 0.3, 2.0])
def test_principal_values_of_many_matrices_agree_with_torch(size):
    H = size * torch.randn(500, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    H[:3] = torch.stack([torch.zeros(3, 3), 0.1 * torch.eye(3), torch.diag(torch.tensor([0.2, 0.2, -0.1]))])
    F = torch.eye(3, dtype=torch.float64) + H
    S = F.mT @ F
    # equal values: half of the digits
    torch.testing.assert_close(
        torch.stack(eigen.principal_values(S), 1), torch.linalg.eigvalsh(S), rtol=1e-7, atol=1e-7
    )
