"""The render stage: a motion that nobody can see is said."""

import pytest
import torch
from small_scene import bar, cameras

from physics3d.log import Log
from physics3d.scenes.base import Capture, Outline
from physics3d.trajectory import Trajectory
from stages.render import Render


@pytest.mark.parametrize("pixels, seen", [(0.5, False), (2.0, True)])
def test_motion_below_a_pixel_is_said(tmp_path, pixels, seen):
    """The camera is 1 m away with a focal length of 60 px: sideways motion of d metres is about 60 d pixels."""
    gaussians, body = bar()
    (camera,) = cameras()
    away = camera.project(body.position.double())[1].min()  # the nearest particle moves most in the picture
    shift = torch.tensor([pixels * float(away) / camera.fx, 0.0, 0.0])
    position = torch.stack([body.position, body.position + shift])
    trajectory = Trajectory(
        rest_position=body.position,
        position=position,
        deformation=torch.eye(3).expand(2, len(body.position), 3, 3).contiguous(),
        fps=10.0,
        health={},
        substeps=1,
        substep_dt=0.1,
    )
    image = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    capture = Capture(name="bar", images=(image,), cameras=(camera,), names=("a",), gaussians=gaussians)
    Render(interior=False)(capture, gaussians, body, trajectory, log=Log(tmp_path, quiet=True))
    text, metrics = (tmp_path / "log.txt").read_text(), (tmp_path / "metrics.jsonl").read_text()
    assert ("nothing is seen to move" in text) != seen
    moved = next(line for line in metrics.splitlines() if "motion_px" in line)
    assert f'"value": {pixels:.3g}'[:11] in moved


def test_a_view_that_is_not_there_is_refused_unless_a_take_is_filmed():
    outline = Outline(name="bar", names=("a", "b"), takes=())
    for view, words in (("c", "the photographs are a, b"), (2, "views 0 to 1")):
        with pytest.raises(ValueError, match=words):
            Render(view=view).fits(outline)
    Render(view="b").fits(outline)
    Render(view="c").fits(Outline())
