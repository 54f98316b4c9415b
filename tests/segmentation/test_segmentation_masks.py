"""Maskers find a thing in one photograph, each in its way; SAM 2 runs with random weights and says what is wrong."""

import numpy as np
import pytest
import torch

from physics3d.segmentation.maskers.grabcut import GrabCut
from physics3d.segmentation.maskers.sam2 import Sam2, Sam2Video, build_sam2

NOTHING = np.zeros((0, 2))


def disc_on_noise(rng, *, centre=(60, 45), radius=25, size=(120, 100)):
    v, u = np.mgrid[: size[1], : size[0]]
    truth = (u + 0.5 - centre[0]) ** 2 + (v + 0.5 - centre[1]) ** 2 < radius**2
    image = np.where(truth[..., None], [200, 60, 50], [90, 110, 130]) + rng.normal(0, 12, (*truth.shape, 3))
    return np.clip(image, 0, 255).astype(np.uint8), truth


@pytest.mark.parametrize(
    ("box", "positive", "negative"),
    [
        ((30, 15, 90, 75), NOTHING, NOTHING),
        ((30, 15, 90, 75), np.array([[60.0, 45.0]]), np.array([[33.0, 18.0]])),
        (None, np.array([[60.0, 45.0]]), np.array([[10.0, 90.0]])),
    ],
    ids=["box", "box and points", "points"],
)
def test_grabcut_finds_a_disc(box, positive, negative):
    image, truth = disc_on_noise(np.random.default_rng(0))
    box = None if box is None else np.array(box, float)
    mask = GrabCut()(image, box=box, positive=positive, negative=negative)
    # colours are nine deviations apart: only pixels of the outline may differ
    assert (mask & truth).sum() / (mask | truth).sum() > 0.95


def test_grabcut_is_repeatable():
    image, _ = disc_on_noise(np.random.default_rng(0))
    once, twice = (GrabCut()(image, box=np.array([30.0, 15, 90, 75]), positive=NOTHING, negative=NOTHING) for _ in "ab")
    assert np.array_equal(once, twice)


def test_grabcut_keeps_what_was_pointed_at():
    rng = np.random.default_rng(0)
    image, left = disc_on_noise(rng, centre=(30, 50), radius=18)
    other, right = disc_on_noise(rng, centre=(90, 50), radius=18)
    image[right] = other[right]
    mask = GrabCut()(image, box=np.array([5.0, 20, 115, 80]), positive=np.array([[30.0, 50.0]]), negative=NOTHING)
    assert mask[left].mean() > 0.95 and not mask[right].any()


def test_grabcut_finds_thin_things_near_a_blunt_guess():
    rng = np.random.default_rng(0)
    image, disc = disc_on_noise(rng)
    stalk, _ = disc_on_noise(rng, radius=500)
    truth = disc.copy()
    truth[14:25, 58:62] = True  # four pixels wide, and longer than the guess knows
    image[truth] = stalk[truth]
    mask = GrabCut().refine(image, 0.98 * disc.astype(float) + 0.01)
    # rounded ends, and half a pixel of the outline
    assert (mask & truth).sum() / (mask | truth).sum() > 0.95 and mask[16:24, 60].all()


def test_what_is_clicked_away_teaches_no_colours_of_the_object():
    rng = np.random.default_rng(0)
    image, truth = disc_on_noise(rng, centre=(50, 45), radius=18)
    beside, other = disc_on_noise(rng, centre=(80, 60), radius=14)
    image[other & ~truth] = (np.roll(beside, 1, 2))[other & ~truth]
    box, on, off = np.array([25.0, 20, 100, 80]), np.array([[50.0, 45.0]]), np.array([[82.0, 62.0]])
    mask = GrabCut()(image, box=box, positive=on, negative=off)
    assert (mask & truth).sum() / (mask | truth).sum() > 0.95


def test_sam2_with_random_weights_returns_a_mask_of_the_image(tmp_path):
    from hydra.core.global_hydra import GlobalHydra

    torch.manual_seed(0)
    config, size = "sam2.1/sam2.1_hiera_t", 128
    weights = tmp_path / "random.pt"
    torch.save({"model": build_sam2(config, size).state_dict()}, weights)
    assert not GlobalHydra.instance().is_initialized()  # a Hydra application around us stays possible

    masker = Sam2(config=config, weights=str(weights), image_size=size)
    image, _ = disc_on_noise(np.random.default_rng(0))
    for box, positive in ((np.array([30.0, 15, 90, 75]), NOTHING), (None, np.array([[60.0, 45.0]]))):
        mask = masker(image, box=box, positive=positive, negative=np.array([[5.0, 5.0]]))
        assert mask.shape == (100, 120) and mask.dtype == bool
    refined = masker.refine(image, np.full((100, 120), 0.6))
    assert refined.shape == (100, 120) and refined.dtype == bool

    # the same weights follow a mask through pictures of different sizes, in both directions
    _, given = disc_on_noise(np.random.default_rng(0))
    frames = [image, np.roll(image, 4, 1), np.roll(image, 8, 1)[:80]]
    found = Sam2Video(still=masker).follow(frames, 1, given)
    assert [m.shape for m in found] == [(100, 120), (100, 120), (80, 120)] and all(m.dtype == bool for m in found)
    assert np.array_equal(found[1], given)

    with pytest.raises(ValueError, match=r"masker.weights=.* does not fit"):
        torch.save({"model": {"a": torch.zeros(1)}}, weights)
        _ = Sam2(config=config, weights=str(weights), image_size=size).predictor


def test_sam2_names_the_key_when_weights_are_absent(monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(ValueError, match=r"masker.weights=nobody/sam2-none .*GrabCut"):
        _ = Sam2(weights="nobody/sam2-none", image_size=128).predictor
    with pytest.raises(ValueError, match=r"masker.config=sam9 is none of sam2.1/sam2.1_hiera_b\+"):
        _ = Sam2(config="sam9").predictor
