"""Where the Gaussians of a fit start, that adding some keeps the picture, and what floats."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.densification.adaptive import Adaptive
from physics3d.gaussians.densification.relocation import Relocation, shared
from physics3d.gaussians.exposure import Exposure
from physics3d.gaussians.fit import drawn_error
from physics3d.gaussians.floaters import floaters
from physics3d.gaussians.loss import psnr
from physics3d.gaussians.photograph import Photograph
from physics3d.gaussians.render import render
from physics3d.gaussians.start import background_points, from_points, random_points


def ring(radius=0.3, count=8) -> list[Photograph]:
    """Photographs of a red ball at the origin, with the matte of its outline, from 2 m."""
    photographs = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        at = torch.tensor([2 * math.cos(angle), 2 * math.sin(angle), 0.5], dtype=torch.float64)
        M = look_at(at, torch.zeros(3))
        camera = Camera(width=64, height=48, fx=70, fy=70, cx=32, cy=24, world_to_camera=M)
        origin, direction = camera.rays(torch.float64)
        unit = torch.nn.functional.normalize(direction, dim=-1)
        matte = (torch.linalg.cross(-origin.expand_as(unit), unit).norm(dim=-1) < radius).float()
        photographs.append(Photograph(camera=camera, color=matte[..., None] * torch.tensor([1.0, 0, 0]), alpha=matte))
    return photographs


def test_random_points_lie_in_every_matte_and_take_its_colour():
    points, colors = random_points(ring(), 500, torch.Generator().manual_seed(0))
    assert points.shape == (500, 3)
    # the hull of eight outlines is wider than the ball by 1/cos(pi/8); half a pixel is 1.5 cm
    assert points[:, :2].norm(dim=-1).max() < 0.3 / math.cos(math.pi / 8) + 0.03
    assert (colors[:, 0] > 0.9).all() and (colors[:, 1:] == 0).all()


def test_background_points_lie_on_rays_beyond_the_median_of_what_is_known():
    photographs = ring(count=1)
    known = torch.randn(200, 3, generator=torch.Generator().manual_seed(1)) * 0.2
    points, colors = background_points(photographs, known, 50, torch.Generator().manual_seed(2))
    camera = photographs[0].camera
    uv, depth = camera.project(points.double())
    _, z = camera.project(known.double())
    assert (depth > z.median() - 1e-5).all() and (depth < z.max() + 1e-5).all()
    column, row = uv[:, 0].long(), uv[:, 1].long()
    assert torch.equal(photographs[0].color[row, column], colors)


def test_random_points_reach_their_number_for_a_small_thing_seen_from_far():
    points, _ = random_points(ring(radius=0.05), 3000, torch.Generator().manual_seed(0))
    assert len(points) == 3000
    # inside the hull of the outlines, half a pixel wider
    assert points[:, :2].norm(dim=-1).max() < 0.05 / math.cos(math.pi / 8) + 0.03


# faded ones of Adaptive are removed, of Relocation moved; half of the halves' pictures may differ where one is split in
# two of other shape (they cover 2 x 0.6 x 0.85 to 2 x 0.85^2 times the parent's area), copies in place draw the same
@pytest.mark.parametrize("way, change", [(Adaptive(), 0.25), (Relocation(), 0.1)], ids=["adaptive", "relocation"])
def test_adding_gaussians_keeps_the_picture_and_reaches_the_wanted_count(way, change):
    photographs, black = ring(), torch.zeros(3)
    start = from_points(*random_points(photographs, 120, torch.Generator().manual_seed(0)), sh_degree=0)
    faint = torch.arange(120) < 20
    start = replace(start, opacity_logit=torch.where(faint, -9.0, start.opacity_logit))
    moments = {"mean": (torch.ones_like(start.mean), torch.ones_like(start.mean))}
    error = partial(drawn_error, start, photographs, black)
    grown = way.renewed(start, moments, error, 150, torch.Generator().manual_seed(0))
    assert len(grown) == len(moments["mean"][0]) == 150
    assert (grown.opacity > way.faded).all()  # the faded ones are gone
    assert (moments["mean"][0] == 0).all(1).any() and (moments["mean"][0] == 1).all(1).any()  # new ones start at rest
    before, after = (render(g, photographs[0].camera, background=black).color for g in (start, grown))
    assert (after - before).abs().mean() < change * before.mean()


@pytest.mark.parametrize("way", [Adaptive(), Relocation()], ids=["adaptive", "relocation"])
def test_no_more_than_wanted_and_an_error_when_all_have_faded(way):
    start = from_points(*random_points(ring(), 50, torch.Generator().manual_seed(0)), sh_degree=0)
    error = lambda: torch.ones(len(start))
    same = way.renewed(start, {}, error, 50, torch.Generator().manual_seed(0))
    assert len(same) == 50 and torch.equal(same.mean, start.mean)
    faded = replace(start, opacity_logit=torch.full((50,), -9.0))
    with pytest.raises(ValueError, match="every Gaussian faded away"):
        way.renewed(faded, {}, error, 60, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.99])
@pytest.mark.parametrize("copies", [1, 2, 5, 20])
def test_copies_in_place_draw_what_one_drew(opacity, copies):
    """The integral over a line through the centre of 1 - (1 - o' g')^N is that of o g; trapezoid and float32: 1e-6."""
    each, factor = shared(torch.tensor([opacity]), torch.tensor([copies]))
    x = torch.linspace(-12, 12, 20_001, dtype=torch.float64)
    many = 1 - (1 - each.double() * torch.exp(-0.5 * (x / factor.double()) ** 2)) ** copies
    one = opacity * torch.exp(-0.5 * x**2)
    assert float(torch.trapezoid(many, x) / torch.trapezoid(one, x)) == pytest.approx(1, abs=1e-6)


def test_only_faint_gaussians_take_random_steps_and_within_their_own_shape():
    start = from_points(*random_points(ring(), 200, torch.Generator().manual_seed(0)), sh_degree=0)
    flat = torch.tensor([0.0, 0.0, -20.0])
    faint = torch.arange(200) < 100
    start = replace(start, log_scale=start.log_scale + flat, opacity_logit=torch.where(faint, -9.0, 3.0))
    moved = Relocation().stirred(start, 1e-3, torch.Generator().manual_seed(0)).mean - start.mean
    assert (moved[faint, :2].norm(dim=-1) > 0).all() and (moved[~faint] == 0).all()
    assert moved[:, 2].abs().max() < 1e-6 * moved.abs().max()  # e^-40 of the variance along z


def test_exposure_of_photographs_is_told_apart_from_their_content():
    """Four photographs of one picture, each with its own gain and offset, and one colour per photograph's channel: the
    exposures are found up to the mean, which the picture keeps. Adam's steps of 1 % end within 1 %."""
    photograph = ring(count=1)[0]
    picture = 0.5 * photograph.color + 0.2 * photograph.alpha[..., None]
    black, gain = torch.zeros(3), torch.tensor([0.1, -0.2, 0.3, -0.2])
    offset = torch.tensor([0.05, 0.0, -0.05, 0.0])
    drawn = replace(render_of(photograph), color=picture, alpha=photograph.alpha)
    exposure = Exposure(4, picture.device)
    for step in range(400):
        i = step % 4
        values = exposure.of(i)
        truth = torch.exp(gain[i]) * picture + offset[i] * photograph.alpha[..., None]
        (Exposure.applied(drawn, values, black) - truth).square().mean().backward()
        exposure.step(i, values.grad, 0.01 * 0.05 ** (step / 400))
    assert exposure.values.mean(1).abs().max() < 1e-6
    for i in range(4):
        truth = torch.exp(gain[i]) * picture + offset[i] * photograph.alpha[..., None]
        assert psnr(Exposure.applied(drawn, exposure.of(i), black).detach(), truth) > 35


def test_exposure_leaves_the_background_alone():
    photograph = ring(count=1)[0]
    behind = torch.tensor([0.2, 0.5, 0.9])
    drawn = replace(render_of(photograph), color=photograph.on(behind), alpha=photograph.alpha)
    seen = Exposure.applied(drawn, torch.tensor([[0.5] * 3, [0.1] * 3]), behind)
    torch.testing.assert_close(seen[photograph.alpha == 0], photograph.on(behind)[photograph.alpha == 0])


def render_of(photograph):
    start = from_points(torch.zeros(1, 3), torch.ones(1, 3), sh_degree=0)
    return render(start, photograph.camera, background=torch.zeros(3))


def test_what_hangs_alone_in_the_air_and_is_hardly_drawn_floats():
    """400 on a ball, one faint a metre off, one opaque and drawn a metre off, one too faint to be drawn at all."""
    g = torch.Generator().manual_seed(0)
    on = torch.nn.functional.normalize(torch.randn(400, 3, generator=g), dim=-1) * 0.3
    ball = from_points(torch.cat([on, torch.eye(3) * 0.9]), torch.ones(403, 3), sh_degree=0)
    logit = torch.full((403,), 3.0)
    logit[400], logit[402] = -4.0, -9.0
    scale = ball.log_scale.clone()
    scale[400:] = math.log(0.05)
    ball = replace(ball, opacity_logit=logit, log_scale=scale)
    alone = floaters(ball, [p.camera for p in ring()], deviations=3.0)
    assert torch.nonzero(alone)[:, 0].tolist() == [400, 402]
    with pytest.raises(ValueError, match="deviations is 0"):
        floaters(ball, [], deviations=0)
