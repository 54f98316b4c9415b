"""Where the Gaussians of a fit start, and that adding some keeps the picture."""

import math

import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.fit import Photograph, _renew, background_points, from_points, random_points
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render


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


def test_adding_gaussians_keeps_the_picture_and_reaches_the_wanted_count():
    photographs, black = ring(), torch.zeros(3)
    start = from_points(*random_points(photographs, 120, torch.Generator().manual_seed(0)), sh_degree=0)
    faint = torch.arange(120) < 20
    start = Gaussians(**{**vars(start), "opacity_logit": torch.where(faint, -9.0, start.opacity_logit)})
    moments = {"mean": (torch.ones_like(start.mean), torch.ones_like(start.mean))}
    grown = _renew(start, moments, photographs, black, 150)
    assert len(grown) == len(moments["mean"][0]) == 150
    assert (grown.opacity > 0.02).all()  # the faded ones are gone
    before, after = (render(g, photographs[0].camera, background=black).color for g in (start, grown))
    # 50 of 100 are split; their halves cover 2 x 0.6 x 0.85 to 2 x 0.85^2 times the parent's area; copies give 0.5
    assert (after - before).abs().mean() < 0.25 * before.mean()
