"""The render stage: a motion that nobody can see is said, and one that leaves the picture."""

import pytest
import torch
from jaxtyping import Float
from small_scene import bar, cameras
from torch import Tensor

from physics3d.filling.body import Body
from physics3d.log import Log
from physics3d.scenes.base import Capture, Outline
from physics3d.trajectory import Trajectory
from stages.render import Render


def carried(body: Body, along: Float[Tensor, " t"]) -> Trajectory:
    """The body carried along x by so many metres in each frame."""
    position = body.position + along.to(body.position)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
    return Trajectory(
        rest_position=body.position,
        position=position,
        velocity=torch.zeros_like(position),
        deformation=torch.eye(3).expand(*position.shape[:2], 3, 3).contiguous(),
        fps=10.0,
        health={},
        substeps=1,
        substep_dt=0.1,
    )


@pytest.mark.parametrize("pixels, seen", [(0.5, False), (2.0, True)])
def test_motion_below_a_pixel_is_said(tmp_path, pixels, seen):
    """The camera is 1 m away with a focal length of 60 px: sideways motion of d metres is about 60 d pixels."""
    gaussians, body = bar()
    (camera,) = cameras()
    away = camera.project(body.position.double())[1].min()  # the nearest particle moves most in the picture
    trajectory = carried(body, torch.tensor([0.0, pixels * float(away) / camera.fx]))
    image = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    capture = Capture(name="bar", images=(image,), cameras=(camera,), names=("a",), gaussians=gaussians)
    Render(interior=False)(capture, gaussians, body, trajectory, log=Log(tmp_path, quiet=True))
    text, metrics = (tmp_path / "log.txt").read_text(), (tmp_path / "metrics.jsonl").read_text()
    assert ("nothing is seen to move" in text) != seen
    moved = next(line for line in metrics.splitlines() if "motion_px" in line)
    assert f'"value": {pixels:.3g}'[:11] in moved


def test_a_body_that_leaves_the_picture_is_said(tmp_path):
    """Carried by two widths of the picture it is out of it, whatever the distance of its particles."""
    _, body = bar()
    (camera,) = cameras()
    far = camera.project(body.position.double())[1].max()
    for widths, gone in ((0.0, 0), (2.0, 2)):
        folder = tmp_path / str(gone)
        motion = carried(body, torch.tensor([0.0, widths, widths]) * camera.width * float(far) / camera.fx)
        Render(interior=False).say_motion({"view": camera}, motion, Log(folder, quiet=True))
        said = f"in {gone} of 3 frames nothing of the body is in the picture of view"
        assert (said in (folder / "log.txt").read_text()) == bool(gone)


def test_a_view_that_is_not_there_is_refused_unless_a_take_is_filmed():
    outline = Outline(name="bar", names=("a", "b"), takes=())
    for view, words in (("c", "the photographs are a, b"), (2, "views 0 to 1")):
        with pytest.raises(ValueError, match=words):
            Render(view=view).fits(outline)
    Render(view="b").fits(outline)
    Render(view="c").fits(Outline())
