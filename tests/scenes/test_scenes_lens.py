"""Distorted pictures, synthesised with OpenCV's lens and its inverse, read as what a pinhole would have seen."""

import json
import struct

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from physics3d.log import Log
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.colmap_model import MODELS, PERSPECTIVE
from physics3d.scenes.lens import Lens
from physics3d.scenes.transforms import TransformsSource

W, H = 160, 120
K = {"fx": 130.0, "fy": 124.0, "cx": 83.0, "cy": 57.0}
BARREL = {"k1": -0.21, "k2": 0.05, "p1": 0.004, "p2": -0.003}
# lens by COLMAP's name -> its coefficients
LENSES = {
    "SIMPLE_PINHOLE": {},
    "PINHOLE": {},
    "SIMPLE_RADIAL": {"k1": 0.18},
    "RADIAL": {"k1": -0.25, "k2": 0.07},
    "OPENCV": BARREL,
    "FULL_OPENCV": {**BARREL, "k3": 0.02, "k4": 0.05, "k5": 0.01, "k6": -0.01},
}


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colour in 0..255 of what lies in the direction (x, y, 1): smooth, so that sampling it between pixels is exact."""
    return 127 + 100 * np.stack([np.sin(7 * x + 2 * y), np.cos(6 * y - x), np.sin(5 * (x + y) + 1)], -1)


def distorted(lens: dict, coefficients: dict) -> np.ndarray:
    """The picture, by OpenCV's inverse of its own model; it counts pixels from the middle of the first."""
    matrix = np.array([[lens["fx"], 0, lens["cx"] - 0.5], [0, lens["fy"], lens["cy"] - 0.5], [0, 0, 1]])
    d = np.array([coefficients.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    pixels = np.stack(np.meshgrid(np.arange(W), np.arange(H)), -1).reshape(-1, 1, 2).astype(np.float64)
    xy = cv2.undistortPoints(pixels, matrix, d, criteria=(cv2.TERM_CRITERIA_COUNT, 200, 0))
    return (scene(xy[:, 0, 0], xy[:, 0, 1]).reshape(H, W, 3) + 0.5).astype(np.uint8)


def intrinsics(model: str) -> dict:
    return {**K, "fy": K["fx"]} if "f" in PERSPECTIVE[model] else K


def write_colmap(folder, model: str, *, binary: bool) -> None:
    values = {**intrinsics(model), "f": K["fx"], **LENSES[model]}
    numbers = [values[name] for name in PERSPECTIVE[model]]
    (folder / "sparse").mkdir()  # as the undistorter writes it, without 0
    if binary:
        kind = next(i for i, (name, _) in MODELS.items() if name == model)
        cameras = struct.pack(f"<QiiQQ{len(numbers)}d", 1, 1, kind, W, H, *numbers)
        (folder / "sparse/cameras.bin").write_bytes(cameras)
        images = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q", 0)
        (folder / "sparse/images.bin").write_bytes(images)
        (folder / "sparse/points3D.bin").write_bytes(struct.pack("<Q", 0))
    else:
        (folder / "sparse/cameras.txt").write_text(f"1 {model} {W} {H} {' '.join(map(repr, numbers))}\n")
        (folder / "sparse/images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
        (folder / "sparse/points3D.txt").write_text("")


def colmap(folder, model: str, *, binary: bool) -> ColmapSource:
    (folder / "images").mkdir()
    Image.fromarray(distorted(intrinsics(model), LENSES[model])).save(folder / "images/a.png")
    write_colmap(folder, model, binary=binary)
    return ColmapSource(name="x", path=str(folder), up=(0, 0, 1), scale=1.0, held_out_every=0)


def transforms(folder, coefficients: dict, **more) -> TransformsSource:
    Image.fromarray(distorted(K, coefficients)).save(folder / "a.png")
    lens = {"w": W, "h": H, "fl_x": K["fx"], "fl_y": K["fy"], "cx": K["cx"], "cy": K["cy"], **coefficients, **more}
    frame = {"file_path": "a.png", "transform_matrix": np.diag([1.0, -1, -1, 1]).tolist()}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    return TransformsSource(name="x", path=str(folder), up=(0, 0, 1), scale=1.0, held_out_every=0)


def assert_pinhole_sees_the_scene(source) -> None:
    capture = source(log=Log(None))
    (camera,), (image,) = capture.cameras, capture.images
    local = camera.rays(torch.float64)[1] @ camera.world_to_camera[:3, :3].T
    expected = scene((local[..., 0] / local[..., 2]).numpy(), (local[..., 1] / local[..., 2]).numpy())
    # 8 bits twice, and cubic interpolation of a picture whose period is 100 pixels
    assert np.abs(image.numpy() - expected).max() < 1.6
    assert image.shape == (H, W, 3)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("model", LENSES)
def test_a_colmap_picture_is_what_its_pinhole_sees(model, binary, tmp_path):
    assert_pinhole_sees_the_scene(colmap(tmp_path, model, binary=binary))


@pytest.mark.parametrize(
    "coefficients",
    [
        {},
        {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0},
        {"k1": 1e-7},
        BARREL,
        {**BARREL, "k3": 0.03},
        {**LENSES["FULL_OPENCV"], "camera_model": "FULL_OPENCV"},
        {"k1": 0.3},
    ],
    ids=["none", "zero", "tiny", "opencv", "k3", "rational", "pincushion"],
)
def test_a_picture_of_transforms_json_is_what_its_pinhole_sees(coefficients, tmp_path):
    assert_pinhole_sees_the_scene(transforms(tmp_path, coefficients))


def test_k4_alone_is_the_factor_of_the_eighth_power(tmp_path):
    """As in nerfstudio; OpenCV's k4 divides. The radius is inverted by a table here."""
    k = {"k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": 0.3}
    source = transforms(tmp_path, k)
    r = np.linspace(0, 2, 200001)
    table = r * (1 + k["k1"] * r**2 + k["k2"] * r**4 + k["k3"] * r**6 + k["k4"] * r**8)
    v, u = np.meshgrid(np.arange(H) + 0.5, np.arange(W) + 0.5, indexing="ij")
    x, y = (u - K["cx"]) / K["fx"], (v - K["cy"]) / K["fy"]
    bent = np.hypot(x, y)
    factor = np.interp(bent, table, r) / bent
    Image.fromarray((scene(factor * x, factor * y) + 0.5).astype(np.uint8)).save(tmp_path / "a.png")
    assert_pinhole_sees_the_scene(source)


def test_without_distortion_no_pixel_is_touched(tmp_path):
    for coefficients in ({}, {"k1": 0.0}, {"k1": 1e-7}):
        capture = transforms(tmp_path, coefficients)(log=Log(None))
        assert (capture.images[0].numpy() == distorted(K, {})).all() and capture.cameras[0].fx == K["fx"]


@pytest.mark.parametrize("model", LENSES)
def test_pixels_are_those_of_opencv_and_of_colmap(model, rng):
    k = LENSES[model]
    lens = Lens(
        width=W, height=H, **intrinsics(model),
        radial=tuple(k.get(n, 0.0) for n in ("k1", "k2", "k3")),
        denominator=tuple(k.get(n, 0.0) for n in ("k4", "k5", "k6")),
        tangential=(k.get("p1", 0.0), k.get("p2", 0.0)),
    )  # fmt: skip
    xy = rng.uniform(-0.5, 0.5, (50, 2))
    f = intrinsics(model)
    matrix = np.array([[f["fx"], 0, f["cx"]], [0, f["fy"], f["cy"]], [0, 0, 1]])
    d = np.array([k.get(n, 0.0) for n in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
    theirs, _ = cv2.projectPoints(np.c_[xy, np.ones(50)], np.zeros(3), np.zeros(3), matrix, d)
    np.testing.assert_allclose(lens.pixels(xy), theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(lens.directions(lens.pixels(xy), "x"), xy, atol=1e-9)
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    values = {**f, "f": f["fx"], **k}
    camera = pycolmap.Camera(model=model, width=W, height=H, params=[values[n] for n in PERSPECTIVE[model]])
    np.testing.assert_allclose(lens.pixels(xy), camera.img_from_cam(np.c_[xy, np.ones(50)]), atol=1e-9)


def test_skew_is_taken_out_of_the_picture():
    from physics3d.scenes.lens import undistorted

    lens = Lens(width=W, height=H, **K, skew=9.0)
    v, u = np.meshgrid(np.arange(H) + 0.5, np.arange(W) + 0.5, indexing="ij")
    y = (v - K["cy"]) / K["fy"]
    picture = scene((u - K["cx"] - 9.0 * y) / K["fx"], y).astype(np.float32)
    (straight,), pinhole = undistorted([picture], lens, "x")
    expected = scene((u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy)
    assert np.abs(straight - expected).max() < 0.6  # interpolation


def test_a_lens_that_folds_the_picture_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a\.png: the lens distortion .* folds the picture"):
        # x (1 - 2 x^2) turns back at x = 0.41, the rim is at 0.6
        source = transforms(tmp_path, {})
        content = json.loads((tmp_path / "transforms.json").read_text())
        (tmp_path / "transforms.json").write_text(json.dumps({**content, "k1": -2.0}))
        source(log=Log(None))


@pytest.mark.parametrize("model", sorted({name for name, _ in MODELS.values()} - set(PERSPECTIVE)))
@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_what_is_no_perspective_camera_is_refused_by_name(model, binary, tmp_path):
    source = colmap(tmp_path, "PINHOLE", binary=binary)
    kind, count = next((i, count) for i, (name, count) in MODELS.items() if name == model)
    if binary:
        (tmp_path / "sparse/cameras.bin").write_bytes(struct.pack(f"<QiiQQ{count}d", 1, 1, kind, W, H, *[50.0] * count))
    else:
        (tmp_path / "sparse/cameras.txt").write_text(f"1 {model} {W} {H} {'50 ' * count}\n")
    with pytest.raises(ValueError, match=f"a.png: camera model {model} is no perspective camera"):
        source(log=Log(None))


def test_numbers_of_models_and_parameters_are_those_of_colmap():
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    for number, (name, count) in MODELS.items():
        assert int(getattr(pycolmap.CameraModelId, name)) == number
        assert len(pycolmap.Camera.create_from_model_name(1, name, 50.0, 40, 30).params) == count, name


@pytest.mark.parametrize("said", [
    {"camera_model": "EQUIRECTANGULAR"}, {"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "FISHEYE624"},
    {"camera_model": "fisheye"}, {"is_fisheye": True}, {"equirectangular": True},
])  # fmt: skip
def test_transforms_of_other_cameras_are_refused_by_name(said, tmp_path):
    with pytest.raises(ValueError, match=f"a.png: .*{next(iter(said.values()))} is no perspective camera"):
        transforms(tmp_path, {}, **said)(log=Log(None))
