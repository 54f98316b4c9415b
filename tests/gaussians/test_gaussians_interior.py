"""The inside of a body shows where the body opens, and nowhere else."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import cameras_around, discs, sphere

from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.interior import Interior, paint
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.log import Log

SPACING, WHITE = 0.008, (1.0, 1.0, 1.0)
CAMERAS = cameras_around(4, 0.3)
R = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.8, 0.3], [0.8, 0.0, -0.5], [-0.3, 0.5, 0.0]]))


@pytest.fixture(scope="module")
def ball() -> tuple[Gaussians, torch.Tensor, Interior]:
    """A ball, red below and yellow above, with a lattice of particles in it; 1 cm below its surface they are inside."""
    rng = np.random.default_rng(0)
    gaussians = discs(*sphere(5000, 0.05, rng), rng, sigma=0.0022)
    above = (gaussians.mean[:, 2:] > 0).float()
    sh = (above * torch.tensor([0.4, 0.3, -0.3]) + (1 - above) * torch.tensor([0.4, -0.3, -0.3])) / 0.28209479
    line = torch.arange(-6, 7) * SPACING
    X = torch.cartesian_prod(line, line, line)
    X = X[X.norm(dim=1) < 0.05]
    gaussians = replace(gaussians, sh=sh[:, None])
    return gaussians, X, Interior.of(gaussians, X, X.norm(dim=1) < 0.04, SPACING)


def picture(ball, x, F=None, *, interior: bool, camera=CAMERAS[0]):
    gaussians, X, inside = ball
    tied = embed(gaussians.mean, torch.arange(len(gaussians)), X, SPACING)
    F = (torch.eye(3) if F is None else F).expand(len(X), 3, 3)
    with torch.no_grad():
        more = {"interior": inside if interior else None}
        return render_deformed(gaussians, tied, X, x, F, camera, background=WHITE, **more).color


MOTIONS = {
    "rest": torch.eye(3),
    "turned": R,
    "squeezed": torch.diag(torch.tensor([0.5, 1.1, 1.1])),
    "stretched": torch.diag(torch.tensor([1.25, 0.9, 0.9])),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_body_that_has_not_opened_is_drawn_as_without_its_inside(ball, motion):
    A = MOTIONS[motion]
    x = ball[1] @ A.T
    assert torch.equal(picture(ball, x, A, interior=True), picture(ball, x, A, interior=False))


def test_a_cut_shows_the_inside_at_its_two_faces_only(ball):
    _, X, inside = ball
    x = X + torch.where(X[:, :1] > 1e-6, 0.2, 0.0) * torch.tensor([1.0, 0, 0])
    opened = inside.opened(X, x)
    depth = X[inside.particle, 0]
    # two layers on either side: neighbours are looked for within two spacings
    faces = (depth > -1.5 * SPACING) & (depth < 2.5 * SPACING)
    assert torch.equal(opened == 1, faces) and torch.equal(opened > 0, faces)
    # in the middle of the face that looks to the right, seen from there past the other half, it is no longer hollow
    seen = picture(ball, x, interior=True) - picture(ball, x, interior=False)
    assert seen.abs().max() > 0.2


def test_the_inside_has_the_colours_of_the_surface_near_it(ball):
    _, X, inside = ball
    height, green = X[inside.particle, 2], inside.gaussians.sh[:, 0, 1] * 0.28209479
    torch.testing.assert_close(green[height > 0.02], torch.full_like(green[height > 0.02], 0.3), rtol=0, atol=1e-3)
    torch.testing.assert_close(green[height < -0.02], torch.full_like(green[height < -0.02], -0.3), rtol=0, atol=1e-3)


def leak(ball, inside: Interior) -> float:
    """Mean change of the pictures at rest, of 255, if all of the inside were drawn."""
    gaussians, _, _ = ball
    both = Gaussians(**{n: torch.cat([getattr(gaussians, n), getattr(inside.gaussians, n)]) for n in vars(gaussians)})
    with torch.no_grad():
        change = [
            render(both, c, background=WHITE).color - render(gaussians, c, background=WHITE).color for c in CAMERAS
        ]
    return 255 * float(torch.stack(change).abs().mean())


def test_painting_changes_only_the_colours_of_the_inside_and_hides_it_better(ball):
    gaussians, _, inside = ball
    before = {name: getattr(gaussians, name).clone() for name in vars(gaussians)}
    painted = paint(inside, gaussians, CAMERAS, background=WHITE, steps=12, log=Log(None))
    assert all(torch.equal(value, getattr(gaussians, name)) for name, value in before.items())
    for name in ("mean", "log_scale", "quaternion", "opacity_logit"):
        assert torch.equal(getattr(painted.gaussians, name), getattr(inside.gaussians, name))
    assert leak(ball, painted) < leak(ball, inside)
    # even if all of it were drawn, the opaque surface hides it: less than one grey level in the mean
    assert leak(ball, inside) < 1


def test_the_static_views_lose_less_than_a_tenth_of_a_decibel(ball):
    """Against photographs that the surface explains to 30 dB, even if all of the painted inside were drawn; as it is
    drawn, it is not at rest, and nothing is lost (above)."""
    gaussians, _, inside = ball
    painted = paint(inside, gaussians, CAMERAS, background=WHITE, steps=12, log=Log(None))
    both = Gaussians(**{n: torch.cat([getattr(gaussians, n), getattr(painted.gaussians, n)]) for n in vars(gaussians)})
    noise = torch.Generator().manual_seed(0)
    error = {"without": 0.0, "with": 0.0}
    for camera in CAMERAS:
        with torch.no_grad():
            outside, whole = (render(g, camera, background=WHITE).color for g in (gaussians, both))
        photograph = outside + 10 ** (-30 / 20) * torch.randn(outside.shape, generator=noise)
        error["without"] += float((outside - photograph).square().mean())
        error["with"] += float((whole - photograph).square().mean())
    assert 10 * math.log10(error["with"] / error["without"]) < 0.1


def test_a_body_without_inside_has_no_interior(ball):
    gaussians, X, _ = ball
    assert Interior.of(gaussians, X, torch.zeros(len(X), dtype=torch.bool), SPACING) is None
