"""Tensor functions against LAPACK and SciPy, near the identity and at repeated eigenvalues, value and adjoint."""

import functools

import numpy as np
import pytest
import scipy.linalg
import torch
import warp as wp

from physics3d.materials import spectral

TOLERANCE = {wp.float32: 2e-6, wp.float64: 1e-14}  # round-off times the dozen operations of each function


@functools.cache
def kernel(real):
    """Everything in one kernel: compiling is what costs."""
    mat33 = spectral.matrix_type(real)
    stretch, relax, log_det = spectral.stretch(real), spectral.relax_hencky(real), spectral.log_det(real)
    unimodular_inverse, log1p, expm1 = spectral.unimodular_inverse(real), spectral.log1p(real), spectral.expm1(real)

    @wp.kernel(module="unique")
    def evaluate(
        H: wp.array(dtype=mat33),
        X: wp.array(dtype=mat33),
        d: real,
        v: real,
        Y: wp.array(dtype=mat33),
        eps: wp.array(dtype=mat33),
        X_next: wp.array(dtype=mat33),
        W: wp.array(dtype=mat33),
        scalars: wp.array2d(dtype=real),
    ):
        p = wp.tid()
        Y[p] = stretch(H[p])
        a, b = relax(X[p], d, v)
        eps[p] = a
        X_next[p] = b
        W[p] = unimodular_inverse(X[p])
        scalars[p, 0] = log_det(X[p])
        scalars[p, 1] = log1p(H[p][0, 0])
        scalars[p, 2] = expm1(H[p][0, 0])

    return evaluate


def evaluate(real, H, X, d=0.0, v=0.0):
    mat33, n = spectral.matrix_type(real), len(H)
    outputs = [wp.zeros(n, dtype=mat33, device="cpu") for _ in range(4)]
    outputs.append(wp.zeros((n, 3), dtype=real, device="cpu"))
    inputs = [wp.array(H, dtype=mat33, device="cpu"), wp.array(X, dtype=mat33, device="cpu"), real(d), real(v)]
    wp.launch(kernel(real), n, inputs=inputs, outputs=outputs, device="cpu")
    return [out.numpy().astype(np.float64) for out in outputs]


def deformations(rng):
    """H of many sizes, equal stretches, strong compression, large stretch, each also rotated."""
    special = [
        np.zeros(3),
        [0.5, 0.5, 0],
        [-0.5, -0.5, -0.5],
        [-0.99, 0, 0],
        [19, 0, 0],
        [19, -0.9, -0.9],
        [1e-6, 1e-6, 0],
    ]
    H = [np.diag(s) for s in special] + [scale * rng.standard_normal((3, 3)) for scale in np.logspace(-7, -0.5, 20)]
    H = np.stack([h for h in H if np.linalg.det(np.eye(3) + h) > 0])
    Q = scipy.stats.special_ortho_group(3, seed=0).rvs(len(H))
    return np.concatenate([H, Q @ (np.eye(3) + H) - np.eye(3)]), len(H)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_stretch_is_the_symmetric_polar_factor(real):
    H, unrotated = deformations(np.random.default_rng(0))
    Y = evaluate(real, H, H + H.transpose(0, 2, 1))[0]
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
    Y = evaluate(real, H, 0 * H)[0]
    np.testing.assert_allclose(Y, V - np.eye(3), rtol=0, atol=20 * TOLERANCE[real])


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_relaxation_equals_matrix_logarithm_and_exponential(real):
    H, unrotated = deformations(np.random.default_rng(2))
    X = (H + H.transpose(0, 2, 1) + H @ H.transpose(0, 2, 1))[:unrotated]
    d, v = 0.7, 0.2
    _, half, X_next, W, scalars = evaluate(real, H[:unrotated], X, d, v)
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
        np.testing.assert_allclose(scalars[i, 0], 2 * log.sum(), rtol=0, atol=accuracy * np.abs(log).max() + 1e-16)
        w = np.expm1(2 * mean - 2 * log)
        np.testing.assert_allclose(
            W[i], (Q * w) @ Q.T, rtol=0, atol=accuracy * max(np.abs(w).max(), np.abs(x).max()) + 1e-16
        )


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_no_relaxation_leaves_the_strain_alone(real):
    X = np.random.default_rng(3).standard_normal((10, 3, 3)) * 0.1
    X = (X + X.transpose(0, 2, 1)).astype(np.float32)
    np.testing.assert_array_equal(evaluate(real, 0 * X, X)[2], X)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_log1p_and_expm1_keep_the_digits_of_small_numbers(real):
    x = np.concatenate([np.logspace(-12, 0.5, 200), -np.logspace(-12, -0.01, 200)])
    x = x.astype(np.float32 if real is wp.float32 else np.float64)
    H = np.zeros((len(x), 3, 3))
    H[:, 0, 0] = x
    scalars = evaluate(real, H, 0 * H)[4]
    np.testing.assert_allclose(scalars[:, 1], np.log1p(x.astype(np.float64)), rtol=TOLERANCE[real], atol=0)
    np.testing.assert_allclose(scalars[:, 2], np.expm1(x.astype(np.float64)), rtol=TOLERANCE[real], atol=0)


@pytest.mark.parametrize("size", [1e-4, 0.3, 2.0])
def test_closed_forms_for_many_matrices_agree_with_torch(size):
    """Determinant, principal values and sum (s - 1)^2 of signed stretches, inverted ones included."""
    H = size * torch.randn(500, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    H[:3] = torch.stack([torch.zeros(3, 3), 0.1 * torch.eye(3), torch.diag(torch.tensor([0.2, 0.2, -0.1]))])
    F = torch.eye(3, dtype=torch.float64) + H
    torch.testing.assert_close(spectral.determinant(F), torch.linalg.det(F), rtol=1e-12, atol=1e-12)
    S = F.mT @ F
    # equal values: half of the digits
    torch.testing.assert_close(
        torch.stack(spectral.principal_values(S), 1), torch.linalg.eigvalsh(S), rtol=1e-7, atol=1e-7
    )
    U, s, Vt = torch.linalg.svd(F)
    s[:, 2] *= torch.linalg.det(U @ Vt)
    expected = ((s - 1) ** 2).sum(1)
    torch.testing.assert_close(spectral.stretch_distance(H), expected, rtol=1e-9, atol=1e-9 * size**2)
