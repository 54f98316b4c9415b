"""How a body's amplitudes are read off a clip: a rod that is drawn, of one amplitude, that of its tip."""

import numpy as np
from clips import FPS, thin_rod

from physics3d.learning.seen_modes import Sight, observe, observe_again

TIP = 26 * np.exp(-0.8 * np.arange(26) / FPS) * np.sin(2 * np.pi * 1.2 * np.arange(26) / FPS)  # [px]


def test_a_second_look_finds_what_a_first_has_lost_of_a_wide_swing():
    """The rod is five pixels wide and swings by 22: the first look loses it to the ground. A guess that is a tenth too
    small is what a fit of all frames together gives."""
    video, shape, rod = thin_rod(TIP, width=5)
    pixel = np.argwhere(rod)
    jacobian = np.stack([shape[rod], 0 * shape[rod]], -1)[..., None]  # pixels of a pixel of the tip
    sight = Sight(thing=rod, pixel=pixel, jacobian=jacobian)
    wide, at_rest = np.abs(TIP) > 0.5 * np.abs(TIP).max(), video[0]
    read = lambda observed: (observed.right[:, 0] / observed.gram[:, 0, 0])[wide] / TIP[wide]
    first, u, _ = observe(sight, video, FPS, reference=at_rest)
    assert read(first).min() < 0.9
    late = 3  # the frames before have no guess, as those before a release
    places = 0.9 * TIP[late:, None]
    second, again, _ = observe_again(sight, video, FPS, reference=at_rest, seen=u, places=places)
    # more than half of what the guess lacks is found (`test_motion_pictures.py`), to half a pixel of 26
    assert (read(second)[wide[:late].sum() :] > 0.93).all() and (read(second) < 1.02).all()
    np.testing.assert_array_equal(again[:late], u[:late])
    assert (
        second.weight[late:][wide[late:]].sum() > 1.3 * first.weight[late:][wide[late:]].sum()
    )  # of the pixels that are trusted
