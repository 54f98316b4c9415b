"""Colours of numbers: even to the eye, in order, and honest about what cannot be shown."""

import itertools

import matplotlib
import numpy as np
import pytest

from physics3d.view import colors


def lightness(rgb: np.ndarray) -> np.ndarray:
    """L* of CIE 1976, of sRGB bytes."""
    c = rgb / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    Y = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(Y > (6 / 29) ** 3, 116 * np.cbrt(Y) - 16, (29 / 3) ** 3 * Y)


def test_more_is_lighter_by_the_same_amount_everywhere():
    L = lightness(colors.of_values(np.linspace(2.0, 5.0, 40), 2.0, 5.0).astype(float))
    step = np.diff(L)
    # viridis is even in another space than L*: each fortieth within half of the mean step
    assert (np.abs(step / step.mean() - 1) < 0.5).all() and L[0] < 20 and L[-1] > 85


def test_the_map_is_viridis_between_the_ends_and_its_ends_beyond_them(rng):
    value = rng.uniform(-3, 9, 200)
    expected = matplotlib.colormaps["viridis"](np.clip((value + 1) / 5, 0, 1))[:, :3]
    # a byte, and one of 256 levels to either side
    np.testing.assert_allclose(colors.of_values(value, -1.0, 4.0) / 255, expected, atol=1.5 / 255)


def test_a_value_that_is_the_same_everywhere_has_one_colour():
    assert len(np.unique(colors.of_values(np.full(5, 3.0), 3.0, 3.0), axis=0)) == 1


@pytest.mark.parametrize("value, low, high", [(np.nan, 0, 1), (np.inf, 0, 1), (0.5, 1, 0), (0.5, 0, np.nan)])
def test_what_has_no_colour_is_refused(value, low, high):
    with pytest.raises(ValueError, match="finite"):
        colors.of_values(np.array([value]), float(low), float(high))


def test_parts_can_be_told_apart():
    table = colors.of_parts(np.arange(10)).astype(float)
    # sRGB bytes; a just noticeable difference is about 5
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(table, 2)) > 50


def test_what_stands_still_is_pale_and_keeps_its_order(rng):
    color = rng.uniform(size=(50, 3))
    grey = colors.pale(color).astype(float)
    assert (grey == grey[:, :1]).all() and grey.min() > 150
    luma = color @ np.array([0.299, 0.587, 0.114])
    assert np.corrcoef(luma, grey[:, 0])[0, 1] > 0.999  # rounded to bytes
