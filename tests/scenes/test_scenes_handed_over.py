"""A twin as files: photographs, clips, and the truth outside of what is read."""

import numpy as np
import pytest
import torch
import yaml
from clips import FPS, decaying, swaying
from PIL import Image

from physics3d.boundaries.impulse import Impulse
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.motion.clip import read_clip
from physics3d.scenes.base import Capture, Take
from physics3d.scenes.clips import clip_files
from physics3d.scenes.handed_over import hand_over


@pytest.fixture(scope="module")
def capture():
    pose = look_at(torch.tensor([0.0, -0.5, 0.2]), torch.zeros(3))
    camera = Camera(width=128, height=96, fx=150, fy=150, cx=64, cy=48, world_to_camera=pose)
    video = swaying(decaying(np.arange(20) / FPS))
    poke = Impulse(force=(0.1, 0.0, 0.0), centre=(0.0, 0.0, 0.1), radius=0.05, start=0.0, duration=0.1)
    takes = [
        Take(name=role, role=role, fps=FPS, cameras=(camera,), videos=(video,), excitation=(poke,))
        for role in ("learn", "evaluate")
    ]
    return Capture(
        name="thing", images=tuple(video[:3]), cameras=(camera,) * 3, names=("a", "b", "c"), takes=tuple(takes),
        truth={"youngs_modulus": 1.5e5},
    )  # fmt: skip


def test_a_person_gets_pictures_and_clips_and_no_truth(capture, tmp_path):
    thing = hand_over(capture, tmp_path / "out", density=300.0)
    assert sorted(p.relative_to(thing).as_posix() for p in thing.rglob("*") if p.is_file()) == [
        "IMG_0001.jpg", "IMG_0002.jpg", "IMG_0003.jpg", "clips/poke_1.mp4", "clips/poke_2.mp4",
    ]  # fmt: skip
    with Image.open(thing / "IMG_0002.jpg") as picture:
        difference = np.asarray(picture, float) - capture.images[1].numpy()
    assert np.abs(difference).mean() < 3  # JPEG
    clip = read_clip(clip_files(thing / "clips")[0])
    assert clip.fps == FPS and len(clip.frames) == 20
    truth = yaml.safe_load((tmp_path / "out" / "truth.yaml").read_text())
    assert truth["material"] == {"density": 300.0, "youngs_modulus": 1.5e5}
    pose = truth["clips"]["poke_1.mp4"]["camera"]["world_to_camera"]
    np.testing.assert_allclose(pose, capture.cameras[0].world_to_camera)
    assert "0.1" in truth["clips"]["poke_1.mp4"]["excitation"][0]
    assert not list(tmp_path.glob(".twin_*"))


def test_nothing_is_overwritten(capture, tmp_path):
    with pytest.raises(ValueError, match="exists already"):
        hand_over(capture, tmp_path, density=300.0)
