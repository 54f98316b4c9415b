"""A thing at rest in photographs and moving in clips: cameras of clips are found, what cannot be used is named."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from clips import FPS, decaying, encode, swaying, texture
from jaxtyping import Float, Float32, UInt8
from PIL import Image
from torch import Tensor

from physics3d.log import Log
from physics3d.motion.decay import Decay
from physics3d.scenes import sfm
from physics3d.scenes.base import Capture, Take
from physics3d.scenes.carnation import TARGET
from physics3d.scenes.clips import FilmedTake
from physics3d.scenes.flower import plant, surroundings
from physics3d.scenes.handed_over import hand_over
from physics3d.scenes.lens import Lens
from physics3d.scenes.room import wood
from physics3d.scenes.studio import Light, Studio, photographs, ring
from physics3d.scenes.thing import ThingSource, _straightened
from physics3d.video import write_mp4

VIEWS, STEP = 9, 10.0  # photographs, and the angle between neighbours [deg]
FRAMES = 36


def poked(still: UInt8[Tensor, "h w 3"]) -> UInt8[Tensor, "t h w 3"]:
    """The carnation of a picture sways sideways, ever more towards its top; pot and table stand still."""
    import cv2

    h, w = still.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    how_much = np.clip((0.6 * h - y) / (0.4 * h), 0, 1) ** 2 * np.clip(2 - np.abs(x - w / 2) / (0.13 * w), 0, 1)
    shift = decaying(np.arange(FRAMES) / FPS, frequency=2.5, damping=1.5, amplitude=9)
    frames = [cv2.remap(still.numpy(), x - s * how_much, y, cv2.INTER_CUBIC) for s in shift.astype(np.float32)]
    return torch.from_numpy(np.stack(frames))


def newspaper(point: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Blocks of 16, 8 and 4 mm in random greys, as a factor: the twin's wood is too plain for few small photographs."""
    grey = np.random.default_rng(0).uniform(-1, 1, (3, 64, 64))
    tone = np.zeros(len(point))
    for layer, size in zip(grey, (0.016, 0.008, 0.004)):
        i, j = (np.floor(point[:, :2] / size).astype(int) % 64).T
        tone += layer[i, j]
    return np.repeat((0.5 + 0.3 * np.tanh(tone))[:, None], 3, 1).astype(np.float32)


@pytest.fixture(scope="module")
def handed(tmp_path_factory) -> Path:
    """The carnation twin on disk: photographs around its front, two clips by another lens from two places."""
    meshes, _ = plant(0)
    around = [replace(mesh, paint=newspaper) if mesh.paint is wood else mesh for mesh in surroundings(0)]
    studio = Studio([*meshes, *around], Light(backdrop=(0.80, 0.83, 0.86)), openness_rays=4, seed=0)

    def seen_from(azimuth, elevation, **how):
        return ring(TARGET, azimuths=[azimuth], elevation=elevation, **how)[0]

    phone = {"distance": 0.5, "width": 320, "height": 240, "opening": 44}
    cameras = [seen_from(-140 + STEP * i, (16, 32)[i % 2], **phone) for i in range(VIEWS)]
    film = {"distance": 0.42, "width": 400, "height": 224, "opening": 58}
    stands = [seen_from(azimuth, 22, **film) for azimuth in (-103.0, -94.0)]
    images, *_ = photographs(studio.pose(), [*cameras, *stands], points=12, noise=0, seed=0, log=Log(None))
    takes = [
        Take(name=role, role=role, fps=FPS, cameras=(camera,), videos=(poked(image),))
        for role, camera, image in zip(("learn", "evaluate"), stands, images[-2:])
    ]
    capture = Capture(
        name="thing",
        images=tuple(images[:-2]),
        cameras=tuple(cameras),
        names=tuple(f"{i}" for i in range(len(cameras))),
        takes=tuple(takes),
    )
    folder = tmp_path_factory.mktemp("thing") / "twin"
    hand_over(capture, folder, density=300.0)
    return folder


def rigid(found: np.ndarray, true: np.ndarray, reach: float) -> tuple[float, np.ndarray, np.ndarray]:
    """s, Q, t with true = s Q found + t, of cameras [n, 4, 4]: by their centres, and points `reach` [m] ahead of them.

    Centres alone lie nearly on a curve, and leave a turn about it open. Umeyama (1991).
    """

    def points(M):
        centre = -np.einsum("nji,nj->ni", M[:, :3, :3], M[:, :3, 3])
        return np.concatenate([centre, centre + reach * M[:, 2, :3]])

    a, b = points(found), points(true)
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, S, Vh = np.linalg.svd(b0.T @ a0)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vh))])
    Q, s = (U * sign) @ Vh, float((S * sign).sum() / (a0**2).sum())
    return s, Q, b.mean(0) - s * Q @ a.mean(0)


def test_the_same_files_give_the_same_cameras_to_the_last_bit(handed, tmp_path):
    """Threads that number pictures as they are finished, or sum in another order, gave another lens each time."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    source = ThingSource(name="thing", path=str(handed / "thing"), camera_distance=0.5)
    one, other = (source(log=Log(tmp_path / f"log{i}", quiet=True)) for i in range(2))
    for a, b in zip(
        [*one.cameras, *(t.cameras[0] for t in one.takes)], [*other.cameras, *(t.cameras[0] for t in other.takes)]
    ):
        assert (a.fx, a.fy, a.cx, a.cy) == (b.fx, b.fy, b.cx, b.cy)
        assert torch.equal(a.world_to_camera, b.world_to_camera)
    assert torch.equal(one.points, other.points)


def test_a_walk_that_comes_by_again_is_joined_where_it_does(handed, tmp_path, monkeypatch):
    """Of a video each frame is compared with those that follow. The first one here looks from the side to which the
    walk comes back last, 50 degrees from the next."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    monkeypatch.setattr(sfm, "NEIGHBOURS", 1)  # of nine frames, as ten are of sixty
    images = tmp_path / "images"
    images.mkdir()
    for number, view in enumerate((0, 5, 6, 7, 8, 4, 3, 2, 1)):
        shutil.copy(handed / "thing" / f"IMG_{view + 1:04d}.jpg", images / f"frame_{number}.jpg")
    solved = sfm.solve(images, tmp_path, ordered=True, camera_distance=0.5, seed=0, log=Log(tmp_path, quiet=True))
    assert solved.lost == () and len(solved.placed) == VIEWS
    assert "photographs are not placed: comparing them with all others" in (tmp_path / "log.txt").read_text()


def test_cameras_of_the_clips_are_found_among_those_of_the_photographs(handed, tmp_path):
    """Measured: centres to 0.3 % of their distance, axes to 0.1 degrees, a lens to 0.5 to 2 %; few photographs leave it
    open, and the rest is for other processors."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    thing = tmp_path / "thing"
    shutil.copytree(handed / "thing", thing)
    shutil.copy(thing / "IMG_0001.jpg", thing / "clips" / "cover.jpg")  # is no photograph of the thing
    log = Log(tmp_path / "log", quiet=True)
    source = ThingSource(name="thing", path=str(thing), camera_distance=0.5, held_out_every=4)
    capture = source(log=log)

    truth = yaml.safe_load((handed / "truth.yaml").read_text())
    photographs = truth["photographs"]
    assert capture.names == tuple(photographs) and capture.held_out == (0, 4, 8)
    listed = [*photographs, *(f"clips/{clip}" for clip in truth["clips"])]
    assert source.files() == tuple(str(thing / name) for name in listed)

    found = np.stack([c.world_to_camera.numpy() for c in capture.cameras])
    s, Q, t = rigid(found, np.array([c["world_to_camera"] for c in photographs.values()]), 0.5)
    assert [(take.name, take.role) for take in capture.takes] == [("poke_1", "learn"), ("poke_2", "evaluate")]
    for take, clip in zip(capture.takes, truth["clips"].values()):
        camera, pose = take.cameras[0], np.array(clip["camera"]["world_to_camera"])
        centre = -pose[:3, :3].T @ pose[:3, 3]
        off = np.linalg.norm(s * Q @ camera.centre.numpy() + t - centre) / np.linalg.norm(centre - TARGET)
        angle = np.degrees(np.arccos(pose[2, :3] @ Q @ camera.world_to_camera[2, :3].numpy()))
        print(f"{take.name}: centre {off:.4f} of its distance, axis {angle:.2f} degrees, f {camera.fx:.1f} px")
        assert off < 0.02 and angle < 1
        assert camera.fx == pytest.approx(clip["camera"]["fx"], rel=0.05)
        assert take.excitation is None and take.fps == FPS and take.videos[0].shape == (FRAMES, 224, 400, 3)

    said = (tmp_path / "log" / "log.txt").read_text()
    for clip in truth["clips"]:
        (error,) = re.findall(rf"{clip}: camera found by \d+ points, reprojection error (\S+) px of 400 x 224", said)
        assert 0 < float(error) < 1  # as for the photographs, and what still moves


def test_a_clip_of_something_else_is_named_before_photographs_are_compared(handed, tmp_path):
    pytest.importorskip("pycolmap", reason="pycolmap, the extra 'sfm', is not installed")
    thing = tmp_path / "thing"
    shutil.copytree(handed / "thing", thing)
    write_mp4(thing / "clips" / "poke_2.mp4", swaying(decaying(np.arange(FRAMES) / FPS), h=224, w=320), FPS)
    with pytest.raises(ValueError, match=r"poke_2\.mp4: its camera cannot be found, not one photograph") as refused:
        ThingSource(name="thing", path=str(thing), camera_distance=0.5)(log=Log(tmp_path / "log", quiet=True))
    assert "\n" not in str(refused.value) and not (tmp_path / "log" / "metrics.jsonl").exists()


def still(folder: Path) -> None:
    write_mp4(folder / "clips" / "a.mp4", swaying(np.zeros(FRAMES)), FPS)


def shaken(folder: Path) -> None:
    video = swaying(decaying(np.arange(FRAMES) / FPS), camera=1.0)
    write_mp4(folder / "clips" / "a.mp4", video, FPS)


def cut(folder: Path) -> None:
    video = swaying(decaying(np.arange(FRAMES) / FPS))
    video[20:] = 255 - video[20:]
    write_mp4(folder / "clips" / "a.mp4", video, FPS)


def emptied(folder: Path) -> None:
    for clip in (folder / "clips").iterdir():
        clip.unlink()


WRONG = {
    "no folder": (shutil.rmtree, "no folder at .*; give one"),
    "no clips": (lambda folder: shutil.rmtree(folder / "clips"), "has no subfolder clips"),
    "an empty folder of clips": (emptied, "clips holds no clip"),
    "two clips of one name": (
        lambda folder: shutil.copy(folder / "clips" / "a.mp4", folder / "clips" / "a.mov"),
        "whose takes would have one name",
    ),
    "clips beside the photographs": (
        lambda folder: shutil.copy(folder / "clips" / "a.mp4", folder / "poke.mp4"),
        r"holds photographs and videos \(poke.mp4\)",
    ),
    "two videos around it": (
        lambda folder: [
            *(p.unlink() for p in folder.glob("*.jpg")),
            *(shutil.copy(folder / "clips" / "a.mp4", folder / f"{n}.mp4") for n in range(2)),
        ],
        r"holds 2 videos \(0.mp4, 1.mp4\)",
    ),
    "no photographs": (
        lambda folder: [
            *(p.unlink() for p in folder.glob("*.jpg")),
            (folder / "clips" / "cover.jpg").write_bytes(b"x"),
        ],
        "holds no photographs .*, but nothing",
    ),
    "a clip without motion": (still, r"a\.mp4: nothing moves"),
    "a camera that moves": (shaken, r"a\.mp4: the camera moves"),
    "a cut": (cut, r"a\.mp4: there is a cut before frame 20"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_what_cannot_be_used_is_named_in_one_line(kind, tmp_path, rng):
    spoil, message = WRONG[kind]
    folder = tmp_path / "thing"
    (folder / "clips").mkdir(parents=True)
    for i in range(3):
        Image.fromarray(rng.integers(0, 255, (64, 96, 3), np.uint8)).save(folder / f"{i}.jpg")
    write_mp4(folder / "clips" / "a.mp4", swaying(decaying(np.arange(FRAMES) / FPS)), FPS)
    spoil(folder)
    with pytest.raises(ValueError, match=message) as refused:
        ThingSource(name="thing", path=str(folder), camera_distance=0.5)(log=Log(None))
    assert "\n" not in str(refused.value)


def test_a_video_around_the_thing_takes_the_place_of_photographs(tmp_path):
    (tmp_path / "clips").mkdir()
    for name in ("around.mov", "clips/poke.mp4", "._around.mov"):
        (tmp_path / name).write_bytes(b"x")
    source = ThingSource(name="thing", path=str(tmp_path), camera_distance=0.5)
    assert source.files() == (str(tmp_path / "around.mov"), str(tmp_path / "clips" / "poke.mp4"))


@pytest.mark.parametrize("rest", [0, 11, FRAMES - 1])
def test_the_frame_of_rest_is_what_is_placed(rest, tmp_path):
    """Grey tells the number of a frame; the picture is as large as photographs are, more than what is learned from."""
    levels = 20 + 5 * torch.arange(FRAMES, dtype=torch.uint8)
    encode(levels[:, None, None, None].expand(-1, 450, 800, 3), tmp_path / "a.mp4")
    take = FilmedTake(
        name="a", role="learn", fps=FPS, video=torch.zeros(FRAMES, 4, 4, 3, dtype=torch.uint8),
        where=np.zeros((4, 4), bool), release=0, rest=rest,
        decay=Decay(
            start=0.0, end=1.0, frequency=np.zeros(0), damping=np.zeros(0), frequency_error=np.zeros(0),
            damping_error=np.zeros(0), constant=np.zeros(1), cosine=np.zeros((0, 1)), sine=np.zeros((0, 1)),
            linear_error=np.zeros((0, 1)), residual=0.0, explained=0.0,
        ),
    )  # fmt: skip
    source = ThingSource(name="thing", path=str(tmp_path), camera_distance=0.5, longest_side=720)
    (tmp_path / "clips").mkdir()
    assert dict(source._stills(tmp_path / "clips", [tmp_path / "a.mp4"], [take])) == {"clips/000.png": "a.mp4"}
    with Image.open(tmp_path / "clips" / "000.png") as picture:
        assert picture.size == (720, 405)
        # H.264 and video range cost a level or two
        assert np.asarray(picture).mean() == pytest.approx(float(levels[rest]), abs=2)


def test_distortion_is_taken_out_of_the_frames(rng):
    """A pixel of the pinhole shows what the lens shows where that direction falls; the texture is known everywhere."""
    lens = Lens(width=160, height=120, fx=120.0, fy=120.0, cx=80.0, cy=60.0, radial=(0.15,))
    y, x = np.mgrid[:120, :160].astype(float)
    video = torch.from_numpy((255 * texture(x, y, 3) + 0.5).astype(np.uint8))[None, ..., None].expand(2, -1, -1, 3)
    straight = _straightened(video, lens, "a.mp4")
    pinhole = lens.pinhole("a.mp4")
    rays = np.stack([(x + 0.5 - pinhole.cx) / pinhole.fx, (y + 0.5 - pinhole.cy) / pinhole.fy], -1)
    u, v = np.moveaxis(lens.pixels(rays) - 0.5, -1, 0)
    expected = 255 * texture(u, v, 3)
    assert np.abs(expected - video[0, ..., 0].numpy()).max() > 30, "nothing is bent"
    # bytes, and a cubic through waves of 6 px and more
    inner = np.abs(straight.numpy().astype(float) - expected[None, ..., None])[:, 3:-3, 3:-3]
    assert inner.mean() < 2 and inner.max() < 12
