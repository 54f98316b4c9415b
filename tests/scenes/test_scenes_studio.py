"""The ray tracer and the carrier of vertices, against closed forms."""

import numpy as np
import pytest
import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.log import Log
from physics3d.scenes.ball import RADIUS, checkered_ball
from physics3d.scenes.flower import SOIL, plant, surroundings
from physics3d.scenes.studio import BOUNCE, Light, Mesh, Studio, photographs, ring, surface_grid, to_linear, to_srgb
from physics3d.scenes.synthetic import Carrier, particles


def square(height: float, half: float, albedo: float = 0.5, **kwargs) -> Mesh:
    """Level square at `height`, `half` its side."""
    x, y = np.meshgrid(np.linspace(-half, half, 3), np.linspace(-half, half, 3), indexing="ij")
    return surface_grid(np.stack([x, y, np.full_like(x, height)], -1), np.full(3, albedo), **kwargs)


def above(height: float = 1.0, size: int = 21) -> Camera:
    view = look_at(torch.tensor([0.0, 0.0, height]), torch.zeros(3), up=(0, 1, 0))
    return Camera(width=size, height=size, fx=size, fy=size, cx=size / 2, cy=size / 2, world_to_camera=view)


LIGHT = Light(to_sun=(0, 0, 1), sun=(0.6, 0.5, 0.4), sky=(0.5, 0.6, 0.7), ground=(0.2, 0.2, 0.2), backdrop=(0, 0, 0))


def test_a_lit_square_has_lambert_s_colour():
    image, matte, hits = Studio([square(0.0, 1.0)], LIGHT, openness_rays=4, seed=0).pose().photograph(above())
    # the sun's samples lean by 0.7 degrees: cosines are 1 within 1e-4, and 8 bits round
    expected = to_srgb(0.5 * (np.array(LIGHT.sun) + np.array(LIGHT.sky))) * 255
    assert np.abs(image.numpy() - expected).max() <= 1
    assert (matte == 255).all() and np.abs(hits[:, 2]).max() < 1e-6


def test_a_square_in_the_shade_gets_only_the_sky_that_it_sees():
    shade = square(0.0, 0.3), square(0.5, 3.0)
    view = look_at(torch.tensor([0.9, 0.0, 0.3]), torch.zeros(3))
    camera = Camera(width=9, height=9, fx=60, fy=60, cx=4.5, cy=4.5, world_to_camera=view)
    image = Studio(list(shade), LIGHT, openness_rays=4, seed=0).pose().photograph(camera)[0]
    # the roof is beyond the reach of ambient rays, so the square below is open: all of the sky, none of the sun
    assert np.abs(image[4, 4].numpy() - to_srgb(0.5 * np.array(LIGHT.sky)) * 255).max() <= 1
    assert 0 < BOUNCE <= 1


def test_light_comes_through_a_translucent_sheet():
    for translucency in (0.0, 0.4):
        sheet = square(0.0, 1.0, translucency=translucency)
        view = look_at(torch.tensor([0.0, 0.0, -1.0]), torch.zeros(3), up=(0, 1, 0))
        camera = Camera(width=5, height=5, fx=9, fy=9, cx=2.5, cy=2.5, world_to_camera=view)
        image = Studio([sheet], LIGHT, openness_rays=2, seed=0).pose().photograph(camera)[0]
        expected = 0.5 * (translucency * np.array(LIGHT.sun) + np.array(LIGHT.ground))
        assert np.abs(image[2, 2].numpy() - to_srgb(expected) * 255).max() <= 1


def test_the_matte_of_a_ball_is_its_silhouette():
    studio = Studio([checkered_ball((0.0, 0.0, 0.0))], LIGHT, openness_rays=1, seed=0)
    camera = above(height=0.3, size=101)
    matte = studio.pose().photograph(camera)[1].double() / 255
    # a sphere of radius R at distance d has the silhouette radius f R / sqrt(d^2 - R^2); facets cut off under 1 %
    radius = camera.fx * RADIUS / np.sqrt(0.3**2 - RADIUS**2)
    assert float(matte.sum()) == pytest.approx(np.pi * radius**2, rel=0.01)


def test_points_lie_on_what_is_photographed_and_reproject_to_their_colour():
    studio = Studio([checkered_ball((0.1, 0.0, 0.2))], LIGHT, openness_rays=1, seed=0)
    cameras = ring((0.1, 0, 0.2), distance=0.3, elevation=20, azimuths=[0, 90], width=64, height=48, opening=40)
    images, _, points, colors = photographs(studio.pose(), cameras, points=200, noise=0.0, seed=3, log=Log(None))
    distance = (points - torch.tensor([0.1, 0.0, 0.2])).norm(dim=1)
    assert float((distance - RADIUS).abs().max()) < 2e-4  # facets
    for k, camera in enumerate(cameras):
        own = slice(100 * k, 100 * (k + 1))
        uv, _ = camera.project(points[own].double())
        u, v = uv.floor().long().unbind(1)
        torch.testing.assert_close(images[k][v, u].float() / 255, colors[own])


def test_srgb_and_linear_are_inverse():
    x = np.linspace(0, 1, 256)
    np.testing.assert_allclose(to_srgb(to_linear(x)), x, atol=2e-6)  # float32


def test_affine_motion_carries_vertices_exactly():
    rng = np.random.default_rng(0)
    rest, position = rng.random((50, 3)), rng.random((200, 3))
    F, shift = np.eye(3) + 0.5 * rng.normal(size=(3, 3)), np.array([1.0, -2.0, 0.5])
    carried = Carrier(rest, rest, position, 0.1)(position @ F.T + shift, np.broadcast_to(F, (200, 3, 3)))
    np.testing.assert_allclose(carried, rest @ F.T + shift, atol=1e-6)  # float32 out


def test_an_anchored_piece_moves_as_one():
    rng = np.random.default_rng(0)
    rest, position = rng.random((50, 3)), rng.random((200, 3))
    anchors = np.broadcast_to(position[7], rest.shape)
    x, F = position + 0.1 * rng.normal(size=(200, 3)), np.eye(3) + 0.1 * rng.normal(size=(200, 3, 3))
    moved = Carrier(rest, anchors, position, 0.1)(x, F).astype(np.float64)
    affine, *_ = np.linalg.lstsq(np.c_[rest, np.ones(50)], moved, rcond=None)
    np.testing.assert_allclose(np.c_[rest, np.ones(50)] @ affine, moved, atol=1e-6)


def test_particles_hold_the_volume_of_the_body_and_stay_inside():
    position, volume = particles([checkered_ball((0.0, 0.0, 0.1))], 0.006, seed=0)
    # 2400 points: the jittered lattice is within 1 % of the volume, facets take 0.2 %
    assert volume.sum() == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    assert np.linalg.norm(position - [0, 0, 0.1], axis=1).max() <= RADIUS


def test_overlapping_solids_count_once():
    ball = checkered_ball((0.0, 0.0, 0.0))
    once, twice = particles([ball], 0.008, seed=1)[1].sum(), particles([ball, ball], 0.008, seed=1)[1].sum()
    assert once == twice


def test_the_flower_is_rooted_in_its_pot_and_has_metric_size():
    meshes, solids = plant(0)
    position, volume = particles(solids, 0.004, seed=0)
    assert position[:, 2].min() < SOIL - 0.02 and 0.23 < position[:, 2].max() < 0.27
    inside_pot = position[position[:, 2] < SOIL]
    assert np.linalg.norm(inside_pot[:, :2], axis=1).max() < 0.03
    petals = meshes[-1].vertices
    assert (
        0.07 < np.ptp(petals[:, 0]) < 0.10
        and not any(m.moves for m in surroundings(0))
        and all(m.moves for m in meshes)
    )
    assert 100e-6 < volume.sum() < 250e-6


@pytest.mark.parametrize("seed", [0, 1])
def test_the_flower_is_the_same_for_a_seed(seed):
    for a, b in zip(plant(seed)[0] + surroundings(seed), plant(seed)[0] + surroundings(seed)):
        assert (a.vertices == b.vertices).all() and (a.albedo == b.albedo).all()
    assert (plant(seed)[0][-1].vertices != plant(seed + 5)[0][-1].vertices).any()
