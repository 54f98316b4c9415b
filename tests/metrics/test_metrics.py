"""Metrics on pairs of clips whose scores are known."""

import math

import numpy as np
import pytest
import torch

from physics3d.metrics.against import Reference
from physics3d.metrics.image import likeness, ms_ssim, psnr, ssim
from physics3d.metrics.motion import dominant, flow_error, motion_psnr, oscillation, signal
from physics3d.metrics.scores import Scores
from physics3d.metrics.video import vmaf
from physics3d.motion.flow import flow
from physics3d.motion.shapes import moving

FPS = 30.0


def swinging(amplitude=6.0, frequency=1.5, damping=1.0, frames=60, h=96, w=128):
    """A textured blob that swings sideways about the middle [px, Hz, 1/s] before a grey background."""
    t = torch.arange(frames) / FPS
    shift = amplitude * torch.exp(-damping * t) * torch.sin(2 * math.pi * frequency * t)
    y, x = torch.meshgrid(torch.arange(h) - h / 2, torch.arange(w) - w / 2, indexing="ij")
    x = x[None] - shift[:, None, None]
    blob = torch.exp(-(((x**2 + y[None] ** 2) / 20**2) ** 2))
    texture = 0.5 + 0.4 * torch.sin(x / 2) * torch.cos(y[None] / 3)
    image = 0.5 + blob * (texture - 0.5)
    return (image[..., None] * 255).round().to(torch.uint8).expand(-1, -1, -1, 3).contiguous()


def still(video):
    return video[:1].expand_as(video).contiguous()


def test_identical_clips_have_the_best_scores():
    video = swinging(frames=12, h=192, w=200)
    assert psnr(video, video) == math.inf
    assert ssim(video, video) == pytest.approx(1, abs=1e-5)  # float32 means
    assert ms_ssim(video, video)[0] == pytest.approx(1, abs=1e-5)
    assert vmaf(video, video)[0] > 0.95  # 0.998 on camera pictures; libvmaf v0.6.1 does not promise exactly 1
    assert motion_psnr(video, video)[0] == math.inf


@pytest.mark.parametrize("h, w", [(176, 181), (193, 230)])
@pytest.mark.parametrize("change", [lambda v: torch.roll(v, 3, 2), lambda v: v // 2 + 40, lambda v: 255 - v])
def test_likeness_is_that_of_torchmetrics(change, h, w):
    from torchmetrics.functional.image import multiscale_structural_similarity_index_measure as of_scales
    from torchmetrics.functional.image import structural_similarity_index_measure as of_one

    noise = torch.randint(0, 40, (3, h, w, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    video = swinging(frames=3, h=h, w=w) // 2 + noise
    found = likeness(change(video), video)
    a, b = (clip.permute(0, 3, 1, 2).double() / 255 for clip in (change(video), video))
    told = dict(data_range=1.0, reduction="none")
    # float32: squares of colours to 1e-7, against c2 = 9e-4
    assert found.ssim == pytest.approx(of_one(a, b, **told).tolist(), abs=2e-5)
    assert found.ms_ssim == pytest.approx(of_scales(a, b, **told).tolist(), abs=2e-5)
    assert found.psnr == pytest.approx(10 * math.log10(1 / float(((a - b) ** 2).mean())), abs=1e-9)


def test_psnr_of_a_constant_offset_is_known():
    video = torch.full((3, 8, 8, 3), 100, dtype=torch.uint8)
    assert psnr(video + 10, video) == pytest.approx(20 * math.log10(255 / 10), abs=1e-9)


def test_every_score_falls_with_the_size_of_a_shift():
    video = swinging(frames=8, h=192, w=200)
    scores = []
    for shift in (0, 1, 4):
        moved = torch.roll(video, shift, 2)
        scores.append([psnr(moved, video), ssim(moved, video), ms_ssim(moved, video)[0], vmaf(moved, video)[0]])
    assert (np.diff(np.array(scores), axis=0) < 0).all(), scores


def test_small_pictures_give_none_with_a_reason():
    video = swinging(frames=8)[:, :30, :31].contiguous()
    assert ms_ssim(video, video) == (None, "MS-SSIM needs both sides >= 176 px, the pictures are 31 x 30")
    value, reason = vmaf(video, video)
    assert value is None and "32 px" in reason


@pytest.mark.parametrize("measure", [psnr, ssim, ms_ssim, vmaf, motion_psnr])
def test_clips_of_different_shape_are_refused(measure, unchecked):
    video = swinging(frames=4)
    with pytest.raises(ValueError, match="cannot compare"):
        measure(video[:3], video)
    with pytest.raises(ValueError, match="uint8"):
        measure(video.float(), video)


def test_a_frozen_picture_has_flow_error_one_and_loses_to_the_right_motion():
    reference = swinging()
    u_ref = flow(reference)
    where = moving(u_ref)
    frozen, close, opposite = still(reference), swinging(frequency=1.55), swinging(amplitude=-6.0)
    errors = [flow_error(flow(v), u_ref, where) for v in (reference, close, frozen, opposite)]
    assert errors[0] == 0 and errors[2] == pytest.approx(1, abs=1e-6)
    assert errors[1] < 0.5 and errors[3] == pytest.approx(2, abs=0.2)  # estimated flow: the two swings differ slightly
    assert motion_psnr(close, reference)[0] > motion_psnr(frozen, reference)[0]
    assert psnr(opposite, reference) < psnr(frozen, reference)  # why a still needs to be shown as baseline


def test_the_motion_of_a_thing_is_measured_at_its_own_pixels():
    """Beside it a patch without texture trembles, in each clip otherwise: it is counted as motion, but not as its."""
    reference, told = swinging(h=96, w=224), swinging(damping=1.3, h=96, w=224)
    for seed, clip in enumerate((reference, told)):
        noise = torch.randint(-3, 4, (len(clip), 96, 40, 1), generator=torch.Generator().manual_seed(seed))
        clip[:, :, -40:] = (clip[:, :, -40:] + noise).clamp(0, 255).to(torch.uint8)
    thing = np.zeros((96, 224), bool)
    thing[28:68, 92:132] = True  # the middle of the blob
    measured = Reference(reference, FPS, thing=thing)
    cells, came = measured.motion(told)[0], measured.itself()[0]
    alone = Reference(swinging(h=96, w=224), FPS, thing=thing).motion(swinging(damping=1.3, h=96, w=224))[0]
    assert cells["thing_flow_error"][0] == pytest.approx(alone["thing_flow_error"][0], abs=0.01)
    assert cells["thing_flow_error"][0] < 0.5 * cells["flow_error"][0]
    assert came["thing_damping"][0] == pytest.approx(1.0, rel=0.05)
    assert cells["thing_damping"][0] == pytest.approx(1.3, rel=0.05)


def test_frequency_and_damping_of_a_swing_are_recovered_from_pixels():
    reference, other = swinging(frequency=1.5, damping=1.0), swinging(frequency=2.0, damping=2.0)
    u_ref = flow(reference)
    where = moving(u_ref)
    for video, f, d in ((reference, 1.5, 1.0), (other, 2.0, 2.0)):
        found, reason = oscillation(signal(flow(video), dominant(u_ref, where), where), FPS)
        assert reason == ""
        assert found.frequency == pytest.approx(f, rel=0.02)  # sub-pixel errors of the estimated flow
        assert found.damping == pytest.approx(d, rel=0.15)


def test_oscillation_is_exact_on_an_exact_signal():
    t = np.arange(40) / FPS
    found, _ = oscillation(0.3 + 2 * np.exp(-1.7 * t) * np.cos(2 * np.pi * 2.3 * t + 0.4), FPS)
    assert found.frequency == pytest.approx(2.3, rel=1e-3) and found.damping == pytest.approx(
        1.7, rel=1e-2
    )  # Nelder-Mead
    assert found.explained > 0.9999


@pytest.mark.parametrize(
    "s, reason",
    [
        (np.zeros(40), "does not move"),
        (np.linspace(0, 1, 40), "periods|explains"),
        (np.random.default_rng(0).normal(size=40), "explains only"),
    ],
)
def test_no_oscillation_is_none_with_a_reason(s, reason):
    import re

    found, why = oscillation(s, FPS)
    assert found is None and re.search(reason, why)


def test_a_reference_that_stands_still_has_no_motion_measures():
    video = still(swinging(frames=8))
    assert moving(flow(video)) is None
    value, reason = motion_psnr(video, video)
    assert value is None and "does not move" in reason


def test_scores_survive_the_disk_and_show_missing_numbers_as_missing(tmp_path):
    scores = Scores(
        values={"learned": {"psnr": math.inf, "vmaf": None}, "frozen": {"psnr": 20.0, "vmaf": 0.5}},
        parameters={"learned: youngs_modulus": {"value": 1e5, "truth": None}},
        notes={"vmaf": "too small"},
    )
    scores.save(tmp_path)
    assert Scores.load(tmp_path) == scores
    assert "| learned | inf | – |" in scores.markdown() and "too small" in scores.markdown()
    assert [table.row_count for table in scores.tables()] == [2, 1]


def test_scores_refuse_nan_and_emptiness():
    with pytest.raises(ValueError, match="NaN"):
        Scores(values={"learned": {"psnr": math.nan}}).check()
    with pytest.raises(ValueError, match="empty"):
        Scores(values={}).check()
