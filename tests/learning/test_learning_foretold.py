"""Pictures of what is to come: against a disc that turns by a large angle, whose pictures are known at any angle."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage

from physics3d.learning.foretold import foretold
from physics3d.learning.identify import Oscillations, Swing
from physics3d.learning.large_swing import SMALL
from physics3d.learning.seen_modes import Sight
from physics3d.metrics.image import likeness

SIDE, FPS, PERIOD = 96, 30.0, 20  # [px], [1/s], frames
ANGLE = 0.7  # largest [rad]
MIDDLE = (SIDE - 1) / 2


def pictures(angles):
    """Texture turned about the middle of the picture, as the camera would see it."""
    rng = np.random.default_rng(0)
    texture = 128 + 400 * ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE, 3)), (2.0, 2.0, 0))
    turns = [cv2.getRotationMatrix2D((MIDDLE, MIDDLE), -np.degrees(angle), 1.0) for angle in angles]
    drawn = [cv2.warpAffine(texture, turn, (SIDE, SIDE), flags=cv2.INTER_CUBIC) for turn in turns]
    return torch.from_numpy(np.stack(drawn).clip(0, 255).astype(np.uint8))


def seen_at(angles):
    """(the flow from the picture at angle 0, what a camera sees of one small turn)."""
    y, x = np.mgrid[:SIDE, :SIDE] - MIDDLE
    turned = [np.stack([np.cos(a) * x - np.sin(a) * y, np.sin(a) * x + np.cos(a) * y], -1) for a in angles]
    flow = np.stack(turned).astype(np.float32) - np.stack([x, y], -1).astype(np.float32)
    pixel = np.argwhere(np.ones((SIDE, SIDE), bool))
    jacobian = np.stack([-y, x], -1).reshape(-1, 2, 1)
    return flow, Sight(thing=np.ones((SIDE, SIDE), bool), pixel=pixel, jacobian=jacobian)


@pytest.fixture
def swing():
    one = np.ones((1, 1))
    modes = Oscillations(
        shape=one, span=one, frequency=np.array([FPS / PERIOD]), damping=np.zeros(1), large=SMALL, power=1.0
    )
    return Swing(modes=modes, amplitude=np.array([[ANGLE, 0.0]]), rest=np.zeros(1), large=SMALL, unexplained=0.0)


def angles_at(frames):
    return ANGLE * np.cos(2 * np.pi * np.asarray(frames) / PERIOD)


def test_what_swings_back_to_where_it_was_seen_looks_as_it_did(swing):
    seen, later = np.arange(PERIOD), np.arange(PERIOD, 2 * PERIOD)
    flow, sight = seen_at(angles_at(seen))
    frames = pictures(angles_at(seen))
    assert torch.equal(foretold(frames, sight, swing, flow, at=seen / FPS, times=later / FPS), frames)


def test_a_wide_swing_is_drawn_from_a_frame_that_is_near(swing):
    seen, later = np.arange(PERIOD), np.arange(PERIOD, 2 * PERIOD) + 0.5
    flow, sight = seen_at(angles_at(seen))
    frames, truth = pictures(angles_at(seen)), pictures(angles_at(later))
    told = dict(at=seen / FPS, times=later / FPS)
    near = likeness(foretold(frames, sight, swing, flow, **told), truth).psnr
    alone = likeness(foretold(frames[-1:], sight, swing, flow[-1:], **told | dict(at=seen[-1:] / FPS)), truth).psnr
    assert near > alone + 6  # a small turn carries by half a step, by a whole swing it stretches: half the error


def test_what_has_stopped_keeps_its_last_picture(swing):
    seen = np.arange(PERIOD)
    flow, sight = seen_at(angles_at(seen))
    frames = pictures(angles_at(seen))
    still = replace(swing, amplitude=np.zeros((1, 2)))
    told = foretold(frames, sight, still, flow, at=seen / FPS, times=np.array([25.0, 31.0]) / FPS)
    assert torch.equal(told, frames[-1:].expand_as(told))
