"""The laboratory of priors reads right what its priors say where that is known in closed form."""

import math
from functools import cache

import numpy as np
import pytest
from priors import exemplar, pull
from priors_tiny import FAR, GRID, RANGES, Twin, distil, gradients, read_gradient, tiny

THETA = GRID[::2]  # 0 is one of them


@cache
def of_one_exemplar() -> dict[str, dict]:
    """Rows of the exact denoiser of the film of theta = 0, by estimator; its answer does not depend on the noise."""
    return {row["estimator"]: row for row in gradients([Twin.number(0)], 2, exemplar(1)) if row["range"] == "3-30"}


@pytest.mark.parametrize("name", ["sds", "stratified"])
def test_one_exemplar_is_found_where_it_is(name):
    """dL/dtheta = (z(theta) - z(0)) dz/dtheta: zero at 0, whatever the draw; negative below and positive above, as far
    as a factor 4, where the body swings twice as fast and the next valley may begin."""
    row = of_one_exemplar()[name]
    assert (row["bias"], row["spread"], row["zeros"]) == (0.0, 0.0, 1)
    curve = np.array(row["curve"])
    assert (curve[THETA < 0] < 0).all() and (curve[(THETA > 0) & (THETA < FAR)] > 0).all()


@pytest.mark.parametrize("name", ["moving_minus_still", "stratified_difference"])
def test_one_exemplar_less_its_still_picture_stills(name):
    """(z(theta) - s) dz/dtheta is the slope of the motion's square: what is stiffer moves less, everywhere."""
    row = of_one_exemplar()[name]
    assert math.isnan(row["bias"]) and row["zeros"] == 0
    assert pull(np.array([row["curve"]])) == "pulls to stiffer"


@pytest.mark.parametrize("shift", [0.0, 0.125, 0.1, -0.06])
def test_the_zero_of_a_line_is_found_on_the_grid_and_between(shift):
    """2 (theta - shift), by draws 0.3 above and below: a deviation of 0.3 sqrt(2) is 0.15 sqrt(2) of theta."""
    found = 2 * (THETA - shift) + np.array([[-0.3], [0.3]])
    row = read_gradient(THETA, found)
    assert row["bias"] == pytest.approx(shift, abs=1e-12)  # of float64 numbers of order 1
    assert row["spread"] == pytest.approx(0.15 * math.sqrt(2))
    assert (row["low"], row["high"]) == (THETA[0], THETA[-1])


def test_a_zero_that_descent_leaves_is_none():
    row = read_gradient(THETA, np.stack([-THETA, -THETA]))
    assert row["zeros"] == 0 and math.isnan(row["bias"])
    assert pull(np.array([row["curve"]])) == "pulls to stiffer at 47 % of the places, to softer at the others"


def test_of_two_zeros_the_one_nearer_to_the_truth_is_the_bias():
    """sin has zeros that descent goes to at -2 pi/3, 0 and 2 pi/3 of three theta: one of them on the grid."""
    row = read_gradient(THETA, np.tile(np.sin(4.5 * THETA), (2, 1)))
    assert row["zeros"] == 3 and row["bias"] == 0.0


def test_the_small_video_model_pulls_a_wrong_stiffness_to_the_usual_one():
    """By the weights of the package, on a body that they have not seen, moved by a solver that did not make the films:
    from starts a factor 4 off, within a quarter of the mode of the stiffnesses that they were trained on."""
    chosen = [("stratified", RANGES[1])]
    rows = list(distil([Twin.number(2)], 20, tiny(None), chosen=chosen, by="solver", searched=True))
    assert [row["start"] for row in rows] == pytest.approx([0.25, 4.0])
    assert all(0.75 < row["found"] < 1.25 for row in rows), [row["found"] for row in rows]
