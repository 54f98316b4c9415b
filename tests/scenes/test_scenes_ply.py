"""A trained model, turned to z up and to metres, looks the same from the same places."""

import numpy as np
import pytest
import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.gaussians.ply import write_ply
from physics3d.gaussians.render import render
from physics3d.log import Log
from physics3d.scenes.axes import Axes
from physics3d.scenes.ply import PlyScene, oriented


def blob(degree: int) -> Gaussians:
    generator = torch.Generator().manual_seed(degree)
    n = 40

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        mean=normal(n, 3),
        log_scale=-1.5 + 0.4 * normal(n, 3),
        quaternion=normal(n, 4),
        opacity_logit=normal(n) + 2,
        sh=0.3 * normal(n, (degree + 1) ** 2, 3),
    )


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.3, 1.0, -0.2), (0, 0, -1)])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_turning_and_scaling_a_model_and_its_camera_changes_no_pixel(degree, up):
    axes = Axes(up=up, scale=0.2)
    source = blob(degree)
    view = look_at(torch.tensor([4.0, -3.0, 2.0]), torch.zeros(3))
    camera = Camera(width=40, height=30, fx=40, fy=40, cx=20, cy=15, world_to_camera=view)
    turned = Camera(width=40, height=30, fx=40, fy=40, cx=20, cy=15, world_to_camera=axes.world_to_camera(view))
    before = render(source, camera, background=(0.2, 0.3, 0.4))
    after = render(oriented(source, axes), turned, background=(0.2, 0.3, 0.4))
    # float32 rotations and harmonics
    torch.testing.assert_close(after.color, before.color, atol=2e-4, rtol=0)
    assert float(before.color.std()) > 0.05


def test_a_ply_becomes_a_capture_with_gaussians_and_views(tmp_path):
    write_ply(tmp_path / "model.ply", blob(1))
    source = PlyScene(
        name="blob", path=str(tmp_path / "model.ply"), up=(0, -1, 0), scale=0.1, views=3, width=32, height=24
    )
    capture = source(log=Log(None))
    assert capture.gaussians is not None and len(capture.images) == 3 and source.files() == (source.path,)
    assert all(float(image.float().std()) > 5 for image in capture.images)
    # most of the model is in every view
    for camera in capture.cameras:
        uv, depth = camera.project(capture.gaussians.mean.double())
        inside = (depth > 0) & (uv > 0).all(1) & (uv[:, 0] < 32) & (uv[:, 1] < 24)
        assert inside.float().mean() > 0.7


def test_a_single_gaussian_is_seen_from_all_around(tmp_path):
    one = Gaussians(**{name: getattr(blob(0), name)[:1] for name in FIELDS})
    write_ply(tmp_path / "one.ply", one)
    source = PlyScene(name="one", path=str(tmp_path / "one.ply"), up=(0, 0, 1), scale=1.0, views=3, width=32, height=24)
    capture = source(log=Log(None))
    assert all(float(image.float().std()) > 5 for image in capture.images)


def test_a_missing_or_broken_ply_is_named(tmp_path):
    source = PlyScene(name="blob", path=str(tmp_path / "model.ply"), up=(0, 0, 1), scale=1.0)
    with pytest.raises(ValueError, match=r"model\.ply"):
        source(log=Log(None))
    write_ply(tmp_path / "model.ply", blob(0))
    data = bytearray((tmp_path / "model.ply").read_bytes())
    data[-4:] = np.float32("nan").tobytes()
    (tmp_path / "model.ply").write_bytes(bytes(data))
    with pytest.raises(ValueError, match=r"model\.ply"):
        source(log=Log(None))
