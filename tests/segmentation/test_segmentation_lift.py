"""Masks are carried and lifted: labels of a scene that is known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import cameras_around, captured, discs, joined, sphere, spheres_on_table

from physics3d.gaussians.rasterize import rasterize
from physics3d.gaussians.render import render
from physics3d.log import Log
from physics3d.segmentation.belief import expected, one_hot, shares
from physics3d.segmentation.carry_masks import along_path, carry_masks
from physics3d.segmentation.claims import contested
from physics3d.segmentation.lift import NEGLIGIBLE, contributions, lift, trust
from physics3d.segmentation.maskers.base import AbstractVideoMasker
from physics3d.segmentation.maskers.grabcut import GrabCut
from physics3d.segmentation.neighbours import beside_static, islands
from physics3d.segmentation.pixels import intersection_over_union
from physics3d.segmentation.prompted import mask_of_boxes
from physics3d.segmentation.prompts import Prompt
from physics3d.segmentation.rooms import Room
from physics3d.segmentation.views import View

CAMERAS = cameras_around(10, 0.4)


@pytest.fixture(scope="module")
def scene():
    return spheres_on_table(np.random.default_rng(0))


def true_map(gaussians, truth, camera):
    """Label of the part that contributes most to each pixel."""
    one_hot = torch.nn.functional.one_hot(truth, 3).float()
    shape = gaussians.covariance()
    drawn = rasterize(gaussians.mean, shape, gaussians.opacity, one_hot, camera, background=(1.0, 0.0, 0.0))
    return drawn.color.argmax(-1)


def weighted_overlap(found, true, weight) -> float:
    return float((weight * (found & true)).sum() / (weight * (found | true)).sum())


def test_exact_masks_give_back_the_labels(scene):
    gaussians, truth, opacity = scene
    maps = [true_map(gaussians, truth, c) for c in CAMERAS]
    label = lift(gaussians.mean, contributions(gaussians, CAMERAS, maps, 3))
    seen = gaussians.mean[:, 2] > -0.038  # the undersides, near the table, show in no camera
    for k in (1, 2):
        assert weighted_overlap((label == k) & seen, (truth == k) & seen, opacity) > 0.97


def test_the_label_is_that_of_the_larger_contribution():
    weights = torch.tensor([[5.0, 1.0], [1.0, 1.2], [0.0, 0.0], [0.0, 0.0]])
    mean = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.1, 0, 0], [0.9, 0, 0]])
    # the last two show nowhere; with two known ones, both vote and ties go to static
    assert lift(mean, weights)[:2].tolist() == [0, 1]
    with pytest.raises(ValueError, match="no Gaussian contributes"):
        lift(mean, torch.zeros(4, 2))


def test_hidden_gaussians_take_the_label_of_their_neighbours(scene):
    gaussians, truth, _ = scene
    rng = np.random.default_rng(1)
    core, _ = sphere(50, 0.03, rng)
    core[:, 2] = np.abs(core[:, 2])  # below, the nearest Gaussians that show are those of the table
    hidden = discs(core - np.array([0.06, 0, 0]), core / 0.03, rng, sigma=0.0005)
    both = joined(gaussians, replace(hidden, opacity_logit=hidden.opacity_logit - 5))
    maps = [true_map(gaussians, truth, c) for c in CAMERAS]
    weights = contributions(both, CAMERAS, maps, 3)
    assert float(weights[-50:].sum(1).max()) < NEGLIGIBLE
    assert (lift(both.mean, weights)[-50:] == 1).all()


def test_contributions_add_up_to_opaque_pixels(scene):
    gaussians, truth, _ = scene
    camera = CAMERAS[0]
    labelled = true_map(gaussians, truth, camera)
    total = contributions(gaussians, [camera], [labelled], 3).sum()
    alpha = (trust(labelled) * render(gaussians, camera, background=(0.0, 0.0, 0.0)).alpha).sum()
    # float32 sums over ten thousand Gaussians
    assert float(total) == pytest.approx(float(alpha), rel=1e-3)


def test_only_pixels_next_to_an_outline_count_less():
    labelled = torch.zeros(20, 20, dtype=torch.int64)
    labelled[:, 10:] = 2
    counts = trust(labelled)
    assert (counts[:, :9] == 1).all() and (counts[:, 11:] == 1).all() and (counts[:, 9:11] < 0.5).all()
    assert (trust(0 * labelled) == 1).all()


def test_the_rim_of_a_body_has_its_label(scene):
    gaussians, truth, opacity = scene
    seen = gaussians.mean[:, 2] > -0.038
    # masks of 64 px: a ball is 16 wide
    cameras = [c.scaled(0.4) for c in CAMERAS]
    label = lift(gaussians.mean, contributions(gaussians, cameras, [true_map(gaussians, truth, c) for c in cameras], 3))
    # some that show next to nowhere may be wrong; were all pixels to count the same, it would be 0.988
    for k in (1, 2):
        assert weighted_overlap((label == k) & seen, (truth == k) & seen, opacity) > 0.99


def views(gaussians):
    capture = captured(gaussians, CAMERAS)
    return [
        View(i, n, im.numpy(), c, render(gaussians, c, background=(1.0, 1.0, 1.0)))
        for i, (n, im, c) in enumerate(zip(capture.names, capture.images, CAMERAS))
    ]


def test_labels_of_one_view_are_right_where_they_show_in_others(scene):
    gaussians, truth, _ = scene
    allowed = truth != 2  # the green ball hides behind the red one, and is nobody's to find from there
    first, *others = CAMERAS
    seen = [(true_map(gaussians, truth, first) == 1).long()]
    label = lift(gaussians.mean, contributions(gaussians, [first], seen, 2)) * allowed
    for camera in (others[0], others[-1]):
        (share,) = shares(gaussians, one_hot(label, 1), camera)
        true = (true_map(gaussians, truth, camera) == 1).numpy()
        # 36 degrees on, a tenth of the ball was not seen yet and has the label of its neighbours
        assert ((share > 0.5) & true).sum() / ((share > 0.5) | true).sum() > 0.9


def test_a_part_in_several_boxes_is_masked_in_all_of_them(scene):
    """A red and a green ball, a box around each: the colours of one are no hint of the other."""
    gaussians, truth, _ = scene
    boxes = (
        Prompt(lower=(-0.115, -0.055, -0.045), upper=(-0.005, 0.055, 0.055)),
        Prompt(lower=(0.015, -0.045, -0.045), upper=(0.105, 0.045, 0.035)),
    )
    for own in (boxes, boxes[::-1]):
        for view in views(gaussians)[::3]:
            mask = mask_of_boxes(own, view, GrabCut())
            true = (true_map(gaussians, truth, view.camera) > 0).numpy()
            assert intersection_over_union(mask, true) > 0.9  # outlines of balls of 30 pixels, one pixel off


def test_what_no_view_has_shown_may_be_of_the_nearest_part_that_has_room():
    mean = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.3, 0, 0], [0.8, 0, 0], [2.0, 0, 0]])
    weights = torch.tensor([[0.0, 5.0, 0.0], [0.0, 0.0, 5.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    rooms = torch.tensor([[True, True, True, True, True], [True, True, True, False, True]])
    said, possible = expected(mean, weights, rooms)
    # half of the usual 5 is unknown of everything: 5/7.5 of the first two is known
    assert torch.allclose(said, torch.tensor([[2.0, 0], [0, 2], [0, 0], [0, 0], [0, 0]]) / 3)
    # the third is near the first part; the fourth is near the second, which has no room for it
    assert possible[2:4].tolist() == [[1, 0], [1, 0]]


def test_beliefs_of_the_seen_and_of_the_unseen_add_up():
    rng = np.random.default_rng(0)
    mean, weights = torch.from_numpy(rng.random((50, 3))), torch.from_numpy(rng.random((50, 3)) ** 4)
    said, possible = expected(mean, weights, torch.ones(2, 50, dtype=torch.bool))
    elsewhere = weights[:, 0] * said.sum(1) / weights[:, 1:].sum(1)
    # every Gaussian has room in a part, so that what is neither said of a part nor of none may be a part's; float32
    torch.testing.assert_close((said.sum(1) + possible.sum(1) + elsewhere).float(), torch.ones(50))
    # the more a view shows of it, the less is only possible
    assert (possible.sum(1).argsort() == weights.sum(1).argsort(descending=True)).all()


def test_only_a_pixel_that_two_parts_claim_goes_to_the_one_that_shows_most():
    masks = [np.array([[True, True, False, True]]), np.array([[False, True, True, True]])]
    drawn = np.array([[[0.2, 0.3, 0.9, 0.6]], [[0.7, 0.5, 0.1, 0.4]]])
    one, two = contested(masks, drawn)
    assert one.tolist() == [[True, False, False, True]] and two.tolist() == [[False, True, True, False]]


def test_shares_add_up_to_alpha(scene):
    gaussians, truth, _ = scene
    drawn = shares(gaussians, one_hot(truth + 1, 3), CAMERAS[0])
    alpha = render(gaussians, CAMERAS[0], background=(0.0, 0.0, 0.0)).alpha.numpy()
    # float32 sums of some ten weights
    np.testing.assert_allclose(drawn.sum(0), alpha, atol=1e-5)


def test_a_mask_reaches_the_far_side(scene):
    gaussians, truth, _ = scene
    a, b, first, *rest = views(gaussians)  # the third shows the red ball whole
    others = [a, b, *rest]
    mask = (true_map(gaussians, truth, first.camera) == 1).numpy()
    rooms = {"red": Room.around(first, mask)}
    masks = carry_masks(gaussians, first, {"red": mask}, rooms, [first, *others], GrabCut(), log=Log(None))
    assert len(masks) >= 9
    for view in others:
        true = (true_map(gaussians, truth, view.camera) == 1).numpy()
        if view.index in masks:
            assert intersection_over_union(masks[view.index]["red"], true) > 0.8, view.name


def test_a_video_masker_gets_the_views_along_the_path_of_the_cameras(scene):
    first, *others = views(scene[0])
    path = [v.index for v in along_path(first, [*others[::2], first, *others[1::2]])]
    steps = np.abs(np.diff(path)) % 10
    # ten cameras on a circle: neighbours have neighbouring numbers, and first is among them
    assert sorted(path) == list(range(10)) and set(steps) <= {1, 9}


def test_what_a_video_masker_followed_is_carried(scene):
    gaussians, truth, _ = scene
    first, *others = views(gaussians)[2:5]
    true = {v.index: (true_map(gaussians, truth, v.camera) == 1).numpy() for v in (first, *others)}

    class Knows(AbstractVideoMasker):
        def follow(self, images, start, mask):
            order = [v.index for v in along_path(first, others)]
            return [true[i] if i != others[1].index else ~true[i] for i in order]

    rooms = {"red": Room.around(first, true[first.index])}
    masks = carry_masks(gaussians, first, {"red": true[first.index]}, rooms, others, Knows(), log=Log(None))
    # and where it lost the object the view is left out
    assert set(masks) == {first.index, others[0].index}
    assert intersection_over_union(masks[others[0].index]["red"], true[others[0].index]) > 0.95


def test_islands_are_the_small_clusters_apart():
    rng = np.random.default_rng(0)
    large, small, near = sphere(1000, 0.05, rng)[0], rng.normal(0, 0.001, (20, 3)) + 0.5, np.array([[0.052, 0, 0]])
    mean = torch.from_numpy(np.concatenate([large, small, near])).float()
    label = torch.ones(len(mean), dtype=torch.int32)
    apart = islands(mean, torch.ones(len(mean)), label)
    assert apart[1000:1020].all() and not apart[1020] and not apart[:1000].any()
    assert not islands(mean, torch.ones(len(mean)), 0 * label).any()


def test_touching_gaussians_are_those_next_to_static_ones():
    x = torch.linspace(0, 1, 401)
    mean = torch.stack([x, 0 * x, 0 * x], 1)
    found = beside_static(mean, torch.ones(401), (x > 0.5).to(torch.int32))
    assert found.any() and float(x[found].max()) < 0.53 and not found[x <= 0.5].any()


@pytest.mark.parametrize(
    ("prompt", "remedy"),
    [
        ({"positive": ((1.2, 0.5),)}, "positive.0.0 is 1.2; take a number >= 0 and <= 1"),
        ({"box": (10, 20, 200, 300)}, "box.0 is 10; take a number >= 0 and <= 1"),
        ({"box": (0.6, 0.1, 0.3, 0.9)}, "left < right"),
        ({"lower": (0, 0, 0)}, "take both corners, or neither"),
        ({"lower": (0, 0, 1), "upper": (1, 1, 0)}, "below upper"),
        ({}, "take at least one of positive, box, lower"),
    ],
)
def test_a_prompt_that_cannot_be_is_refused(prompt, remedy):
    with pytest.raises(ValueError, match=remedy):
        Prompt(**prompt).check()
