"""Flow, shapes, carrying and image modes on clips whose motion is written down."""

import numpy as np
import pytest
import torch
from clips import FPS, decaying, swaying, texture, thin_rod
from scipy import ndimage

from physics3d.metrics.image import likeness, psnr
from physics3d.motion.carry import carried, inverse, moved
from physics3d.motion.clip import read_clip
from physics3d.motion.flow import flow, flow_from, trust
from physics3d.motion.flow_about import REACH, flow_about
from physics3d.motion.image_modes import image_modes, of_another_take
from physics3d.motion.shapes import moving, shapes
from physics3d.motion.stills import FIRST, LAST, MEAN, stills

H, W = 96, 128
CENTRE = np.s_[H // 2 - 12 : H // 2 + 12, W // 2 - 12 : W // 2 + 12]  # well within the thing, for all shifts below


@pytest.mark.parametrize("reference", [0, 3, 6])
def test_flow_is_the_displacement_from_the_reference(reference):
    shift = np.array([0.0, 1.3, 3.1, 5.0, 2.2, -1.6, -4.0])
    u = flow(swaying(shift), reference=reference)
    # what is at the centre of frame r has moved by the difference; DIS is good to a fifth of a pixel on such a texture
    np.testing.assert_allclose(u[:, *CENTRE, 0].mean((1, 2)), shift - shift[reference], atol=0.2)
    np.testing.assert_allclose(u[:, *CENTRE, 1].mean((1, 2)), 0, atol=0.2)


def share_read(u, bend, shape, rod):
    """How much of the rod's swing a flow reads, by least squares, in the frames of the wide ones."""
    wide = np.abs(bend) > 0.5 * np.abs(bend).max()
    truth = bend[wide, None] * shape[rod]
    return (u[wide][:, rod, 0] * truth).sum(1) / (truth**2).sum(1)


T = np.arange(26) / FPS
SWING = 26 * np.exp(-0.8 * T) * np.sin(2 * np.pi * 1.2 * T)  # from rest [px]


def test_a_thin_thing_is_followed_where_it_swings_by_many_times_its_width():
    bend, width = SWING, 8
    video, shape, rod = thin_rod(bend, width=width)
    # a tenth is lost, for half of a patch is ground that stands; of a rod that is lost to the ground two thirds are
    assert (share_read(flow(video), bend, shape, rod) > 0.85).all()


def test_a_picture_that_is_not_of_the_clip_is_followed_from_the_frame_most_like_it():
    video, shape, rod = thin_rod(SWING, width=8)
    rest, late = video[0], 7  # in frame 7 the tip is 20 px away, on its way back
    u = flow_from(rest, video[late:])
    assert (share_read(u, SWING[late:], shape, rod) > 0.85).all()
    np.testing.assert_array_equal(flow_from(video[5], video), flow(video, reference=5))


@pytest.mark.parametrize("guessed", [0.8, 0.9, 1.0])
@pytest.mark.parametrize("width, wide", [(5, 1.0), (5, 1.5), (8, 1.0), (8, 1.5)])
def test_flow_about_a_guess_reads_what_is_left_of_it(guessed, width, wide):
    bend = wide * SWING
    video, shape, rod = thin_rod(bend, width=width)
    away = ndimage.distance_transform_edt(~rod)
    field = np.zeros((*video.shape[:3], 2), np.float32)
    field[..., 0] = guessed * bend[:, None, None] * shape * np.exp(-((away / REACH) ** 2))
    read = share_read(flow_about(field, video[0], video), bend, shape, rod)
    # more than half of what the guess lacks is found, of a rod that is a third of its patches, and nothing is made up;
    # half a pixel of 26 is what flow is good to
    assert (read > 1 - 0.5 * (1 - guessed) - 0.02).all() and (read < 1.02).all()


def test_what_is_covered_is_not_trusted():
    video = swaying(np.array([0.0, 9.0]))
    weight = trust(video, flow(video))[1]
    covered = np.s_[H // 2 - 5 : H // 2 + 5, W // 2 + 32 : W // 2 + 38]  # background in frame 0, under the thing in 1
    assert weight[covered].mean() < 0.6 < 0.9 < weight[CENTRE].mean()


def test_shapes_are_one_where_the_thing_is_and_zero_where_nothing_moves():
    shift = decaying(np.arange(40) / FPS)
    video = swaying(shift, noise=2.0)
    u = flow(video, reference=39)
    found = shapes(u, trust(video, u, reference=39), moving(u), count=3)
    told = np.einsum("tk,khwc->thwc", found.signal, found.shape)
    np.testing.assert_allclose(told[:, *CENTRE, 0].mean((1, 2)), shift - shift[39], atol=0.25)  # the flow's error
    assert np.abs(told[:, :8]).max() < 0.05 and np.abs(told[:, :, :8]).max() < 0.05  # the border stands still


def test_a_carried_picture_is_the_picture_taken_at_displaced_places():
    y, x = np.mgrid[:H, :W].astype(float)
    u = np.stack([3 * np.sin(y / 15), 2 * np.cos(x / 20)], -1).astype(np.float32)
    v = inverse(u)
    picture = np.repeat((255 * texture(x, y, 3) + 0.5)[..., None], 3, 2).astype(np.uint8)
    # the texture is known everywhere, so the carried picture is too: T(y + v(y))
    truth = 255 * texture(x + v[..., 0], y + v[..., 1], 3)
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(carried(picture, u)[..., 0][inner] - truth[inner]).mean() < 1.0  # grey level: rounding, cubic splines
    # and v is the inverse: v(y) + u(y + v(y)) = 0, to the thousandth of a pixel that a bilinear u allows
    back = np.stack([3 * np.sin((y + v[..., 1]) / 15), 2 * np.cos((x + v[..., 0]) / 20)], -1)
    assert np.abs(v + back)[inner].max() < 0.02


@pytest.mark.parametrize("shift", [7, 40])
def test_a_thing_arrives_however_far_it_moves(shift):
    """A thin strip, ten pixels wide, before a ground that stands; beside it the motion ends within two pixels."""
    y, x = np.mgrid[:H, :W].astype(float)
    picture = np.repeat((100 * texture(x, y, 3) + 0.5)[..., None], 3, 2).astype(np.uint8)
    strip = np.s_[20:80, 30:40]
    picture[strip] += 150
    u = np.zeros((H, W, 2), np.float32)
    u[18:82, 28:42, 0] = shift
    found = carried(picture, u)
    arrived = np.s_[20:80, 30 + shift : 40 + shift]
    assert (found[arrived] == picture[strip]).all()
    bright = found[..., 0] > 110  # no ground is: what the strip has left shows ground, and no second strip
    bright[arrived] = False
    assert not bright.any()
    beyond = np.s_[:, 44 + shift :]
    assert (found[beyond] == picture[beyond]).all()


def test_nothing_carried_is_the_picture_itself():
    picture = swaying(np.zeros(1))[0].numpy()
    assert (carried(picture, np.zeros((H, W, 2), np.float32)) == picture).all()


def test_stills_are_what_they_say():
    video = swaying(decaying(np.arange(10) / FPS))
    found = stills(video, seen=4)
    assert (found[FIRST] == video[0]).all() and (found[LAST] == video[3]).all()
    np.testing.assert_allclose(found[MEAN][0].numpy(), video[:4].double().mean(0).numpy(), atol=0.51)  # rounding
    assert all(len(clip) == 6 for clip in found.values())
    with pytest.raises(ValueError, match="seen"):
        stills(video, seen=10)


def test_image_modes_beat_every_still_picture_where_the_thing_swings():
    t = np.arange(90) / FPS
    video = swaying(decaying(t, damping=0.4), noise=2.0)
    seen, future = video[:45], video[45:]
    modes = image_modes(seen, FPS)
    predicted = modes.frames(range(45, 90))
    best = max(psnr(still, future) for still in stills(video, seen=45).values())
    assert psnr(predicted, future) > best + 5  # dB; stills are off by pixels, modes by tenths
    main = modes.decay.main()
    assert modes.decay.frequency[main] == pytest.approx(2.0, rel=0.02)
    assert modes.decay.damping[main] == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize("damping", [4.0, 8.0])
def test_what_has_come_to_rest_is_not_made_worse_than_the_still_picture(damping):
    video = swaying(decaying(np.arange(90) / FPS, damping=damping), noise=3.0)
    predicted = image_modes(video[:45], FPS).frames(range(45, 90))
    still = stills(video, seen=45)[LAST]
    assert psnr(predicted, video[45:]) > psnr(still, video[45:]) - 0.05  # dB


def test_a_still_clip_is_predicted_still():
    video = swaying(np.zeros(20), noise=2.0)
    assert (image_modes(video[:10], FPS).frames(range(10, 12)) == video[9]).all()


def test_one_take_tells_of_another():
    """Frequency, damping and shapes of the first; of the second only the start is seen, 20 frames."""
    t = np.arange(90) / FPS
    modes = image_modes(swaying(decaying(t, damping=0.4)), FPS)
    other = swaying(decaying(t, damping=0.4, amplitude=-4.0, phase=1.3))
    told = of_another_take(modes, other[:20])
    predicted = told.frames(range(20, 90))
    assert psnr(predicted, other[20:]) > psnr(stills(other, seen=20)[LAST], other[20:]) + 5
    with pytest.raises(ValueError, match="px"):
        of_another_take(modes, other[:20, :50])


def test_image_modes_beat_the_last_frame_seen_on_a_real_take(data):
    path = data / "telephone" / "videos" / "real_take1.mp4"
    if not path.is_file():
        pytest.skip(f"no {path}")
    clip = read_clip(path, longest_side=288)  # half of the file, for speed
    seen = len(clip.frames) // 2
    picks = range(seen, len(clip.frames), 6)
    future = clip.frames[torch.tensor(picks)]
    modes = image_modes(clip.frames[:seen], clip.fps)
    gain = np.mean(likeness(modes.frames(picks), future).psnr_per_frame) - np.mean(
        likeness(clip.frames[seen - 1].expand_as(future).contiguous(), future).psnr_per_frame
    )
    assert gain > 8  # dB; a first attempt had 11.5 at full size
    main = modes.decay.main()
    assert modes.decay.frequency[main] == pytest.approx(1.04, abs=0.02)  # Hz, read off the whole recording by eye


def test_pixels_that_move_are_seen_where_they_arrive():
    y, x = np.mgrid[:H, :W].astype(np.float32)
    square = lambda side: np.maximum(abs(x - 40), abs(y - 50)) < side
    grown = np.stack([0.5 * (x - 40) + 9, 0.5 * (y - 50) - 4], -1)  # about its middle, and shifted
    assert (moved(square(10.5), grown) == np.roll(square(15.75), (-4, 9), (0, 1))).all()
