"""Relaxed logarithmic strain against LAPACK's eigenvectors, near the identity and at repeated eigenvalues."""

import functools

import numpy as np
import pytest
import warp as wp
from matrices import TOLERANCE, strains

from physics3d.materials.tensors import log_strain
from physics3d.warp_types import matrix


@functools.cache
def kernel(real):
    mat33, rescale = matrix(real), log_strain.rescale(real)

    @wp.kernel(module="unique")
    def evaluate(X: wp.array(dtype=mat33), d: real, v: real, eps: wp.array(dtype=mat33), X_next: wp.array(dtype=mat33)):
        p = wp.tid()
        half_d, half_v = wp.exp(-real(0.5) * d), wp.exp(-real(0.5) * v)
        a, b = rescale(X[p], half_d, half_v, half_d * half_d - real(1.0), half_v * half_v - real(1.0))
        eps[p] = a
        X_next[p] = b

    return evaluate


def relaxed(real, X, d=0.0, v=0.0):
    """(half relaxed strain, fully relaxed X)."""
    mat33, n = matrix(real), len(X)
    half, X_next = (wp.zeros(n, dtype=mat33, device="cpu") for _ in range(2))
    X = wp.array(X, dtype=mat33, device="cpu")
    wp.launch(kernel(real), n, inputs=[X, real(d), real(v), half, X_next], device="cpu")
    return half.numpy().astype(np.float64), X_next.numpy().astype(np.float64)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_relaxation_equals_matrix_logarithm_and_exponential(real):
    X = strains(np.random.default_rng(2))
    d, v = 0.7, 0.2
    half, X_next = relaxed(real, X, d, v)
    for i, x in enumerate(X):
        values, Q = np.linalg.eigh(x)
        log = 0.5 * np.log1p(values)
        mean = log.mean()
        expected_half = np.exp(-d / 2) * (log - mean) + np.exp(-v / 2) * mean
        expected_next = np.expm1(2 * (np.exp(-d) * (log - mean) + np.exp(-v) * mean))
        # relative to the strain; the smallest principal value is known to round-off of the largest
        condition = (1 + values.max()) / (1 + values.min())
        accuracy = 20 * TOLERANCE[real] * condition
        np.testing.assert_allclose(
            half[i], (Q * expected_half) @ Q.T, rtol=0, atol=accuracy * np.abs(log).max() + 1e-16
        )
        np.testing.assert_allclose(
            X_next[i], (Q * expected_next) @ Q.T, rtol=0, atol=accuracy * np.abs(x).max() + 1e-16
        )


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_no_relaxation_leaves_the_strain_alone(real):
    X = np.random.default_rng(3).standard_normal((10, 3, 3)) * 0.1
    X = (X + X.transpose(0, 2, 1)).astype(np.float32)
    np.testing.assert_array_equal(relaxed(real, X)[1], X)
