"""LoadCapture returns what its source gave, and leaves pictures of it."""

import json

import torch
from PIL import Image

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.log import Log
from physics3d.scenes.base import AbstractSource, Capture, Take
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
