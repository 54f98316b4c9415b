"""The nearest point of a box in the energy, against SciPy's minimiser with bounds."""

import functools

import numpy as np
import pytest
import scipy.optimize
import warp as wp

from physics3d.materials.tensors import return_maps
from physics3d.warp_types import matrix

LOWER, UPPER = -0.03, 0.01


@functools.cache
def kernel(real):
    mat33, box = matrix(real), return_maps.box_hencky(real)

    @wp.kernel(module="unique")
    def evaluate(
        X: wp.array(dtype=mat33), r: real, lower: real, upper: real, eps: wp.array(dtype=mat33), y: wp.array(dtype=real)
    ):
        p = wp.tid()
        a, _b, c = box(X[p], r, lower, upper)
        eps[p] = a
        y[p] = c

    return evaluate


@pytest.mark.parametrize("r", [-0.2, 0.0, 3.0])
def test_return_into_a_box_is_the_nearest_point_in_the_energy(r):
    """(1 + 2 r, r, r, ...) is the Hessian of |c - t|^2 + r (tr c - tr t)^2, up to a factor."""
    rng = np.random.default_rng(5)
    t = 0.05 * rng.standard_normal((40, 3))
    Q = np.linalg.qr(rng.standard_normal((40, 3, 3)))[0]
    X = Q @ (np.expm1(2 * t)[:, :, None] * Q.transpose(0, 2, 1))
    mat33 = matrix(wp.float64)
    eps, y = wp.zeros(40, dtype=mat33, device="cpu"), wp.zeros(40, dtype=wp.float64, device="cpu")
    inputs = [wp.array(X, dtype=mat33, device="cpu"), *map(wp.float64, (r, LOWER, UPPER)), eps, y]
    wp.launch(kernel(wp.float64), 40, inputs, device="cpu")
    root = np.linalg.cholesky(np.eye(3) + r).T
    for i in range(40):
        c = scipy.optimize.lsq_linear(root, root @ t[i], (LOWER, UPPER), method="bvls", tol=1e-15).x
        np.testing.assert_allclose(eps.numpy()[i], (Q[i] * c) @ Q[i].T, rtol=0, atol=1e-12)
        np.testing.assert_allclose(y.numpy()[i], c.sum() - t[i].sum(), rtol=0, atol=1e-12)
