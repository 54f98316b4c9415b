"""Reconstruction learns what can be told exactly: pictures of known Gaussians, with and without mattes and points."""

import json
import math
from dataclasses import replace

import pytest
import torch

from physics3d.gaussians.adam import Rates
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.densification.adaptive import Adaptive
from physics3d.gaussians.densification.relocation import Relocation
from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.gaussians.ply import read_ply
from physics3d.gaussians.render import render
from physics3d.log import Log
from physics3d.pictures import to_uint8
from physics3d.scenes.base import Capture
from stages.reconstruct import Reconstruct

QUICK = Reconstruct(
    iterations=150, max_gaussians=400, sh_degree=0, longest_side=48, densification=Adaptive(every=25), check_every=50
)
WAYS = {"adaptive": Adaptive(every=25), "relocation": Relocation(every=25)}


def make_capture(*, matte: bool, points: bool) -> Capture:
    """Eighty coloured Gaussians in a ball of half a metre, seen by sixteen cameras all around; two held out."""
    g = torch.Generator().manual_seed(0)
    mean = torch.nn.functional.normalize(torch.randn(80, 3, generator=g), dim=-1) * 0.4
    truth = Gaussians(
        mean=mean,
        log_scale=torch.full((80, 3), math.log(0.09)),
        quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(80, 1),
        opacity_logit=torch.full((80,), 3.0),
        sh=torch.randn(80, 1, 3, generator=g),
    )
    images, alphas, cameras = [], [], []
    for i in range(16):
        at = 2 * torch.tensor([math.cos(2.4 * i), math.sin(2.4 * i), 0.8 * math.sin(1.3 * i)], dtype=torch.float64)
        M = look_at(at, torch.zeros(3))
        camera = Camera(width=64, height=48, fx=70, fy=70, cx=32, cy=24, world_to_camera=M)
        out = render(truth, camera, background=torch.ones(3))
        images.append(to_uint8(out.color))
        alphas.append(to_uint8(out.alpha))
        cameras.append(camera)
    return Capture(
        name="ball",
        images=tuple(images),
        cameras=tuple(cameras),
        names=tuple(f"{i}" for i in range(16)),
        held_out=(3, 10),
        alphas=tuple(alphas) if matte else (),
        points=mean if points else None,
    )


def curve(folder, name: str) -> list[float]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line["value"] for line in lines if line["name"] == name and line["step"] is not None]


# every two of the three choices meet in each of their ways
@pytest.mark.parametrize(
    ("way", "points", "matte"),
    [
        ("adaptive", True, True),
        ("adaptive", False, False),
        ("relocation", True, False),
        ("relocation", False, True),
    ],
)
def test_fitting_brings_photographs_never_seen_near(tmp_path, way, points, matte):
    """An empty picture scores about 13 dB here; 150 iterations must bring more than 10 dB on held-out photographs."""
    capture = make_capture(matte=matte, points=points)
    white = torch.stack([capture.images[i].float() / 255 for i in capture.held_out])
    empty = -10 * math.log10(float((1 - white).square().mean()))
    gaussians = replace(QUICK, densification=WAYS[way])(capture, log=Log(tmp_path, quiet=True))
    reached = curve(tmp_path, "psnr_held_out")
    assert reached[-1] > empty + 10, (empty, reached)
    assert len(gaussians) <= 400
    stored = read_ply(tmp_path / "gaussians.ply")
    assert all(torch.equal(getattr(stored, name), getattr(gaussians, name)) for name in FIELDS)
    assert list((tmp_path / "previews").glob("*.png"))


def test_with_a_matte_empty_space_is_transparent():
    capture = make_capture(matte=True, points=False)
    gaussians = QUICK(capture, log=Log(None))
    alpha = render(gaussians, capture.cameras[3], background=torch.zeros(3)).alpha
    empty = capture.alphas[3] == 0
    assert alpha[empty].mean() < 0.05 and alpha[capture.alphas[3] > 250].mean() > 0.9


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_same_seed_gives_the_same_gaussians_and_another_seed_others(way):
    capture = make_capture(matte=True, points=False)
    short = replace(QUICK, iterations=40, densification=type(way)(every=10))
    a, b, c = (replace(short, seed=seed)(capture, log=Log(None)) for seed in (1, 1, 2))
    assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in FIELDS)  # bit for bit
    assert len(a) != len(c) or not torch.equal(a.mean, c.mean)


def test_photographs_of_unequal_exposure_are_fitted_better_with_their_exposures(tmp_path):
    """Every other photograph is 30 % darker: one model for all is 15 % off everywhere, which caps it near 20 dB."""
    capture = make_capture(matte=True, points=True)
    images = []
    for k, (image, alpha) in enumerate(zip(capture.images, capture.alphas)):
        beside = (255 - alpha.float())[..., None]  # of the white background
        images.append((beside + (0.7 if k % 2 else 1.0) * (image.float() - beside)).clamp(0, 255).to(torch.uint8))
    capture = replace(capture, images=tuple(images))
    reached = []
    for on in (False, True):
        replace(QUICK, exposure=on, rates=Rates(exposure=0.05))(capture, log=Log(tmp_path / str(on), quiet=True))
        reached.append(curve(tmp_path / str(on), "psnr_train")[-1])
    assert reached[1] > reached[0] + 1.5, reached


def test_it_stops_when_it_no_longer_improves(tmp_path):
    """Step sizes of zero improve nothing: it stops at the first check after the part in which Gaussians are added."""
    still = Rates(mean=0, log_scale=0, quaternion=0, opacity_logit=0, sh=0)
    capture = make_capture(matte=True, points=True)
    lazy = replace(QUICK, iterations=200, check_every=20, patience=2, rates=still, densification=Adaptive(every=1000))
    lazy(capture, log=Log(tmp_path, quiet=True))
    steps = len(curve(tmp_path, "psnr_held_out"))
    assert steps == 8  # that part ends after 140 of 200 iterations, the next check is at 160


def test_photographs_held_out_decide_nothing():
    """Other pictures in their place: the same Gaussians bit for bit, and the same early end."""
    capture = make_capture(matte=False, points=True)
    spoiled = tuple(255 - image if i in capture.held_out else image for i, image in enumerate(capture.images))
    lazy = replace(QUICK, iterations=60, check_every=5, patience=1, rates=Rates(mean=1e-5, log_scale=1e-4, sh=1e-4))
    a, b = (lazy(c, log=Log(None)) for c in (capture, replace(capture, images=spoiled)))
    assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


@pytest.mark.parametrize(
    "field, value",
    [
        ("iterations", 0),
        ("max_gaussians", 0),
        ("sh_degree", 4),
        ("ssim_weight", 1.5),
        ("longest_side", 3),
        ("floaters", 0.0),
    ],
)
def test_settings_out_of_range_are_named(field, value):
    with pytest.raises(ValueError, match=f"reconstruct.{field} is {value}"):
        Reconstruct(**{field: value})(make_capture(matte=False, points=True), log=Log(None))


def test_cameras_that_look_away_from_each_other_are_refused():
    capture = make_capture(matte=False, points=False)
    outward = []
    for camera in capture.cameras:
        M = look_at(camera.centre, 2 * camera.centre)
        outward.append(Camera(**{**vars(camera), "world_to_camera": M}))
    capture = Capture(**{**vars(capture), "cameras": tuple(outward)})
    with pytest.raises(ValueError, match="no common space"):
        QUICK(capture, log=Log(None))
