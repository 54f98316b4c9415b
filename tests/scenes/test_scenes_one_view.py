"""A body from one outline: against the solids that have that outline and are round."""

import numpy as np
import pytest
import torch

from physics3d.gaussians.render import render
from physics3d.scenes.clip import held_end, level_camera
from physics3d.scenes.one_view import one_view, rounded

H, W = 90, 120


def outline(kind):
    y, x = np.mgrid[:H, :W]
    if kind == "ball":
        return (y - 45) ** 2 + (x - 60) ** 2 < 30.5**2, lambda r: np.sqrt(np.maximum(30.5**2 - r, 0))
    return (np.abs(x - 60) < 12.5) & (y > 5) & (y < 85), None


def test_the_outline_of_a_ball_gives_the_ball():
    mask, _ = outline("ball")
    y, x = np.mgrid[:H, :W]
    true = np.sqrt(np.maximum(30.5**2 - (y - 45) ** 2 - (x - 60) ** 2, 0)) * mask
    depth = rounded(mask)
    assert (depth[~mask] == 0).all()
    # the distance from the outline is known to a pixel
    inner = true > 10
    assert np.abs(depth - true)[inner].max() < 1.6
    assert depth.sum() == pytest.approx(true.sum(), rel=0.05)


@pytest.mark.parametrize("angle", [0, 30, 45])
def test_a_strip_gives_a_rod(angle):
    y, x = np.mgrid[:H, :W] - np.array([45.0, 60.0])[:, None, None]
    a = np.radians(angle)
    across = x * np.cos(a) + y * np.sin(a)
    along = -x * np.sin(a) + y * np.cos(a)
    mask = (np.abs(across) < 9.5) & (np.abs(along) < 38)
    true = np.sqrt(np.maximum(9.5**2 - across**2, 0))
    middle = mask & (np.abs(along) < 20) & (np.abs(across) < 8)
    # the distance from an outline of pixels is known to a pixel, half of it on either side
    assert np.abs(rounded(mask) - true)[middle].max() < 1.5
    second = lambda z: float((z[middle] ** 3).sum())  # of area, about the middle plane: of the bending stiffness
    assert second(rounded(mask)) == pytest.approx(second(true), rel=0.15)


def test_gaussians_of_one_view_show_the_photograph(rng):
    mask, _ = outline("ball")
    camera = level_camera(W, H, opening=50, distance=0.7)
    photograph = np.full((H, W, 3), 60, np.uint8)
    photograph[mask] = (200, 120, 40)
    held = mask & (np.arange(H)[:, None] > 68)
    gaussians, moves = one_view(photograph, mask, held, camera, distance=0.7)
    drawn = render(gaussians, camera, background=(1.0, 1.0, 1.0)).color.numpy() * 255
    # but for the outline, which discs of two pixels blur: a tenth of the pixels
    assert np.abs(drawn - photograph).mean() < 6
    front = gaussians.mean[moves].double()
    centre = torch.zeros(3, dtype=torch.float64)
    pixel = 0.7 / camera.fx
    radius = ((front - centre).norm(dim=1) / pixel).numpy()
    # half a pixel off the middle; perspective moves what is nearer outwards
    assert np.percentile(np.abs(radius - 30.5), 95) < 3.5
    assert front[:, 2].min() > -29 * pixel  # what is held, 23 px below the middle as far away as that, does not move


def test_what_is_held_is_the_end_that_moves_least():
    mask = np.zeros((H, W), bool)
    mask[10:80, 55:65] = True
    size = np.where(mask, np.linspace(1, 0, H)[:, None], 0)
    held = held_end(mask, size)
    rows = np.nonzero(held.any(1))[0]
    assert rows.min() > 55 and rows.max() == 79 and not (held & ~mask).any()
