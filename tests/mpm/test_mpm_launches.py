"""Arguments of kernels go by name: wherever they stand, and none can be forgotten or invented."""

import pytest
import torch
import warp as wp

from physics3d.mpm.launches import launch_over, record

CPU = torch.device("cpu")


@wp.kernel(module="unique")
def forwards(first: int, factor: float, x: wp.array(dtype=float), y: wp.array(dtype=float)):
    y[wp.tid() + first] = factor * x[wp.tid() + first]


@wp.kernel(module="unique")
def shuffled(y: wp.array(dtype=float), x: wp.array(dtype=float), first: int, factor: float):
    y[wp.tid() + first] = factor * x[wp.tid() + first]


def arrays() -> dict[str, wp.array]:
    return {name: wp.array([1.0, 2.0, 3.0], dtype=float, device="cpu") for name in "xy"}


@pytest.mark.parametrize("kernel", [forwards, shuffled], ids=["forwards", "shuffled"])
def test_the_place_of_an_argument_does_not_matter(kernel):
    a, bar = arrays(), arrays()
    own, shared = dict(first=0, y=a["y"]), dict(factor=2.0, x=a["x"], of_no_use=None)
    # two of three
    launch_over(record(kernel, 1, own, shared=shared, device=CPU), 1, 2)
    assert a["y"].numpy().tolist() == [1.0, 4.0, 6.0]
    # dy/dx = 2 on what y's adjoint is
    bar["x"].zero_()
    record(kernel, 3, own, shared=shared, adjoints=bar, device=CPU).launch()
    assert bar["x"].numpy().tolist() == [2.0, 4.0, 6.0]


def test_own_arguments_win_over_shared_ones():
    a = arrays()
    record(forwards, 3, dict(first=0, factor=3.0, **a), shared=dict(factor=2.0), device=CPU).launch()
    assert a["y"].numpy().tolist() == [3.0, 6.0, 9.0]


def test_what_is_missing_or_unknown_is_named():
    a = arrays()
    with pytest.raises(TypeError, match="forwards misses factor"):
        record(forwards, 3, dict(first=0, **a), shared={}, device=CPU)
    with pytest.raises(TypeError, match="forwards has no argument scale; it takes first, factor, x, y"):
        record(forwards, 3, dict(first=0, scale=3.0, **a), shared=dict(factor=2.0), device=CPU)
    with pytest.raises(TypeError, match="forwards has no argument z"):
        record(forwards, 3, dict(first=0, **a), shared=dict(factor=2.0), adjoints=dict(z=a["x"]), device=CPU)
