"""The evaluate stage: every video beside the frozen picture, and errors of parameters where the truth is known."""

import math
from dataclasses import replace

import pytest
import torch

from physics3d.boundaries.impulse import Impulse
from physics3d.gaussians.cameras import Camera
from physics3d.log import Log
from physics3d.metrics.comparable import same
from physics3d.metrics.scores import FROZEN, REFERENCE, Scores
from physics3d.scenes.base import Capture, Take
from physics3d.video import Video
from physics3d.world import Estimate
from stages.evaluate import Evaluate

FPS, H, W = 30.0, 60, 80


def swing(frequency: float, frames: int = 40, scale: int = 1):
    """A textured disc that swings sideways, 5 px."""
    t = torch.arange(frames) / FPS
    shift = scale * 5 * torch.exp(-t) * torch.sin(2 * math.pi * frequency * t)
    y, x = torch.meshgrid(
        torch.arange(scale * H) - scale * H / 2, torch.arange(scale * W) - scale * W / 2, indexing="ij"
    )
    x, y = (x[None] - shift[:, None, None]) / scale, y[None] / scale
    image = 0.5 + torch.exp(-(((x**2 + y**2) / 15**2) ** 2)) * 0.4 * torch.sin(x / 2) * torch.cos(y / 3)
    return (image[..., None] * 255).round().to(torch.uint8).expand(-1, -1, -1, 3).contiguous()


def capture(*videos, role="evaluate", held_out=()) -> Capture:
    camera = Camera(width=W, height=H, fx=80, fy=80, cx=40, cy=30, world_to_camera=torch.eye(4, dtype=torch.float64))
    take = Take(
        name="poke", role=role, fps=FPS, cameras=(camera,) * len(videos), videos=videos, held_out_cameras=held_out
    )
    return Capture(
        name="disc",
        images=(),
        cameras=(),
        names=(),
        takes=(take,),
        truth={"youngs_modulus": 2e4},
        truth_source="made up",
    )


def video(*clips) -> Video:
    return Video(frames=clips, fps=FPS, names=tuple(f"camera{i}" for i in range(len(clips))))


def estimate(value: float) -> Estimate:
    return Estimate(parameters={"youngs_modulus": torch.tensor(value)}, velocity=torch.zeros(3))


def test_good_motion_beats_the_frozen_picture_which_beats_nothing_on_motion(tmp_path):
    scores = Evaluate()(
        capture(swing(1.5)),
        {"learned": video(swing(1.52)), "initial": video(swing(2.5))},
        {"learned": estimate(2.2e4), "initial": estimate(5e3)},
        log=Log(tmp_path, quiet=True),
    )
    v = scores.values
    assert list(v) == [REFERENCE, FROZEN, "learned", "initial"]
    for metric in ("psnr", "ssim", "vmaf", "motion_psnr"):
        assert v["learned"][metric] > v[FROZEN][metric], metric
    assert v["learned"]["flow_error"] < 0.5 < v[FROZEN]["flow_error"] == pytest.approx(1)
    assert v[REFERENCE]["frequency"] == pytest.approx(1.5, rel=0.02) and v["initial"]["frequency"] == pytest.approx(
        2.5, rel=0.05
    )
    assert v[FROZEN]["frequency"] is None and f"oscillation of {FROZEN}" in scores.notes
    assert v["learned"]["ms_ssim"] is None and "176 px" in scores.notes["ms_ssim"]
    row = scores.parameters["learned: youngs_modulus"]
    assert row["error_percent"] == pytest.approx(10, abs=1e-3) and row["log_ratio"] == pytest.approx(
        math.log(1.1), abs=1e-5
    )
    assert scores.parameters["initial: youngs_modulus"]["error_percent"] == pytest.approx(-75, abs=1e-3)
    for name in ("frames.png", "slices.png", "bars.png", "side_by_side.mp4"):
        assert (tmp_path / "previews" / name).stat().st_size > 500
    assert "| learned |" in (tmp_path / "scores.md").read_text()
    scores.save(tmp_path / "scores")
    assert Scores.load(tmp_path / "scores") == scores


def test_held_out_cameras_of_the_learning_take_are_the_reference():
    right, wrong = swing(1.5), swing(2.5)
    reference = capture(wrong, right, role="learn", held_out=(1,))
    for made in (video(right), video(wrong, right)):  # only the held-out camera, or all of them
        scores = Evaluate()(reference, {"learned": made}, {}, log=Log(None))
        assert scores.values["learned"]["psnr"] == math.inf
        assert "reference" not in scores.notes and not scores.parameters


def test_scoring_the_frames_learned_from_is_said_so():
    scores = Evaluate()(capture(swing(1.5), role="learn"), {"learned": video(swing(1.5))}, {}, log=Log(None))
    assert "learned from" in scores.notes["reference"]


def test_a_larger_reference_is_averaged_down_and_a_longer_one_cut():
    scores = Evaluate()(capture(swing(1.5, scale=2)), {"learned": video(swing(1.5)[:20])}, {}, log=Log(None))
    assert scores.values["learned"]["psnr"] > 30  # the same motion up to resampling


def test_videos_that_show_another_excitation_are_marked():
    poke = Impulse(force=(1.0, 0.0, 0.0), centre=(0.0, 0.0, 0.0), radius=0.1, start=0.0, duration=0.1)
    reference = capture(swing(1.5))
    reference = replace(reference, takes=(replace(reference.takes[0], excitation=(poke,)),))
    for force, alike in (({"x": 1.0, "y": 0.0, "z": 0.0}, True), ({"x": 0.0, "y": 1.0, "z": 0.0}, False)):
        stage = Evaluate(excitation=(poke,), force=force)
        scores = stage(reference, {"learned": video(swing(1.4))}, {}, log=Log(None))
        assert scores.comparable == alike and ("comparison" in scores.notes) != alike


def test_what_cannot_be_compared_is_refused():
    reference, good = capture(swing(1.5)), swing(1.5)
    for made, word in (
        (video(good, good, good), "3 cameras"),
        (replace(video(good), fps=24.0), "simulate.fps"),
        (video(good[:, :, :60].contiguous()), "one scale"),
        (video(swing(1.5, scale=2)), "one scale"),
    ):
        with pytest.raises(ValueError, match=word):
            Evaluate()(reference, {"learned": made}, {}, log=Log(None))
    with pytest.raises(ValueError, match="nothing to evaluate"):
        Evaluate()(replace(reference, takes=()), {"learned": video(good)}, {}, log=Log(None))


def test_pokes_are_compared_whatever_region_they_take():
    ball = Impulse(force=(0.1, 0.0, 0.0), centre=(0.0, 0.0, 0.1), radius=0.02, duration=0.1)
    box = Impulse(force=(0.1, 0.0, 0.0), lower=(0.0, 0.0, 0.0), upper=(0.1, 0.1, 0.1), duration=0.1)
    each = Impulse(acceleration_of_each=(0.1, 0.0, 0.0), centre=(0.0, 0.0, 0.1), nearest=5, duration=0.1)
    for i, one in enumerate((ball, box, each)):
        for j, other in enumerate((ball, box, each)):
            assert same((one,), (other,)) == (i == j)
