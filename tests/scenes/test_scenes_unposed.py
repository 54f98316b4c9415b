"""Photographs without cameras: what can be told of up and floor, which frames of a video are taken, and real ones."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from physics3d.gaussians.cameras import look_at
from physics3d.log import Log
from physics3d.scenes.frames import sharpest_frames
from physics3d.scenes.ground import floor_plane, level, nearest_to_axes
from physics3d.scenes.parallax import explained
from physics3d.scenes.sfm import Solved, pairs
from physics3d.scenes.transforms import TransformsSource
from physics3d.scenes.unposed import UnposedSource, _copies, photographs_below, report
from physics3d.video import read_mp4

UP = np.array([0.3, -0.8, 0.2]) / np.linalg.norm([0.3, -0.8, 0.2])


def cameras(turn: float, target=(0.4, -0.2, 0.1)) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres of 9 level cameras that look down at `target`, around `turn` radians of UP."""
    side = np.linalg.svd(UP[None])[2][1:]
    M = []
    for angle in np.linspace(0, turn, 9):
        at = target + 2 * (np.cos(angle) * side[0] + np.sin(angle) * side[1]) + 1.3 * UP
        M.append(look_at(torch.from_numpy(at), torch.tensor(target), up=tuple(UP)).numpy())
    M = np.stack(M)
    return M[:, :3, :3], -np.einsum("nji,nj->ni", M[:, :3, :3], M[:, :3, 3])


@pytest.mark.parametrize("turn", [1.0, 3.0, 6.0])
def test_up_of_level_cameras_does_not_depend_on_how_far_they_look_down(turn):
    """They look down by 33 degrees, which is what their mean up is off by over a short arc; 2 degrees are the small
    pull towards that mean, felt over the shortest."""
    R, _ = cameras(turn)
    assert np.degrees(np.arccos(level(R) @ UP)) < 2


def test_up_of_cameras_side_by_side_is_their_own_up():
    """All look the same way: the horizon leaves open which way up is about their right."""
    R, _ = cameras(0.0)
    np.testing.assert_allclose(level(R), -R[0, 1], atol=1e-6)


def test_the_point_that_all_cameras_look_at_is_found():
    R, centres = cameras(3.0)
    np.testing.assert_allclose(nearest_to_axes(centres, R[:, 2]), (0.4, -0.2, 0.1), atol=1e-9)


def test_the_floor_is_the_level_plane_below_and_not_the_wall(rng):
    side = np.linalg.svd(UP[None])[2][1:]
    floor = rng.uniform(-1, 1, (300, 2)) @ side
    wall = rng.uniform(-1, 1, (500, 1)) * side[0] + rng.uniform(0, 2, (500, 1)) * UP + side[1]
    clutter = rng.normal(size=(100, 3)) * 0.5 + UP
    points = np.concatenate([floor, wall, clutter]) + rng.normal(size=(900, 3)) * 2e-3
    plane = floor_plane(points, UP, 0.5 * UP, 0.01, seed=0)
    assert np.degrees(np.arccos(plane[:3] @ UP)) < 1 and abs(plane[3]) < 0.01
    assert floor_plane(np.concatenate([wall, clutter]), UP, 0.5 * UP, 0.01, seed=0) is None


def test_the_sharpest_frame_of_each_stretch_of_a_video_is_taken(tmp_path, rng):
    """Frames of noise, blurred but for every fifth: 4 stretches of 5, each with one sharp frame, ever brighter."""
    import cv2

    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (96, 64))
    for i in range(20):
        frame = rng.integers(0, 100, (64, 96, 3), np.uint8) + np.uint8(8 * i)
        writer.write(frame if i % 5 == 2 else cv2.GaussianBlur(frame, (9, 9), 3))
    writer.release()
    (tmp_path / "out").mkdir()
    sharpest_frames(tmp_path / "a.avi", tmp_path / "out", 4, 48, Log(None))
    files = sorted((tmp_path / "out").iterdir())
    assert len(files) == 4
    for k, file in enumerate(files):
        frame = cv2.imread(str(file))
        assert frame.shape == (32, 48, 3)
        # mean of the noise and 8 per frame; neighbours differ by 8
        assert abs(frame.mean() - (49.5 + 8 * (5 * k + 2))) < 4


@pytest.mark.parametrize(
    "change, message",
    [
        ({"camera_distance": 0.0}, "camera_distance is 0.0"),
        ({"frames": 2}, "frames is 2"),
        ({"longest_side": 10}, "longest_side is 10"),
        ({"path": "/nowhere"}, "no folder of photographs and no video"),
        ({"path": "/nowhere.mp4"}, "no video at /nowhere.mp4"),
    ],
)
def test_what_cannot_be_read_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        UnposedSource(**{"name": "x", "path": "/nowhere", "camera_distance": 1.0, **change})(log=Log(None))


def pictures(folder: Path, rng: np.random.Generator, count: int) -> str:
    from PIL import Image

    for i in range(count):
        Image.fromarray(rng.integers(0, 255, (120, 160, 3), np.uint8)).resize((320, 240)).save(folder / f"{i}.jpg")
    return str(folder)


def test_without_pycolmap_it_is_said_what_to_install(tmp_path, rng, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # import raises
    with pytest.raises(ValueError, match="pip install pycolmap"):
        UnposedSource(name="x", path=pictures(tmp_path, rng, 3), camera_distance=1.0)(log=Log(None))


def test_photographs_of_nothing_in_common_are_refused(tmp_path, rng):
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    with pytest.raises(ValueError, match="only 0 of 3 photographs could be placed"):
        UnposedSource(name="x", path=pictures(tmp_path, rng, 3), camera_distance=1.0)(log=Log(None))


def ffmpeg(*words: str) -> bytes:
    import subprocess

    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *words]
    return subprocess.run(command, check=True, capture_output=True).stdout


TEST_PICTURE = ("-f", "lavfi", "-i", "testsrc=size=96x64:rate=10:duration=2")
PIPED = {
    "browser.webm": ("-c:v", "libvpx", "-b:v", "1M", "-f", "webm", "-live", "1", "pipe:1"),
    "pipe.mkv": ("-c:v", "libx264", "-f", "matroska", "pipe:1"),
}


@pytest.mark.parametrize("name", PIPED)
def test_a_video_whose_header_has_no_number_of_frames_is_read_to_its_end(name, tmp_path):
    """testsrc counts seconds in its picture: the frames of the second one differ from those of the first."""
    import cv2

    (tmp_path / name).write_bytes(ffmpeg(*TEST_PICTURE, *PIPED[name]))
    assert cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FRAME_COUNT) <= 0, "the header says it after all"
    (tmp_path / "out").mkdir()
    sharpest_frames(tmp_path / name, tmp_path / "out", 4, 96, Log(None))
    files = sorted((tmp_path / "out").iterdir())
    assert [f.name for f in files] == [f"frame_{i:04d}.jpg" for i in range(4)]
    first, *_, last = (cv2.imread(str(f)).astype(float) for f in files)
    assert np.abs(first - last).max() > 100
    frames, fps = read_mp4(tmp_path / name)
    assert frames.shape == (20, 64, 96, 3) and fps == 10


def test_a_video_is_turned_as_its_header_says(tmp_path):
    import cv2

    ffmpeg(*TEST_PICTURE, "-c:v", "libx264", str(tmp_path / "a.mp4"))
    ffmpeg("-display_rotation", "90", "-i", str(tmp_path / "a.mp4"), "-c", "copy", str(tmp_path / "b.mp4"))
    plain, turned = read_mp4(tmp_path / "a.mp4")[0], read_mp4(tmp_path / "b.mp4")[0]
    # a quarter turn against the clock; chroma is sampled in pairs of pixels, which the turn moves
    assert (turned.float() - torch.rot90(plain, 1, (1, 2)).float()).abs().mean() < 6
    (tmp_path / "out").mkdir()
    sharpest_frames(tmp_path / "b.mp4", tmp_path / "out", 3, 96, Log(None))
    assert {cv2.imread(str(f)).shape for f in (tmp_path / "out").iterdir()} == {(96, 64, 3)}


def test_frames_of_a_variable_rate_are_evenly_spaced_in_time(tmp_path):
    """13 frames over 2.9 s: five at 10 a second, then one every 0.3 s; grey levels tell the time of each."""
    grey = "color=black:size=64x64:rate=10:duration=2.9,geq=lum='16+7*N':cb=128:cr=128"
    some = "select='lt(n,5)+not(mod(n-5,3))'"
    ffmpeg("-f", "lavfi", "-i", f"{grey},{some}", "-fps_mode", "vfr", "-c:v", "libx264", str(tmp_path / "a.mp4"))
    frames, fps = read_mp4(tmp_path / "a.mp4")
    level = frames.float().mean((1, 2, 3)) * 219 / 255 + 16  # video range
    shown = (level - 16) / 7 / 10  # time of the frame that is shown [s]
    expected = torch.arange(len(frames)) / fps
    assert abs(len(frames) / fps - 2.9) < 0.4
    # what is shown is at most the longest pause and half a step of the result away
    assert (shown - expected).abs().max() < 0.3 + 0.5 / fps


def test_what_is_no_video_is_named(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"nothing")
    for read in (lambda p: sharpest_frames(p, tmp_path, 4, 96, Log(None)), read_mp4):
        with pytest.raises(ValueError, match=r"a\.mp4"):
            read(tmp_path / "a.mp4")


def test_photographs_of_subfolders_are_read_where_there_are_no_others(tmp_path, rng):
    for name in ("100APPLE", "101APPLE", "__MACOSX"):
        (tmp_path / name).mkdir()
        pictures(tmp_path / name, rng, 2)
    (tmp_path / "100APPLE/._0.jpg").write_bytes(b"\0\5\26\7")
    (tmp_path / "101APPLE/IMG_7.HEIC").write_bytes(b"heic")
    log = Log(tmp_path / "log", quiet=True)
    found = photographs_below(tmp_path, log)
    assert [str(p.relative_to(tmp_path)) for p in found] == [f"{d}APPLE/{i}.jpg" for d in (100, 101) for i in (0, 1)]
    assert "1 .heic beside the 4 photographs cannot be read" in (tmp_path / "log/log.txt").read_text()
    pictures(tmp_path, rng, 1)
    assert photographs_below(tmp_path, log) == [tmp_path / "0.jpg"]
    assert "4 photographs in subfolders" in (tmp_path / "log/log.txt").read_text()


@pytest.mark.parametrize("names, remedy", [
    (["IMG_1.HEIC", "IMG_2.dng"], "1 .dng, 1 .heic; convert HEIC"), (["a.MOV"], "give the file itself"),
    ([], "but nothing"),
])  # fmt: skip
def test_a_folder_without_photographs_says_what_it_holds(names, remedy, tmp_path):
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(ValueError, match=remedy):
        photographs_below(tmp_path)


def test_copies_are_upright_keep_their_focal_length_and_hide_what_alpha_hides(tmp_path):
    from PIL import Image

    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    ramp = np.stack([np.arange(80)[None].repeat(60, 0)] * 3, -1).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 35  # focal length as on film [mm]
    Image.fromarray(ramp).save(tmp_path / "in/photo one.jpg", exif=exif, quality=95)
    hidden = np.arange(80)[None].repeat(60, 0) < 40
    red = np.where(hidden[..., None], np.uint8([200, 0, 0]), ramp)
    Image.fromarray(np.dstack([red, np.where(hidden, 0, 255).astype(np.uint8)])).save(tmp_path / "in/b.png")
    called: dict[str, str] = {}
    for kind in ("jpg", "png"):
        (tmp_path / kind).mkdir()
        for file in (tmp_path / "in").glob(f"*.{kind}"):
            shutil.copy(file, tmp_path / kind)
        called |= _copies(tmp_path / kind, tmp_path / "out", 1000, (0.0, 1.0, 0.0), Log(None))
    assert called == {"photo_one.jpg": "photo one.jpg", "b.png": "b.png"}
    with Image.open(tmp_path / "out/photo_one.jpg") as copy:
        assert copy.size == (60, 80) and copy.getexif().get(0x0112, 1) == 1
        assert copy.getexif().get_ifd(0x8769)[0xA405] == 35
        assert np.diff(np.asarray(copy.convert("L")).astype(float).mean(1)[::8]).min() > 0  # columns became rows
    array = np.asarray(Image.open(tmp_path / "out/b.png"))
    assert (array[:, :40] == (0, 255, 0, 0)).all() and (array[:, 40:, :3] == ramp[:, 40:]).all()


def test_mattes_of_some_photographs_only_are_refused_before_anything_is_matched(tmp_path, rng):
    from PIL import Image

    (tmp_path / "out").mkdir()
    pictures(tmp_path, rng, 2)
    Image.new("RGBA", (320, 240), (0, 0, 0, 255)).save(tmp_path / "screenshot.png")
    _copies(tmp_path, tmp_path / "out", 1000, (1.0, 1.0, 1.0), Log(None))  # hides nothing: no matte
    Image.new("RGBA", (320, 240), (0, 0, 0, 0)).save(tmp_path / "cut_out.png")
    with pytest.raises(ValueError, match=r"0\.jpg has no alpha channel, but cut_out\.png"):
        _copies(tmp_path, tmp_path / "out", 1000, (1.0, 1.0, 1.0), Log(None))


def seen(R: np.ndarray, t: np.ndarray, points: np.ndarray, f: float) -> np.ndarray:
    local = points @ R.T + t
    return f * local[:, :2] / local[:, 2:]


@pytest.mark.parametrize("kind", ["stands", "turns", "zooms", "thing moves"])
def test_a_camera_in_one_place_explains_its_pictures_and_one_that_moves_does_not(kind, rng):
    """A room 3 to 6 m deep by 800 px at f = 700; noise of 0.3 px. Of matches on a body that moves itself, a fifth."""
    from scipy.spatial.transform import Rotation

    points = rng.uniform([-1.5, -1, 3], [1.5, 1, 6], (200, 3))
    a = seen(np.eye(3), np.zeros(3), points, 700) + rng.normal(scale=0.3, size=(200, 2))

    def share(R, t, f, moved=points):
        return explained(a, seen(R, t, moved, f) + rng.normal(scale=0.3, size=(200, 2)), 800)

    turn = Rotation.from_rotvec([0.05, 0.2, 0.1]).as_matrix()
    still = {
        "stands": lambda: share(np.eye(3), np.zeros(3), 700),
        "turns": lambda: share(turn, np.zeros(3), 700),
        "zooms": lambda: share(turn, np.zeros(3), 900),
        "thing moves": lambda: share(
            np.eye(3), np.zeros(3), 700, points + [0.1, 0, 0] * (np.arange(200) < 40)[:, None]
        ),
    }
    # the noise of two pictures, 0.4 px and more with the zoom, reaches beyond 1.6 px (a five-hundredth of 800) once in
    # a thousand, and a fit to 200 matches is a little off; a fifth moves
    assert still[kind]() > (0.7 if kind == "thing moves" else 0.85)
    # a step of 30 cm sideways, seen at 3 to 6 m: 70 to 35 px, of which a turn takes the mean
    assert share(turn, np.array([0.3, 0, 0]), 700) < 0.25


def test_all_pairs_are_compared_or_of_a_video_near_and_doubling_ones():
    names = [f"{i:03d}" for i in range(40)]
    assert len(set(pairs(names, ordered=False))) == 40 * 39 // 2
    steps = {int(b) - int(a) for a, b in pairs(names, ordered=True)}
    assert steps == {*range(1, 11), 16, 32}


@pytest.mark.parametrize("works_at, tried", [(16, [16]), (4, [16, 8, 4]), (0, [16, 8, 4, 2])])
def test_smaller_angles_are_tried_before_giving_up(works_at, tried, tmp_path):
    """With a stand-in for pycolmap that places photographs from one angle down: COLMAP itself lowers the angle for the
    scenes that could be made here, but not for all."""
    from types import SimpleNamespace

    from physics3d.scenes.sfm import _placed

    asked = []

    def incremental_mapping(database, images, folder, options, next_image_callback):
        asked.append(options.mapper.init_min_tri_angle)
        next_image_callback()
        return {0: SimpleNamespace(num_reg_images=lambda: 9)} if asked[-1] <= works_at else {}

    def options():
        return SimpleNamespace(mapper=SimpleNamespace(), triangulation=SimpleNamespace())

    library = SimpleNamespace(IncrementalPipelineOptions=options, incremental_mapping=incremental_mapping)
    model, angle = _placed(library, tmp_path / "a.db", tmp_path, tmp_path / "models", ["x"] * 10, 0, Log(None))
    assert asked == tried and (model is None) == (works_at == 0)
    assert model is None or angle == tried[-1]


def test_a_model_that_misses_a_clip_is_not_the_last_word(tmp_path):
    """With a stand-in for pycolmap whose larger model, from the first angle, has no place for the picture of a clip."""
    from types import SimpleNamespace

    from physics3d.scenes.sfm import _placed

    def model(*names):
        images = {i: SimpleNamespace(name=name, has_pose=True) for i, name in enumerate(names)}
        return SimpleNamespace(images=images, num_reg_images=lambda: len(images))

    made = {16: [model(*"abcdefgh")], 8: [model("a", "b"), model(*"abcdef", "clip")], 4: [], 2: []}

    def incremental_mapping(database, images, folder, options, next_image_callback):
        return dict(enumerate(made[options.mapper.init_min_tri_angle]))

    def options():
        return SimpleNamespace(mapper=SimpleNamespace(), triangulation=SimpleNamespace())

    library = SimpleNamespace(IncrementalPipelineOptions=options, incremental_mapping=incremental_mapping)
    names = [*"abcdefgh", "clip"]
    place = lambda **asked: _placed(
        library, tmp_path / "a.db", tmp_path, tmp_path / "models", names, 0, Log(None), **asked
    )
    assert place() == (made[16][0], 16)
    assert place(needed={"clip"}) == (made[8][1], 8)


def test_no_more_features_are_held_than_said(tmp_path, rng, monkeypatch):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    from physics3d.scenes import sfm

    (tmp_path / "images").mkdir()
    pictures(tmp_path / "images", rng, 2)
    monkeypatch.setattr(sfm, "FEATURES", 200)
    sfm._extract(pycolmap, tmp_path / "a.db", tmp_path / "images", ["0.jpg", "1.jpg"], Log(None))
    database = pycolmap.Database.open(tmp_path / "a.db")
    for image in database.read_all_images():
        assert len(database.read_keypoints(image.image_id)) == 200
        assert database.num_descriptors_for_image(image.image_id) == 200
    database.close()


def test_pictures_can_be_written_after_pycolmap_was_loaded(tmp_path):
    """Its compression library must not become Pillow's, whichever is asked for first."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    import subprocess

    code = (
        "from physics3d.scenes.sfm import _pycolmap; _pycolmap(); from PIL import Image; import numpy as np;"
        "noise = np.random.default_rng(0).integers(0, 255, (240, 360, 3), np.uint8);"
        f"Image.fromarray(noise).save({str(tmp_path / 'a.png')!r})"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, capture_output=True)


@pytest.mark.data
@pytest.mark.parametrize("name", ["telephone", "carnation"])
def test_a_real_video_of_a_fixed_camera_is_refused(name, data):
    """Someone pokes the thing, the camera stands on a tripod."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    video = data / name / "videos" / "real_take0.mp4"
    if not video.is_file():
        pytest.skip(f"no {video}")
    source = UnposedSource(name="x", path=str(video), camera_distance=0.5, longest_side=480, frames=6)
    with pytest.raises(ValueError, match="the camera must move"):
        source(log=Log(None))


@pytest.mark.data
def test_cameras_of_real_photographs_are_found_again(data, tmp_path):
    """Ten neighbouring photographs of the plush toy at 640 px against the poses that came with them, after the best
    similarity. 1.5 degrees and 1.5 % of the path's radius at worst were measured (0.7 and 0.8 % at 800 px); twice that
    is for other threads. The known poses are COLMAP's as well."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    if not (data / "plush").is_dir():
        pytest.skip(f"no plush in {data}")
    known = TransformsSource(name="plush", path=str(data / "plush"), up=(0, 0, 1), scale=1.0)(log=Log(None))
    pose = {Path(name).name: camera.world_to_camera.numpy() for name, camera in zip(known.names, known.cameras)}
    for name in sorted(pose)[:20:2]:
        shutil.copy(data / "plush" / "images" / name, tmp_path / name)
    capture = UnposedSource(name="x", path=str(tmp_path), camera_distance=0.5, longest_side=640)(log=Log(None))
    assert len(capture.images) >= 8 and capture.points is not None and len(capture.points) > 100
    assert "0.5 m" in capture.note
    ours = np.stack([c.world_to_camera.numpy() for c in capture.cameras])
    theirs = np.stack([pose[name] for name in capture.names])
    a, b = (-np.einsum("nji,nj->ni", M[:, :3, :3], M[:, :3, 3]) for M in (ours, theirs))
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, S, Vh = np.linalg.svd(b0.T @ a0)  # Umeyama (1991)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vh))])
    Q, scale = (U * sign) @ Vh, (S * sign).sum() / (a0**2).sum()
    centre = np.linalg.norm(scale * a0 @ Q.T - b0, axis=1) / np.linalg.norm(b0, axis=1).max()
    turn = ours[:, :3, :3] @ Q.T @ theirs[:, :3, :3].transpose(0, 2, 1)
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    print(
        f"rotation {np.median(angle):.2f}, at worst {angle.max():.2f} degrees; centre {centre.max():.4f} of the radius"
    )
    assert angle.max() < 2 and centre.max() < 0.03
    # upright and to scale: cameras are above what they look at, and half a metre away in the middle
    assert (a[:, 2] > 0).all()


@pytest.mark.parametrize("lost, said", [("frame_0.jpg", True), ("frame_2.jpg", False)])
def test_that_numbers_of_photographs_have_moved_is_said(lost, said, tmp_path):
    """Who prompts in `view: 0` means the first that was handed over."""
    placed = tuple(f"photographs/frame_{i}.jpg" for i in range(3) if f"frame_{i}.jpg" != lost)
    solved = Solved(folder=tmp_path, placed=placed, lost=(f"photographs/{lost}",), error=0.5, span=90.0, floor=True)
    report(solved, 0.5, Log(tmp_path, quiet=True))
    lines = (tmp_path / "log.txt").read_text()
    assert f"left out: {lost}" in lines
    assert ("photograph 0 is frame_1.jpg now" in lines) == said
