"""Real captures load, and their points lie where their cameras look."""

import pytest

from physics3d.log import Log
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.pac_nerf import PacNerfSource
from physics3d.scenes.transforms import TransformsSource

SOURCES = {
    "plush": lambda data: TransformsSource(
        name="plush", path=str(data / "plush"), up=(-0.21, -0.97, -0.16), scale=0.1, resolution=0.125
    ),
    "lego": lambda data: TransformsSource(
        name="lego", path=str(data / "lego" / "transforms_val.json"), up=(0, 0, 1), scale=0.1, resolution=0.25
    ),
    "bird": lambda data: PacNerfSource(
        name="bird", path=str(data / "bird"), truth={}, held_out_cameras=(2, 7), resolution=0.125
    ),
    "carnation": lambda data: ColmapSource(
        name="carnation",
        path=str(data / "carnation" / "sfm"),
        up=(0, -1, 0),
        scale=0.1,
        only="viewm0/*",
        resolution=0.25,
    ),
    "telephone": lambda data: ColmapSource(
        name="telephone", path=str(data / "telephone" / "sfm"), up=(0, -1, 0), scale=0.1, only="view*", resolution=0.25
    ),
}


@pytest.mark.data
@pytest.mark.parametrize("name", SOURCES)
def test_real_captures_load(name, data):
    if not (data / name).is_dir():
        pytest.skip(f"no {name} in {data}")
    source = SOURCES[name](data)
    capture = source(log=Log(None))
    assert len(capture.images) > 5
    if capture.points is not None:
        shares = []
        for camera in capture.cameras:
            uv, depth = camera.project(capture.points.double())
            inside = (depth > 0) & (uv > 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
            shares.append(float(inside.float().mean()))
        # each photograph sees a good part of the scene; a wrong axis or sign puts the points behind or beside
        assert sum(shares) / len(shares) > 0.3
    for alpha, image in zip(capture.alphas, capture.images):
        assert 0.005 < (alpha > 127).float().mean() < 0.9
        assert (image[alpha == 0] == 255).all()
