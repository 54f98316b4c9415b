"""A camera refined by a picture: what stands still finds it, whatever moves and whatever the exposure."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import physics3d.checkpoint
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.register import register
from physics3d.gaussians.render import render
from physics3d.gaussians.twin import rasterize_plainly
from physics3d.learning.unknown_cause import found_by
from physics3d.log import Log
from physics3d.scenes.base import Capture, Take

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    """300 blobs of 1 to 5 cm in a room of 1 m."""
    g = torch.Generator().manual_seed(0)
    n = 300
    return Gaussians(
        mean=(torch.rand(n, 3, generator=g) - 0.5) * torch.tensor([1.0, 0.6, 0.7]),
        log_scale=torch.rand(n, 3, generator=g) * 1.6 - 4.6,
        quaternion=torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1),
        opacity_logit=torch.full((n,), 2.0),
        sh=torch.randn(n, 1, 3, generator=g).clamp(-1.5, 1.5),  # colours within 0..1
    )


@pytest.fixture(scope="module")
def true() -> Camera:
    pose = look_at(torch.tensor([0.15, -1.2, 0.4]), torch.zeros(3))
    return Camera(width=120, height=90, fx=130, fy=130, cx=60, cy=45, world_to_camera=pose)


def off(found: Camera, true: Camera, scene: Gaussians) -> float:
    """Mean distance in the picture between where both see the Gaussians [px]."""
    a, b = (c.project(scene.mean.double())[0] for c in (found, true))
    return float((a - b).norm(dim=1).mean())


def wrong(true: Camera, seed: int) -> Camera:
    """Turned by 0.6 degrees about some axis through the camera, and 1 cm aside."""
    rng = np.random.default_rng(seed)
    turn, shift = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = torch.from_numpy(Rotation.from_rotvec(np.radians(0.6) * turn).as_matrix())
    M[:3, 3] = torch.from_numpy(0.01 * shift)
    return replace(true, world_to_camera=M @ true.world_to_camera)


@pytest.mark.parametrize("seed", range(3))
def test_the_camera_is_found_by_what_stands_still(seed, scene, true):
    """Drawn by the plain twin, darker and greener, rounded to bytes; a seventh of the picture shows something else.

    Bytes leave 0.0002 px, for there are ten thousand of them; a hundredth of a pixel is as much as anyone needs.
    """
    picture = render(scene, true, background=torch.ones(3), draw=rasterize_plainly).color
    picture = picture * torch.tensor([0.8, 0.9, 0.8]) + torch.tensor([0.02, 0.05, 0.03])
    still = torch.ones(true.height, true.width, dtype=torch.bool)
    still[20:60, 40:75] = False
    picture[~still] = torch.rand(int((~still).sum()), 3, generator=torch.Generator().manual_seed(seed))
    start = wrong(true, seed)
    assert off(start, true, scene) > 0.4
    found = register(scene, start, (picture * 255 + 0.5).to(torch.uint8), still, background=WHITE)
    print(f"{off(start, true, scene):.2f} px before, {off(found.camera, true, scene):.4f} px after", found.after)
    assert off(found.camera, true, scene) < 0.01
    found.camera.check()
    assert found.after < 0.2 * found.before
    middle = [c.project(torch.zeros(1, 3, dtype=torch.float64))[0] for c in (start, true)]
    # of a point near the middle of the scene, which is nearly what the middle of the picture shows
    assert found.moved == pytest.approx(float((middle[0] - middle[1]).norm()), abs=0.2)


@pytest.mark.parametrize("kind, message", [("moves", "stand still"), ("size", "scale the camera"), ("away", "nothing")])
def test_what_cannot_be_refined_is_named(kind, message, scene, true):
    picture = torch.zeros(true.height, true.width, 3, dtype=torch.uint8)
    still = torch.ones(true.height, true.width, dtype=torch.bool)
    if kind == "moves":
        still[:] = False
    if kind == "size":
        picture, still = picture[1:], still[1:]
    if kind == "away":
        true = replace(true, world_to_camera=look_at(torch.tensor([0.0, -1.2, 0.4]), torch.tensor([0.0, -3.0, 0.0])))
    with pytest.raises(ValueError, match=message):
        register(scene, true, picture, still, background=WHITE)


def test_a_learning_that_was_stopped_does_not_look_for_its_camera_again(tmp_path, monkeypatch, scene, true):
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    picture = (render(scene, true, background=torch.ones(3)).color.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    clip = picture.expand(3, -1, -1, -1)
    poke = Take(
        name="poke",
        role="learn",
        fps=30.0,
        cameras=(wrong(true, 0),),
        videos=(clip,),
        excitation=None,
        posed=0,
        at_rest=True,
    )
    capture = Capture(name="room", images=(), cameras=(), names=(), gaussians=scene, takes=(poke,), background=WHITE)
    found = found_by(capture, poke, scene, Log(tmp_path, quiet=True))
    assert off(found, true, scene) < 0.5 * off(poke.cameras[0], true, scene)
    elsewhere = replace(scene, mean=scene.mean + 100.0)  # by which no camera could be refined
    with pytest.raises(ValueError, match="nothing"):
        found_by(capture, poke, elsewhere, Log(None))
    again = found_by(capture, poke, elsewhere, Log(tmp_path, quiet=True))
    assert torch.equal(again.world_to_camera, found.world_to_camera)
