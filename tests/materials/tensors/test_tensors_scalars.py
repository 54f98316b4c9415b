"""ln(1 + x) and exp(x) - 1 against NumPy."""

import functools

import numpy as np
import pytest
import warp as wp
from matrices import TOLERANCE

from physics3d.materials.tensors import scalars


@functools.cache
def kernel(real):
    log1p, expm1 = scalars.log1p(real), scalars.expm1(real)

    @wp.kernel(module="unique")
    def evaluate(x: wp.array(dtype=real), logs: wp.array(dtype=real), exps: wp.array(dtype=real)):
        p = wp.tid()
        logs[p] = log1p(x[p])
        exps[p] = expm1(x[p])

    return evaluate


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_log1p_and_expm1_keep_the_digits_of_small_numbers(real):
    x = np.concatenate([np.logspace(-12, 0.5, 200), -np.logspace(-12, -0.01, 200)])
    x = x.astype(np.float32 if real is wp.float32 else np.float64)
    logs, exps = (wp.zeros(len(x), dtype=real, device="cpu") for _ in range(2))
    wp.launch(kernel(real), len(x), [wp.array(x, dtype=real, device="cpu"), logs, exps], device="cpu")
    np.testing.assert_allclose(logs.numpy(), np.log1p(x.astype(np.float64)), rtol=TOLERANCE[real], atol=0)
    np.testing.assert_allclose(exps.numpy(), np.expm1(x.astype(np.float64)), rtol=TOLERANCE[real], atol=0)
