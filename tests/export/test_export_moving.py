"""Each frame, as a model of its own, is the picture that our renderer draws of the moved body."""

import itertools

import pytest
import torch
from moving_bodies import FRAMES, MOVING, deformation, moving

from physics3d.export.moving import Moving
from physics3d.export.turn import rotate_sh, turned
from physics3d.export.turntable import Turntable
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.deform import render_deformed
from physics3d.gaussians.embedding import Embedding
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import sh_color

HARMONICS = [1, 4, 9, 16]


def camera(place=(0.5, -0.9, 0.4), target=(0.1, 0.0, 0.0)) -> Camera:
    pose = look_at(torch.tensor(place), torch.tensor(target))
    return Camera(width=64, height=48, fx=80.0, fy=80.0, cx=32.0, cy=24.0, world_to_camera=pose)


def rotations(n: int, seed: int = 0) -> torch.Tensor:
    normal = torch.randn(n, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    Q, _ = torch.linalg.qr(normal)
    return Q * torch.det(Q).sign()[:, None, None]


@pytest.mark.parametrize("k", HARMONICS)
def test_turned_harmonics_show_the_colour_of_the_direction_turned_back(k):
    g = torch.Generator().manual_seed(k)
    sh = torch.randn(20, k, 3, generator=g, dtype=torch.float64) + 1
    d = torch.nn.functional.normalize(torch.randn(20, 3, generator=g, dtype=torch.float64), dim=1)
    R = rotations(20)
    back = torch.einsum("nji,nj->ni", R, d)
    # the harmonics of a degree are closed under rotation: nothing but rounding of float64
    torch.testing.assert_close(sh_color(rotate_sh(sh, R), d), sh_color(sh, back), rtol=0, atol=1e-12)


@pytest.mark.parametrize("k", HARMONICS)
@pytest.mark.parametrize("opening", [False, True])
def test_a_frame_is_the_picture_of_the_moved_body(k, opening):
    made, _ = moving(k, opening)
    t = made.trajectory
    for i, frame in enumerate(made.frames()):
        frame.check()
        assert len(frame) == made.count
        drawn = render(frame, camera(), background=(1.0, 0.5, 0.2)).color
        ours = render_deformed(
            made.gaussians, made.embedding, t.rest_position, t.position[i], t.deformation[i], camera(),
            background=(1.0, 0.5, 0.2), interior=made.interior,
        ).color  # fmt: skip
        assert (drawn - 0.5).abs().max() > 0.1  # there is something to see
        # float32 positions and logarithms; two Gaussians at equal depth may change places: less than a level of 256
        torch.testing.assert_close(drawn, ours, rtol=0, atol=2e-3)


def test_an_affine_motion_gives_the_covariance_of_the_formula():
    made, _ = moving(4)
    for i, frame in enumerate(made.frames()):
        F = deformation(i)
        expected = F @ made.gaussians.covariance()[:MOVING] @ F.T
        torch.testing.assert_close(frame.covariance()[:MOVING], expected, rtol=2e-3, atol=1e-7)


def test_axes_turn_with_the_body_from_frame_to_frame():
    """A rigid turn of what moves turns every quaternion by as much, however its axes were sorted by size.

    Up to 45 degrees a frame: beyond, naming the axes anew turns less."""
    made, _ = moving(1)
    F = made.trajectory.deformation.clone()
    for i in range(FRAMES):
        turn = torch.linalg.matrix_exp(0.5 * i * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]))
        F[i] = turn
    rigid = Moving(
        gaussians=made.gaussians,
        embedding=made.embedding,
        trajectory=type(made.trajectory)(**{**vars(made.trajectory), "deformation": F}),
    )
    frames = [torch.nn.functional.normalize(f.quaternion[:MOVING], dim=1) for f in rigid.frames()]
    for a, b in itertools.pairwise(frames):
        cosine = (a * b).sum(1)
        # cos of half the angle; axes of nearly equal length are named by rounding
        torch.testing.assert_close(cosine, torch.full_like(cosine, 0.5).div(2).cos(), rtol=0, atol=1e-3)


def test_what_never_moves_stays_bit_by_bit():
    made, _ = moving(9)
    for frame in made.frames():
        for name in ("mean", "log_scale", "quaternion", "opacity_logit", "sh"):
            assert torch.equal(getattr(frame, name)[MOVING:], getattr(made.gaussians, name)[MOVING:]), name


@pytest.mark.parametrize("k", HARMONICS)
def test_a_turned_model_seen_by_a_turned_camera_is_the_same_picture(k):
    made, _ = moving(k)
    R = rotations(1, seed=3)[0]
    first = camera()
    pose = first.world_to_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ R.T
    second = Camera(**{**vars(first), "world_to_camera": pose})
    pictures = [
        render(g, c, background=(0.0, 0.0, 0.0)).color
        for g, c in ((made.gaussians, first), (turned(made.gaussians, R), second))
    ]
    # float32; two Gaussians at equal depth may change places
    torch.testing.assert_close(*pictures, rtol=0, atol=2e-3)


def test_nothing_that_moves_is_an_error():
    made, _ = moving(1)
    none = Embedding(
        which=torch.zeros(0, dtype=torch.long),
        neighbours=torch.zeros(0, 8, dtype=torch.long),
        weights=torch.zeros(0, 8, dtype=torch.float64),
    )
    with pytest.raises(ValueError, match="no Gaussian moves"):
        Moving(gaussians=made.gaussians, embedding=none, trajectory=made.trajectory)
    with pytest.raises(ValueError, match=f"no frame {FRAMES}; take one of 0 to {FRAMES - 1}"):
        made.frame(FRAMES)


def test_a_turntable_keeps_the_motion_in_the_picture_and_comes_round():
    made, _ = moving(1)
    table = Turntable(width=80, height=60, frames=8)
    points = made.trajectory.position.flatten(0, 1)
    cameras = table.cameras(points)
    for c in cameras:
        uv, depth = c.project(points.double())
        assert (depth > 0).all() and (uv > 0).all() and (uv < torch.tensor([80.0, 60.0])).all()
    places = torch.stack([c.centre for c in cameras]) - points.double().amin(0).lerp(points.double().amax(0), 0.5)
    azimuth = torch.atan2(places[:, 1], places[:, 0])
    steps = (azimuth.roll(-1) - azimuth) % (2 * torch.pi)
    torch.testing.assert_close(steps, torch.full_like(steps, 2 * torch.pi / 8))
    pictures = list(table(made.gaussians, made.embedding, made.trajectory, interior=None, background=(1.0, 1.0, 1.0)))
    assert len(pictures) == 8 and pictures[0].shape == (60, 80, 3) and pictures[0].float().std() > 5
