"""The outline near a blunt guess: an exact minimum, half a pixel, and the guess where colours do not tell."""

from itertools import product

import numpy as np
import pytest
from scipy import ndimage

from physics3d.segmentation.outline import likelier, minimum_cut, outlined, price_of_parting

SIZE = (60, 80)
BLUE, RED, BLACK = [90, 110, 150], [200, 90, 70], [30, 30, 30]


def cover(centre, radius, fine=8):
    """Share [h, w] of each pixel that a disc covers."""
    at = (np.arange(fine * SIZE[0]) + 0.5) / fine, (np.arange(fine * SIZE[1]) + 0.5) / fine
    inside = (at[1][None] - centre[0]) ** 2 + (at[0][:, None] - centre[1]) ** 2 < radius**2
    return inside.reshape(SIZE[0], fine, SIZE[1], fine).mean((1, 3))


def photograph(share, on, off, noise=4.0):
    mixed = share[..., None] * on + (1 - share[..., None]) * np.array(off)
    return np.clip(mixed + np.random.default_rng(0).normal(0, noise, mixed.shape), 0, 255).astype(np.uint8)


def overlap(a, b) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_the_cut_is_the_minimum_of_the_energy():
    rng = np.random.default_rng(0)
    p, q, price = price_of_parting(rng.normal(0, 20, (3, 4, 3)))
    for _ in range(5):
        evidence = rng.normal(0, 3, (3, 4))
        energy = lambda x: price[x[p] != x[q]].sum() - (x * evidence.reshape(-1)).sum()  # noqa: B023
        least = min(energy(np.array(x)) for x in product((0.0, 1.0), repeat=12))
        found = minimum_cut(evidence, p, q, price).reshape(-1).astype(float)
        # capacities are whole thousandths, of some fifty terms
        assert energy(found) == pytest.approx(least, abs=0.05)


@pytest.mark.parametrize("reach", [-2.0, 0.0, 2.0])
def test_a_pixel_is_the_objects_if_it_covers_half_of_it(reach):
    share = cover((41.3, 29.6), 17.0)
    blunt = ndimage.gaussian_filter(cover((41.3, 29.6), 17.0 + reach), 1.5)  # wrong by two pixels
    found = outlined(photograph(share, RED, BLUE), blunt)
    # of the 900 pixels those at the outline, a hundred, are mixed: one in ten of them may be wrong
    assert overlap(found, share > 0.5) > 0.985
    assert abs(int(found.sum()) - int((share > 0.5).sum())) < 10  # and not all on one side


def test_where_colours_do_not_tell_the_outline_is_at_half_the_guess():
    # a straight outline, which the price of length does not move, in noise
    blunt = np.broadcast_to(1 / (1 + np.exp((np.arange(SIZE[1]) - 36.5) / 2)), SIZE)
    found = outlined(photograph(blunt, BLUE, BLUE), blunt)
    # of 37 columns the noise may move the outline by half of one
    assert overlap(found, blunt > 0.5) > 0.985


def test_what_the_guess_knows_is_kept_where_colours_are_strange():
    # black is like neither side; the guess says of one patch that it is the object's, of the other that it is not
    share = cover((30.0, 30.0), 15.0)
    image = photograph(share, RED, BLUE)
    on, off = cover((25.0, 30.0), 5.0) > 0.5, cover((52.0, 30.0), 6.0) > 0.5
    image[on | off] = BLACK
    found = outlined(image, np.clip(ndimage.gaussian_filter(share, 1.5), 0.01, 0.99))
    assert found[on].all() and not found[off].any()


def test_colours_move_a_guess_that_is_not_sure():
    # the guess takes in a neighbour of other colours, likelier than not
    share, beside = cover((30.0, 30.0), 14.0), cover((56.0, 30.0), 10.0)
    image = photograph(share, RED, BLUE)
    found = outlined(image, np.maximum(0.98 * share, 0.7 * beside))
    assert overlap(found, share > 0.5) > 0.98


def test_a_colour_new_to_both_sides_says_nothing():
    # the object shows a tenth of what the surroundings show: else the new colour, as rare in both, would speak for it
    colour = np.zeros((*SIZE, 3), np.float32)
    colour[:, :8], colour[:, 70:] = (60, 60, 0), (60, 0, 90)
    on, off = np.zeros(SIZE), np.zeros(SIZE)
    on[:, :8], off[:, 8:70] = 1.0, 1.0
    odds = likelier(colour, on, off)
    assert odds[:, :8].min() > 3 and odds[:, 8:26].max() < -3
    # regions differ a little in what is common to both
    assert abs(odds[:, 70:]).max() < 0.1
