"""The thing that moves is cut out of its clip: against the outline it was drawn with."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from physics3d.motion.thing import moving_thing, standing


def swinging(rng, *, h=120, w=160, frames=24, colour=(200.0, 70.0, 60.0)):
    """(clip, the thing's pixels in the last frame): a disc on a rod that turns about its foot, before a wall."""
    texture = lambda shape: ndimage.gaussian_filter(rng.standard_normal(shape), 1.5)[..., None] * 60
    wall = np.array([70.0, 90.0, 160.0]) + texture((h, w))
    skin = np.array(colour) + texture((3 * h, 3 * w))
    y, x = np.mgrid[:h, :w] + 0.5
    clip, mask = [], None
    for t in range(frames):
        angle = 0.12 * np.exp(-t / 40) * np.cos(2 * np.pi * t / 11)
        dx, dy = x - w / 2, (h - 12.0) - y
        a, b = dx * np.cos(angle) - dy * np.sin(angle), dx * np.sin(angle) + dy * np.cos(angle)
        inside = ((np.abs(a) < 5) & (b > 0) & (b < 70)) | (a**2 + (b - 70) ** 2 < 18**2)
        at = ndimage.map_coordinates(skin[..., 0], [b + h, a + w], order=1)
        picture = np.where(inside[..., None], np.array(colour) + (at - colour[0])[..., None], wall)
        clip.append(ndimage.gaussian_filter(picture, (0.7, 0.7, 0)))
        mask = inside
    noisy = np.stack(clip) + rng.standard_normal((frames, h, w, 3))
    return torch.from_numpy(noisy.clip(0, 255).astype(np.uint8)), mask


def test_what_stands_still_is_told_from_where_the_thing_has_been(rng):
    clip, mask = swinging(rng)
    still = standing(clip, clip[-1]).numpy()
    y = np.arange(mask.shape[0])[:, None] + 0.5
    assert still[:, :20].mean() > 0.99  # the wall, far from the thing
    assert still[mask & (y < 60)].mean() < 0.2  # its disc


@pytest.mark.parametrize("colour", [(200.0, 70.0, 60.0), (210.0, 200.0, 120.0)])
def test_what_swings_is_cut_out_along_its_outline(rng, colour):
    clip, mask = swinging(rng, colour=colour)
    thing, size = moving_thing(clip, at=len(clip) - 1, box=(0.1, 0.05, 0.9, 0.98))
    # the foot of the rod moves by less than a twentieth of the largest and is left out
    y = np.arange(mask.shape[0])[:, None] + 0.5
    upper = mask & (y < 100)
    overlap = (thing & (y < 100) & mask).sum() / ((thing & (y < 100)) | upper).sum()
    assert overlap > 0.9  # an outline is a pixel wide: its half is a twentieth of this thing
    assert size[mask].mean() > 5 * size[~ndimage.binary_dilation(mask, iterations=12)].mean()


def test_a_box_beside_it_holds_no_thing(rng):
    clip, _ = swinging(rng)
    with pytest.raises(ValueError, match="draw the box around what moves"):
        moving_thing(clip, at=len(clip) - 1, box=(0.02, 0.8, 0.2, 0.98))
