"""Camera files as other people and systems leave them: read as they mean it, or refused in one line that says why."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scene_formats as formats
import torch
from PIL import Image

from physics3d.log import Log
from physics3d.scenes.axes import Axes
from physics3d.scenes.colmap import ColmapSource
from physics3d.scenes.llff import LlffSource
from physics3d.scenes.transforms import TransformsSource

Z_UP = Axes(up=(0.0, 0.0, 1.0), scale=1.0)
W, H = formats.WIDTH, formats.HEIGHT


def transforms(folder: Path, *, blender: bool = False, **change) -> TransformsSource:
    formats.write_transforms(folder, Z_UP, blender=blender)
    return edited(folder, **change)


def edited(folder: Path, frame=None, **change) -> TransformsSource:
    """`change` is put into the head of the file (None removes), `frame(i, frame)` changes each frame."""
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    content = {k: v for k, v in {**content, **change}.items() if v is not None}
    for i, entry in enumerate(content["frames"]) if frame else ():
        frame(i, entry)
    file.write_text(json.dumps(content))
    return TransformsSource(name="x", path=str(folder), up=(0, 0, 1), scale=1.0, held_out_every=0)


def colmap(folder: Path, *, binary: bool = False) -> ColmapSource:
    formats.write_colmap(folder, Z_UP, binary=binary)
    return ColmapSource(name="x", path=str(folder), up=(0, 0, 1), scale=1.0, held_out_every=0)


def refused(source, message: str) -> str:
    with pytest.raises(ValueError, match=message) as caught:
        source(log=Log(None))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def said(source, folder: Path) -> tuple:
    log = Log(folder / "log", quiet=True)
    capture = source(log=log)
    return capture, (folder / "log" / "log.txt").read_text()


def assert_all_there(capture) -> None:
    """The five known cameras with the pictures that they took."""
    assert len(capture.images) == 5
    positions, colors = formats.points()
    for camera, known, image in zip(capture.cameras, formats.cameras(), capture.images):
        torch.testing.assert_close(camera.world_to_camera, known.world_to_camera, atol=1e-9, rtol=0)
        assert (image.numpy() == formats.picture(known, positions, colors)).all()


# ---- how files are named


def windows(entry: dict) -> None:
    entry["file_path"] = "C:\\Users\\me\\my scene\\" + entry["file_path"].replace("/", "\\")


NAMES = {
    "backslashes": lambda e: e.update(file_path=e["file_path"].replace("/", "\\")),
    "drive": windows,
    "elsewhere": lambda e: e.update(file_path="/home/somebody/scene/" + e["file_path"]),
    "no ending": lambda e: e.update(file_path=e["file_path"].removesuffix(".png")),
    "other case": lambda e: e.update(file_path=e["file_path"].upper().replace("IMAGES", "images")),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_from_other_systems_are_found(name, tmp_path):
    transforms(tmp_path)
    source = edited(tmp_path, frame=lambda i, entry: NAMES[name](entry))
    assert_all_there(source(log=Log(None)))
    assert sum(f.endswith(".png") for f in source.files()) == 5


@pytest.mark.parametrize("ending", ["", ".PNG", ".jpeg", ".JPG", ".webp"])
def test_any_ending_may_be_left_out(ending, tmp_path):
    source = transforms(tmp_path, blender=True)  # names have no ending
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_suffix(ending))
    assert_all_there(source(log=Log(None)))


def test_images_in_another_folder_and_names_with_backslashes_in_colmap(tmp_path):
    source = colmap(tmp_path)
    (tmp_path / "input" / "left").mkdir(parents=True)
    for file in (tmp_path / "images").iterdir():
        file.rename(tmp_path / "input" / "left" / file.name)
    images = tmp_path / "sparse/0/images.txt"
    images.write_text(re.sub(r"(\d\d\.png)", r"left\\\1", images.read_text()))
    assert_all_there(replace(source, images="input")(log=Log(None)))


def test_a_byte_order_mark_carriage_returns_and_wide_letters_are_read(tmp_path):
    source = transforms(tmp_path / "a")
    file = tmp_path / "a" / "transforms.json"
    for encoding in ("utf-8-sig", "utf-16"):
        text = json.dumps(json.loads(file.read_bytes().decode("utf-8-sig")), indent=1)
        file.write_bytes(text.replace("\n", "\r\n").encode(encoding))
        assert_all_there(source(log=Log(None)))
        file.write_text(text)
    source = colmap(tmp_path / "b")
    for file in (tmp_path / "b" / "sparse/0").glob("*.txt"):
        file.write_bytes(file.read_text().replace("\n", "\r\n").encode("utf-8-sig"))
    assert_all_there(source(log=Log(None)))


@pytest.mark.parametrize("binary", [False, True])
def test_sparse_as_the_undistorter_writes_it_is_read(binary, tmp_path):
    source = colmap(tmp_path, binary=binary)
    for file in (tmp_path / "sparse/0").iterdir():
        file.rename(tmp_path / "sparse" / file.name)
    (tmp_path / "sparse/0").rmdir()
    assert_all_there(source(log=Log(None)))


# ---- files that are lost, or listed twice


@pytest.mark.parametrize("kind", [transforms, colmap])
def test_lost_images_are_all_named_and_left_out_up_to_a_third(kind, tmp_path):
    source = kind(tmp_path)
    (tmp_path / "images/01.png").unlink()
    capture, text = said(source, tmp_path)
    assert "1 of the 5 images" in text and "01.png" in text
    assert [Path(n).stem for n in capture.names] == ["00", "02", "03", "04"]
    assert len([f for f in source.files() if f.endswith(".png")]) == 4
    (tmp_path / "images/03.png").unlink()
    message = refused(source, "2 of the 5 images")
    assert "01.png" in message and "03.png" in message and "restore" in message


def test_an_image_listed_twice_is_named(tmp_path):
    transforms(tmp_path / "a")
    refused(
        edited(tmp_path / "a", frame=lambda i, e: e.update(file_path="images/02.png")), "lists .*02.png more than once"
    )
    source = colmap(tmp_path / "b")
    file = tmp_path / "b/sparse/0/images.txt"
    file.write_text(file.read_text().replace("03.png", "01.png"))
    refused(source, "lists 01.png more than once")


def test_images_txt_without_second_lines_is_refused_at_its_line(tmp_path):
    source = colmap(tmp_path)
    file = tmp_path / "sparse/0/images.txt"
    lines = file.read_text().split("\n")
    file.write_text("\n".join([lines[0], *(line for line in lines if line.endswith(".png"))]) + "\n")
    refused(source, r"images\.txt, line 3: here should be the key points")


def test_images_txt_with_empty_second_lines_and_blank_lines_before_is_whole(tmp_path):
    source = colmap(tmp_path)
    file = tmp_path / "sparse/0/images.txt"
    lines = [line for line in file.read_text().split("\n") if line.endswith(".png")]
    file.write_text("# a comment\n\n" + "\n\n".join(lines))
    assert_all_there(source(log=Log(None)))


def length_of_first(part: str, data: bytes) -> int:
    """Bytes of the first entry of a binary file: a PINHOLE camera, or an image with its name and key points."""
    if part == "cameras":
        return 24 + 8 * 4
    name = data.index(b"\0", 72)
    return name + 9 - 8 + 24 * int.from_bytes(data[name + 1 : name + 9], "little")


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("part", ["cameras", "images"])
def test_a_number_that_stands_twice_in_colmap_is_refused(part, binary, tmp_path):
    """Points say by numbers of images where they are seen, images by numbers of cameras what took them."""
    source = colmap(tmp_path, binary=binary)
    file = tmp_path / "sparse/0" / (part + (".bin" if binary else ".txt"))
    if binary:
        data = file.read_bytes()
        count, first = int.from_bytes(data[:8], "little"), data[8 : 8 + length_of_first(part, data)]
        file.write_bytes((count + 1).to_bytes(8, "little") + data[8:] + first)
    else:
        lines = [line for line in file.read_text().split("\n") if not line.startswith("#")]
        file.write_text("\n".join([*lines[:-1], *lines[: 2 if part == "images" else 1], ""]))
    refused(source, rf"cannot read .*{file.name}.*: {part[:-1]} 1 is there twice, and each needs a number of its own")


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("more", [1, 64])
def test_bytes_after_the_end_of_a_binary_file_are_refused(part, more, tmp_path):
    source = colmap(tmp_path, binary=True)
    file = tmp_path / "sparse/0" / f"{part}.bin"
    file.write_bytes(file.read_bytes() + bytes(more))
    refused(source, rf"cannot read .*{part}\.bin: {more} bytes are left after its last entry; the file is damaged")


# ---- lenses


def test_a_vertical_angle_is_used_where_it_is_given(tmp_path):
    source = transforms(tmp_path, blender=True, camera_angle_y=2 * np.arctan(H / 2 / 50.0))
    (camera, *_) = source(log=Log(None)).cameras
    assert np.isclose(camera.fx, formats.FOCAL) and np.isclose(camera.fy, 50.0)
    (camera, *_) = edited(tmp_path, camera_angle_x=None)(log=Log(None)).cameras
    assert np.isclose(camera.fx, 50.0) and np.isclose(camera.fy, 50.0)


def test_what_a_frame_says_of_its_lens_holds_there(tmp_path):
    transforms(tmp_path)
    source = edited(tmp_path, frame=lambda i, e: e.update({"fl_x": 70.0 + i, "cx": 20.0} if i == 4 else {}))
    cameras = source(log=Log(None)).cameras  # frames are written backwards
    assert (cameras[0].fx, cameras[0].fy, cameras[0].cx) == (74.0, formats.FOCAL, 20.0)
    assert (cameras[1].fx, cameras[1].cx) == (formats.FOCAL, W / 2)
    # an angle in the frame goes before a focal length in the head
    source = edited(tmp_path, frame=lambda i, e: (e.pop("fl_x", None), e.update(camera_angle_x=2 * np.arctan(0.5))))
    assert np.isclose(source(log=Log(None)).cameras[0].fx, W)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"fl_x": 0.0}, "focal length 0"),
        ({"fl_x": -60.0}, "focal length -60"),
        ({"fl_x": float("nan")}, "NaN"),
        ({"cx": float("inf")}, "NaN or infinity"),
        ({"fl_x": "wide"}, "needs fl_x or camera_angle_x"),
        ({"fl_x": None, "fl_y": None}, "needs fl_x or camera_angle_x"),
        ({"w": 0}, "w and h are 0"),
        ({"h": None}, "give both"),
        ({"w": float("inf")}, "give both, in pixels"),
        ({"w": 48.5}, "give both, in pixels"),
        ({"w": True}, "give both, in pixels"),
        ({"fl_x": True}, "fl_x is True"),
        ({"fl_x": 1.2, "fl_y": 1.2}, "give pixels, not shares"),  # of the width
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 3.14159}, "sees nearly half of the world"),
        ({"cx": -5000.0}, "is far outside"),
        ({"k1": True}, "k1 is True"),
    ],
)
def test_a_lens_that_cannot_be_is_named(change, message, tmp_path):
    transforms(tmp_path)
    assert "00.png" in refused(edited(tmp_path, **change), message)


@pytest.mark.parametrize(
    "turn, message",
    [
        (np.diag([-1.0, 1, 1, 1]), "scale or mirroring"),
        (np.diag([2.0, 2, 2, 1]), "scale or mirroring"),
        (np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "not a rotation"),
    ],
)
def test_a_pose_that_is_no_motion_is_named(turn, message, tmp_path):
    transforms(tmp_path)

    def spoil(i, entry):
        entry["transform_matrix"] = (turn @ np.array(entry["transform_matrix"])).tolist()

    refused(edited(tmp_path, frame=spoil), message)


WRONG_NAMES = {"a number": 3, "too long": "a" * 300, "with a zero": "a\0b.png"}


@pytest.mark.parametrize("field", ["file_path", "mask_path", "ply_file_path"])
@pytest.mark.parametrize("name", WRONG_NAMES)
def test_what_no_file_can_be_called_is_refused(name, field, tmp_path):
    transforms(tmp_path)
    if field == "ply_file_path":
        source = edited(tmp_path, ply_file_path=WRONG_NAMES[name])
    else:
        source = edited(tmp_path, frame=lambda i, e: e.update({field: WRONG_NAMES[name]}))
    with pytest.raises(ValueError, match=r"cannot be the name of a file|list of frames and their file_path") as caught:
        source.files()
    assert "\n" not in str(caught.value)


def test_a_file_of_brackets_is_refused(tmp_path):
    source = transforms(tmp_path)
    (tmp_path / "transforms.json").write_text("[" * 100_000)
    refused(source, "is not a transforms.json")


def test_what_is_null_is_not_said(tmp_path):
    transforms(tmp_path)
    nothing = dict.fromkeys(("fl_x", "cx", "w", "k1", "mask_path", "camera_model"))
    assert_all_there(edited(tmp_path, frame=lambda i, e: e.update(nothing))(log=Log(None)))


@pytest.mark.parametrize("kind", [transforms, colmap])
def test_cameras_at_one_place_or_out_of_reach_are_refused(kind, tmp_path):
    source = kind(tmp_path)
    file = tmp_path / "sparse/0/images.txt"
    if kind is colmap:
        text = file.read_text()
        file.write_text(re.sub(r"(?m)^(\d+ \S+ \S+ \S+ \S+) \S+ \S+ \S+ ", r"\1 0 0 0 ", text))
    else:
        edited(tmp_path, frame=lambda i, e: [row.__setitem__(3, 0.5) for row in e["transform_matrix"][:3]])
    refused(source, "all 5 cameras are at")
    if kind is colmap:
        file.write_text(re.sub(r"(?m)^(\d+) \S+ ", r"\1 9 ", text))
        refused(source, "the quaternion of its pose has length 9")
    else:
        edited(tmp_path, frame=lambda i, e: e["transform_matrix"][i % 3].__setitem__(3, 1e300))
        refused(source, "units away")


def test_a_matrix_by_columns_is_named_and_three_rows_are_enough(tmp_path):
    transforms(tmp_path)
    cut = lambda i, e: e.update(transform_matrix=e["transform_matrix"][:3])
    assert_all_there(edited(tmp_path, frame=cut)(log=Log(None)))
    whole = lambda i, e: e.update(transform_matrix=np.array([*e["transform_matrix"], [0, 0, 0, 1]]).T.tolist())
    refused(edited(tmp_path, frame=whole), "last row")


def test_a_reduced_copy_keeps_its_rays_and_a_cropped_one_is_refused(tmp_path):
    full = colmap(tmp_path)(log=Log(None))
    for file in (tmp_path / "images").iterdir():
        Image.open(file).resize((W // 4, H // 4)).save(file)
    small, text = said(replace(colmap_at(tmp_path)), tmp_path)
    target = torch.tensor([[0.03, 0.02, 0.05]], dtype=torch.float64)
    for a, b in zip(full.cameras, small.cameras):
        torch.testing.assert_close(a.project(target)[0] / 4, b.project(target)[0])
    assert "5 of 5 images are of another size" in text
    Image.new("RGB", (W - 1, H)).save(tmp_path / "images/00.png")
    refused(colmap_at(tmp_path), r"00\.png has 47 x 36 pixels, its camera says 48 x 36")


def colmap_at(folder: Path) -> ColmapSource:
    return ColmapSource(name="x", path=str(folder), up=(0, 0, 1), scale=1.0, held_out_every=0)


# ---- pictures that are turned, masked, transparent


BACK = {3: Image.ROTATE_180, 6: Image.ROTATE_90, 8: Image.ROTATE_270}  # stored so that the turn shows it upright


def store_turned(folder: Path, turn: int) -> None:
    for file in folder.iterdir():
        exif = Image.Exif()
        exif[0x0112] = turn
        Image.open(file).transpose(BACK[turn]).save(file, exif=exif)


@pytest.mark.parametrize("turn", [6, 8])
@pytest.mark.parametrize("kind", [transforms, colmap])
def test_a_picture_whose_camera_has_the_size_it_is_shown_in_is_turned(kind, turn, tmp_path):
    source = kind(tmp_path)
    store_turned(tmp_path / "images", turn)
    capture, text = said(source, tmp_path)
    assert_all_there(capture)
    assert "5 of 5 images are turned as their EXIF says" in text


def test_a_picture_whose_camera_has_the_size_it_is_stored_in_stays_as_colmap_saw_it(tmp_path):
    source = colmap(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    for file in (tmp_path / "images").iterdir():
        Image.open(file).save(file, exif=exif)
    capture, text = said(source, tmp_path)
    assert_all_there(capture)
    assert "without their EXIF turn" in text


@pytest.mark.parametrize("turn, blender", [(3, False), (6, True), (3, True)])
def test_a_turn_that_the_camera_file_leaves_open_is_refused_with_the_reason(turn, blender, tmp_path):
    source = transforms(tmp_path, blender=blender)
    store_turned(tmp_path / "images", turn)
    refused(source, f"carries the EXIF turn {turn}, and the camera file does not tell")


@pytest.mark.parametrize("bits, said_so", [(10, True), (12, True), (14, True), (16, False)])
def test_fewer_bits_than_their_file_has_are_said_and_not_scaled(bits, said_so, tmp_path):
    """A camera of 12 bits and a dark picture of 16 look alike: only who took them knows."""
    import cv2

    source = colmap(tmp_path)
    for file in (tmp_path / "images").iterdir():
        picture = np.asarray(Image.open(file)).astype(np.float64) / 255
        picture[0, 0] = 1
        cv2.imwrite(str(file), np.round(picture * (2**bits - 1)).astype(np.uint16))
    capture, text = said(source, tmp_path)
    assert ("5 of 5 images are dark: of 16 bits, of which 14 or fewer are used" in text) == said_so
    assert abs(int(capture.images[0].max()) - 255 * 2**bits / 2**16) < 1


@pytest.mark.parametrize("white", [255, 1], ids=["0..255", "0..1"])
def test_masks_are_mattes(white, tmp_path):
    (tmp_path / "masks").mkdir()
    left = (np.arange(W) < W // 2)[None].repeat(H, 0)
    for i in range(5):
        Image.fromarray((left * white).astype(np.uint8)).save(tmp_path / "masks" / f"{i:02d}.png")
    transforms(tmp_path)
    source = edited(tmp_path, frame=lambda i, e: e.update(mask_path=f"masks/{4 - i:02d}.png"))
    capture = source(log=Log(None))
    assert len(capture.alphas) == 5 and len([f for f in source.files() if "/masks/" in f]) == 5
    positions, colors = formats.points()
    for alpha, image, known in zip(capture.alphas, capture.images, formats.cameras()):
        assert ((alpha.numpy() == 255) == left).all() and (alpha.numpy()[~left] == 0).all()
        assert (image.numpy()[left] == formats.picture(known, positions, colors)[left]).all()
        assert (image.numpy()[~left] == 255).all()
    Image.new("L", (W, H - 1)).save(tmp_path / "masks/02.png")
    refused(source, r"the mask .*02\.png has 48 x 35 pixels, its image .*02\.png 48 x 36")
    (tmp_path / "masks/02.png").unlink()
    refused(source, r"there is no image .*masks/02\.png")


def test_an_alpha_that_hides_nothing_is_no_matte(tmp_path):
    source = transforms(tmp_path)
    for i, file in enumerate(sorted((tmp_path / "images").iterdir())):
        if i % 2:
            Image.open(file).convert("RGBA").save(file)
    capture = source(log=Log(None))
    assert capture.alphas == ()
    assert_all_there(capture)


# ---- points, up and scale


@pytest.mark.parametrize("kind", ["uchar", "float", "none"])
def test_points_of_ply_file_path_are_used(kind, tmp_path):
    from plyfile import PlyData, PlyElement

    positions, colors = formats.points()
    dtype = [(n, "f8") for n in "xyz"] + [(n, "u1" if kind == "uchar" else "f4") for n in ("red", "green", "blue")]
    vertex = np.zeros(len(positions), dtype[:3] if kind == "none" else dtype)
    for i, n in enumerate("xyz"):
        vertex[n] = positions[:, i]
    for i, n in enumerate(("red", "green", "blue") if kind != "none" else ()):
        vertex[n] = colors[:, i] if kind == "uchar" else colors[:, i] / 255
    source = transforms(tmp_path, ply_file_path="sparse_pc.ply")
    refused(source, "no file of points")
    PlyData([PlyElement.describe(vertex, "vertex")]).write(str(tmp_path / "sparse_pc.ply"))
    capture = source(log=Log(None))
    torch.testing.assert_close(capture.points.double(), positions, atol=3e-7, rtol=0)
    expected = torch.full_like(capture.point_colors, 0.5) if kind == "none" else colors.float() / 255
    torch.testing.assert_close(capture.point_colors, expected)
    assert str(tmp_path / "sparse_pc.ply") in source.files() and str(tmp_path / "points3D.npz") not in source.files()


@pytest.mark.parametrize("axes", [Z_UP, Axes(up=(0.0, -2.0, 0.3), scale=3.0), Axes(up=(0, 0, -1), scale=0.1)])
def test_up_and_scale_are_guessed_from_the_cameras_where_they_are_left_out(axes, tmp_path):
    """The known cameras are level, and look at (0.02, -0.01, 0.1) from 0.9 m and a height of 0.25 to 0.65 m."""
    formats.write_colmap(tmp_path, axes, binary=False)
    capture, text = said(ColmapSource(name="x", path=str(tmp_path), held_out_every=0), tmp_path)
    target = torch.tensor([0.02, -0.01, 0.1], dtype=torch.float64)
    metres = 1 / torch.stack([c.centre - target for c in formats.cameras()]).norm(dim=1).median()
    # the horizontal turn is open: compare heights and distances. The pull towards the cameras' mean up, which is not
    # level for five cameras of different heights, tilts by 0.001
    for camera, known in zip(capture.cameras, formats.cameras()):
        assert abs(camera.centre[2] - metres * known.centre[2]) < 2e-3
        assert abs(camera.centre.norm() - metres * known.centre.norm()) < 1e-6
    assert "up is not given" in text and "scale is not given" in text and "the cameras look at [" in text
    assert f"{metres * 0.1:.3f}] m" in text and capture.floor is None


def test_a_floor_of_points_gives_up_and_its_height(tmp_path, rng):
    """Points on z = -0.1 of our axes, written in COLMAP's."""
    axes = Axes(up=(0.3, -1.0, 0.1), scale=0.5)
    formats.write_colmap(tmp_path, axes, binary=False)
    ground = np.c_[rng.uniform(-1, 1, (300, 2)), np.full(300, -0.1)] @ axes.rotation().numpy() / axes.scale
    lines = [f"{i} {x!r} {y!r} {z!r} 9 9 9 0.5 1 0\n" for i, (x, y, z) in enumerate(ground.tolist())]
    (tmp_path / "sparse/0/points3D.txt").write_text("".join(lines))
    capture = ColmapSource(name="x", path=str(tmp_path), scale=0.5, held_out_every=0)(log=Log(None))
    torch.testing.assert_close(capture.points[:, 2], torch.full((300,), -0.1), atol=1e-5, rtol=0)
    assert abs(capture.floor + 0.1) < 1e-5


# ---- LLFF


def write_llff(folder: Path, axes: Axes) -> None:
    """Written from the definition: columns down, right, backwards, centre, (h, w, f)."""
    formats.write_images(folder / "images")
    rows = []
    for camera in formats.cameras():
        right, up, back, centre = formats.opengl_pose(formats.to_source(camera, axes))[:3].T.numpy()
        rows.append(np.r_[np.stack([-up, right, back, centre, [H, W, formats.FOCAL]], 1).ravel(), 0.5, 2.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def test_llff_gives_back_the_known_cameras(tmp_path):
    axes = Axes(up=(0.0, 1.0, 0.0), scale=0.25)
    write_llff(tmp_path, axes)
    source = LlffSource(name="x", path=str(tmp_path), up=axes.up, scale=axes.scale, held_out_every=0)
    capture = source(log=Log(None))
    assert_all_there(capture)
    assert capture.cameras[0].fx == formats.FOCAL and capture.points is None
    assert {Path(f).name for f in source.files()} == {"poses_bounds.npy", *(f"{i:02d}.png" for i in range(5))}
    shutil.copytree(tmp_path / "images", tmp_path / "images_2")
    for file in (tmp_path / "images_2").iterdir():
        Image.open(file).resize((W // 2, H // 2)).save(file)
    half = replace(source, images="images_2")(log=Log(None))
    assert half.cameras[0].fx == formats.FOCAL / 2 and half.images[0].shape == (H // 2, W // 2, 3)
    (tmp_path / "images/02.png").unlink()
    refused(source, "5 rows, .* 4 images")
    (tmp_path / "poses_bounds.npy").write_bytes(b"nothing")
    refused(source, "cannot read .*poses_bounds.npy")
