"""Loaders: one known set of cameras and points, written in every format, comes back in metres with z up."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import scene_formats as formats
import torch
from PIL import Image

from physics3d.log import Log
from physics3d.scenes.axes import Axes
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.pac_nerf import PacNerfSource
from physics3d.scenes.transforms import TransformsSource

Z_UP = Axes(up=(0.0, 0.0, 1.0), scale=1.0)
AXES = [
    Z_UP,
    Axes(up=(0.0, 1.0, 0.0), scale=0.25),
    Axes(up=(0.0, -2.0, 0.1), scale=3.0),
    Axes(up=(0, 0, -1), scale=0.1),
]


def write(kind: str, folder: Path, axes: Axes):
    """A source of that kind over files written from the known cameras."""
    common = {"name": kind, "path": str(folder), "up": axes.up, "scale": axes.scale, "held_out_every": 0}
    if kind == "blender":
        formats.write_transforms(folder, axes, blender=True)
        return TransformsSource(**common)
    if kind == "pinhole":
        formats.write_transforms(folder, axes, blender=False)
        return TransformsSource(**common)
    if kind == "pac_nerf":
        formats.write_pac_nerf(folder, axes)
        return PacNerfSource(name=kind, path=str(folder), truth={"youngs_modulus": 1.0}, scale=axes.scale)
    formats.write_colmap(folder, axes, binary=kind == "colmap_binary")
    return ColmapSource(**common)


STATIC = ("blender", "pinhole", "colmap_text", "colmap_binary")


def test_y_up_becomes_z_up_by_a_quarter_turn():
    moved = Axes(up=(0.0, 1.0, 0.0), scale=2.0).points(torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(moved, torch.tensor([[2.0, -6.0, 4.0]]))


@pytest.mark.parametrize("axes", AXES)
def test_up_becomes_z_and_nothing_is_mirrored(axes):
    Q = axes.rotation()
    up = torch.tensor(axes.up, dtype=torch.float64)
    torch.testing.assert_close(Q @ up / up.norm(), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(Q @ Q.T, torch.eye(3, dtype=torch.float64))
    assert torch.det(Q) > 0


@pytest.mark.parametrize("axes", AXES, ids=lambda a: f"up{a.up}")
@pytest.mark.parametrize("kind", STATIC)
def test_every_format_gives_back_the_same_cameras_images_and_points(kind, axes, tmp_path):
    capture = write(kind, tmp_path, axes)(log=Log(None))
    expected = formats.cameras()
    positions, colors = formats.points()
    assert len(capture.cameras) == len(expected) and capture.held_out == ()
    for camera, known, image in zip(capture.cameras, expected, capture.images):
        # poses travel as float64 or 17 digits; quaternions and inverses cost a few roundings
        torch.testing.assert_close(camera.world_to_camera, known.world_to_camera, atol=1e-9, rtol=0)
        assert math.isclose(camera.fx, known.fx, rel_tol=1e-12) and camera.cx == known.cx and camera.cy == known.cy
        assert (image.numpy() == formats.picture(known, positions, colors)).all()
    # points are kept in float32, a few 1e-8 m at 0.2 m
    torch.testing.assert_close(capture.points.double(), positions, atol=3e-7, rtol=0)
    torch.testing.assert_close(capture.point_colors, colors.float() / 255)


@pytest.mark.parametrize("kind", STATIC)
def test_points_reproject_onto_their_colour(kind, tmp_path):
    capture = write(kind, tmp_path, AXES[1])(log=Log(None))
    seen = 0
    for camera, image in zip(capture.cameras, capture.images):
        uv, depth = camera.project(capture.points.double())
        for (u, v), z, color in zip(uv.tolist(), depth.tolist(), capture.point_colors):
            inside = z > 0 and 0.01 < u % 1 < 0.99 and 0.01 < v % 1 < 0.99  # not on an edge, where roundings decide
            if inside and 0 <= u < camera.width and 0 <= v < camera.height:
                seen += bool((image[int(v), int(u)].float() / 255 - color).abs().max() < 1e-6)
    # a point hides another now and then
    assert seen > 0.8 * len(capture.points) * len(capture.cameras)


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_pac_nerf_gives_the_first_frame_as_images_and_all_frames_as_a_take(scale, tmp_path):
    axes = Axes(up=(0.0, 1.0, 0.0), scale=scale)
    capture = write("pac_nerf", tmp_path, axes)(log=Log(None))
    take = capture.take("learn")
    assert take.name == "drop" and take.fps == 24 and len(take.videos) == 5 and take.videos[0].shape[0] == 3
    for i, known in enumerate(formats.cameras()):
        torch.testing.assert_close(capture.cameras[i].world_to_camera, known.world_to_camera, atol=1e-9, rtol=0)
        assert (take.videos[i][0] == capture.images[i]).all()
        assert (capture.images[i][:, 24:] == 255).all()  # the right half has no matte: background
        assert (take.videos[i][2][2, :24] == 0).all()  # frame t has a black line in row t
        assert (capture.alphas[i][:, :24] == 255).all() and (capture.alphas[i][:, 24:] == 0).all()


@pytest.mark.parametrize("kind", [*STATIC, "pac_nerf"])
def test_fewer_pixels_change_no_ray(kind, tmp_path):
    from dataclasses import replace

    source = write(kind, tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    full, half = source(log=Log(None)), replace(source, resolution=0.5)(log=Log(None))
    target = torch.tensor([[0.03, 0.02, 0.05]], dtype=torch.float64)
    for a, b, image, small in zip(full.cameras, half.cameras, full.images, half.images):
        torch.testing.assert_close(a.project(target)[0] / 2, b.project(target)[0])
        assert (b.width, b.height) == (24, 18) and small.shape == (18, 24, 3)
        # a box of four pixels, rounded once
        mean = image.float().reshape(18, 2, 24, 2, 3).mean((1, 3))
        assert (small.float() - mean).abs().max() <= 0.5 + 1e-3


@pytest.mark.parametrize("kind", [*STATIC, "pac_nerf"])
def test_files_are_what_the_capture_reads(kind, tmp_path):
    source = write(kind, tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    files = source.files()
    assert all(Path(f).is_file() for f in files) and len(set(files)) == len(files)
    present = [f for f in tmp_path.rglob("*") if f.is_file() and f.stem not in ("rigs", "frames")]
    unread = [f for f in present if str(f) not in files]
    assert unread == []


def test_only_takes_the_named_images_and_every_second_is_held_out(tmp_path):
    from dataclasses import replace

    source = write("colmap_text", tmp_path, Z_UP)
    capture = replace(source, only="0[0-2].png", held_out_every=2)(log=Log(None))
    assert capture.names == ("00.png", "01.png", "02.png") and capture.held_out == (0, 2)


def spoil_image(folder: Path) -> Path:
    file = sorted(folder.rglob("*.png"))[0]
    file.write_bytes(file.read_bytes()[:100])
    return file


def empty_image(folder: Path) -> Path:
    file = sorted(folder.rglob("*.png"))[0]
    file.write_bytes(b"")
    return file


def resize_image(folder: Path) -> Path:
    file = sorted(folder.rglob("*.png"))[0]
    mode = Image.open(file).mode
    Image.new(mode, (200, 20)).save(file)
    return file


@pytest.mark.parametrize("spoil", [spoil_image, empty_image, resize_image])
@pytest.mark.parametrize("kind", ["pinhole", "colmap_text", "colmap_binary", "pac_nerf"])
def test_a_bad_image_is_named(kind, spoil, tmp_path):
    source = write(kind, tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    name = spoil(tmp_path).name
    with pytest.raises(ValueError, match=name):
        source(log=Log(None))


@pytest.mark.parametrize("kind", [*STATIC, "pac_nerf"])
def test_a_missing_folder_is_named(kind, tmp_path):
    from dataclasses import replace

    source = replace(write(kind, tmp_path / "there", Z_UP), path=str(tmp_path / "nowhere"))
    for call in (source.files, lambda: source(log=Log(None))):
        with pytest.raises(ValueError, match="nowhere"):
            call()


def nan_in_json(file: Path, key: str) -> None:
    content = json.loads(file.read_text())
    entries = content["frames"] if isinstance(content, dict) else content
    for entry in entries:
        entry[key][0][3] = float("nan")
    file.write_text(json.dumps(content))


@pytest.mark.parametrize("kind", [*STATIC, "pac_nerf"])
def test_a_pose_that_is_not_a_number_is_refused(kind, tmp_path):
    source = write(kind, tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    if kind in ("blender", "pinhole"):
        nan_in_json(tmp_path / "transforms.json", "transform_matrix")
    elif kind == "pac_nerf":
        nan_in_json(tmp_path / "all_data.json", "c2w")
    elif kind == "colmap_text":
        file = tmp_path / "sparse/0/images.txt"
        lines = file.read_text().splitlines()
        words = lines[1].split()
        words[5] = "nan"
        file.write_text("\n".join([lines[0], " ".join(words), *lines[2:]]))
    else:
        file = tmp_path / "sparse/0/images.bin"
        data = bytearray(file.read_bytes())
        data[8 + 4 + 32 : 8 + 4 + 40] = np.float64("nan").tobytes()
        file.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="pose holds NaN"):
        source(log=Log(None))


@pytest.mark.parametrize("kind", [*STATIC, "pac_nerf"])
def test_no_images_is_an_error(kind, tmp_path):
    source = write(kind, tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    if kind in ("blender", "pinhole"):
        (tmp_path / "transforms.json").write_text('{"frames": []}')
    elif kind == "pac_nerf":
        (tmp_path / "all_data.json").write_text("[]")
    elif kind == "colmap_text":
        (tmp_path / "sparse/0/images.txt").write_text("# none\n")
    else:
        (tmp_path / "sparse/0/images.bin").write_bytes(bytes(8))
    with pytest.raises(ValueError, match=r"no images|no mattes"):
        source(log=Log(None))


@pytest.mark.parametrize("kind", [*STATIC, "pac_nerf"])
def test_a_damaged_camera_file_is_named(kind, tmp_path):
    source = write(kind, tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    files = [f for f in tmp_path.rglob("*") if f.suffix in (".json", ".txt", ".bin", ".npz")]
    for file in sorted(f for f in files if f.stem not in ("rigs", "frames")):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2 - 3])
        with pytest.raises(ValueError, match=file.name):
            source(log=Log(None))
        file.write_bytes(whole)


@pytest.mark.parametrize("change", [{"scale": 0.0}, {"scale": float("nan")}, {"up": (0, 0, 0)}, {"resolution": 2.0}])
@pytest.mark.parametrize("kind", STATIC)
def test_impossible_settings_are_named(kind, change, tmp_path):
    from dataclasses import replace

    source = write(kind, tmp_path, Z_UP)
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(source, **change)(log=Log(None))


def test_an_image_without_alpha_among_mattes_is_named(tmp_path):
    source = write("blender", tmp_path, Z_UP)
    file = tmp_path / "images" / "03.png"
    picture = Image.open(file).convert("RGBA")
    picture.putpixel((0, 0), (0, 0, 0, 0))
    picture.save(file)
    with pytest.raises(ValueError, match=r"00\.png has no alpha"):
        source(log=Log(None))
