"""LoadCapture returns what its source gave, and leaves pictures of it."""

import json

import numpy as np
import pytest
import torch
from clips import FPS, decaying, encode, swaying, swinging_rod
from PIL import Image

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.log import Log
from physics3d.scenes.base import AbstractSource, Capture, Take
from physics3d.scenes.clips import filmed_takes, require_same_view
from physics3d.video import read_mp4
from stages.capture import LoadCapture


class Fixed(AbstractSource):
    """A source that gives the capture it was made with."""

    def __init__(self, capture: Capture):
        self.capture = capture

    def files(self):
        return ()

    def __call__(self, *, log) -> Capture:
        return self.capture


def small(width: int, height: int) -> Camera:
    view = look_at(torch.tensor([1.0, 0, 0]), torch.zeros(3))
    return Camera(width=width, height=height, fx=20, fy=20, cx=width / 2, cy=height / 2, world_to_camera=view)


def test_previews_and_counts_of_views_and_takes_are_kept(tmp_path):
    cameras = (small(32, 24), small(16, 12), small(32, 24))
    images = tuple(torch.full((c.height, c.width, 3), 60 * i, dtype=torch.uint8) for i, c in enumerate(cameras))
    video = torch.arange(5, dtype=torch.uint8)[:, None, None, None].expand(5, 24, 32, 3).contiguous() * 40
    take = Take(name="poke", role="learn", fps=25.0, cameras=cameras[:1], videos=(video,))
    capture = Capture(
        name="small", images=images, cameras=cameras, names=("a", "b", "c"), held_out=(1,), takes=(take,), note="hello"
    )
    log = Log(tmp_path, quiet=True)
    assert LoadCapture(source=Fixed(capture))(log=log) is capture
    assert Image.open(tmp_path / "previews/views.png").size == (3 * 16, 12)  # sizes differ: the smallest for all
    assert Image.open(tmp_path / "previews/take_poke.png").size == (5 * 32, 24)
    frames, fps = read_mp4(tmp_path / "previews/take_poke.mp4")
    assert frames.shape == (5, 24, 32, 3) and fps == 25.0
    numbers = {row["name"]: row["value"] for row in map(json.loads, (tmp_path / "metrics.jsonl").open())}
    assert numbers == {"views": 2, "views_held_out": 1, "points": 0}
    assert "hello" in (tmp_path / "log.txt").read_text()


def test_a_picture_of_another_shape_has_the_whole_photograph_in_its_middle():
    """What the photograph's corners see lies on two edges of the new picture, as far from its middle on either side."""
    camera = small(32, 24)
    corners = torch.tensor([[0.0, 0.0, 1.0], [32.0, 24.0, 1.0]], dtype=torch.float64)
    K = torch.tensor([[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    M = camera.world_to_camera.double()
    world = ((torch.linalg.inv(K) @ corners.T) - M[:3, 3:]).T @ M[:3, :3]
    for width, height, low, high in (
        (64, 24, (16, 0), (48, 24)),
        (32, 48, (0, 12), (32, 36)),
        (64, 48, (0, 0), (64, 48)),
    ):
        framed = camera.framed(width, height)
        assert (framed.width, framed.height) == (width, height)
        seen, depth = framed.project(world)
        # float32 extrinsics
        torch.testing.assert_close(seen, torch.tensor([low, high], dtype=seen.dtype), rtol=0, atol=1e-4)
        assert bool((depth > 0).all())


def test_a_clip_made_of_the_scene_is_a_take_of_its_camera(tmp_path):
    """In the place of the takes of the scene; nobody knows what pushed it."""
    path = tmp_path / "made.mp4"
    encode(swinging_rod(decaying(np.arange(90) / FPS, 2.0, 0.8, 11.0)), path)
    image, camera = torch.zeros((24, 32, 3), dtype=torch.uint8), small(32, 24)
    old = Take(name="old", role="learn", fps=25.0, cameras=(camera,), videos=(image.expand(5, -1, -1, -1),))
    scene = Capture(name="scene", images=(image,) * 2, cameras=(small(16, 12), camera), names=("a", "b"), takes=(old,))
    scene = Capture(**{**vars(scene), "images": (image[:12, :16], image)})
    stage = LoadCapture(source=Fixed(scene), clip=str(path), view="b")
    (take,) = stage(log=Log(None)).takes
    assert (take.name, take.role, take.fps, take.excitation, take.at_rest) == ("made", "learn", FPS, None, True)
    h, w = take.videos[0].shape[1:3]
    assert (h, w) == (144, 192) and take.cameras[0] == camera.framed(w, h)
    assert take.cameras[0].fx == pytest.approx(20 * 192 / 32)
    assert stage.files() == (str(path),)


def test_a_clip_that_cannot_be_learned_from_is_refused(tmp_path):
    image = torch.zeros((24, 32, 3), dtype=torch.uint8)
    scene = Fixed(Capture(name="scene", images=(image,), cameras=(small(32, 24),), names=("a",)))
    encode(swinging_rod(np.zeros(60)), tmp_path / "still.mp4")
    for clip, view, word in (("still.mp4", None, "still.mp4"), ("none.mp4", None, "no clip at")):
        with pytest.raises(ValueError, match=word):
            LoadCapture(source=scene, clip=str(tmp_path / clip), view=view)(log=Log(None))


@pytest.mark.parametrize("more", [(0, 40), (30, 0)])
def test_a_clip_has_to_show_what_the_photograph_shows(tmp_path, more):
    """In its middle, whatever its shape, size and exposure; another thing, or the same one from aside, is refused."""
    h, w = 96 + more[0], 128 + more[1]
    film = swaying(decaying(np.arange(24) / FPS), h=h, w=w)
    top, left = more[0] // 2, more[1] // 2
    photograph = (0.6 * film[-1, top : top + 96, left : left + 128].float() + 30).byte()
    encode(film, tmp_path / "made.mp4")
    (take,) = filmed_takes(tmp_path / "made.mp4", log=Log(None))
    require_same_view(take, photograph, clip="made.mp4", key="render.view")
    require_same_view(take, photograph.repeat_interleave(2, 0).repeat_interleave(2, 1), clip="made.mp4", key="")
    for other in (photograph.roll(32, 1), swinging_rod(np.zeros(1))[0]):
        cameras = (small(128, 96), small(*other.shape[1::-1]))
        scene = Capture(name="scene", images=(photograph, other), cameras=cameras, names=("a", "b"))
        stage = LoadCapture(source=Fixed(scene), clip=str(tmp_path / "made.mp4"), view="b")
        with pytest.raises(ValueError, match=r"made\.mp4: it does not show what .* render\.view shows") as error:
            stage(log=Log(None))
        assert "\n" not in str(error.value)
