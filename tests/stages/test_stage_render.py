"""The render stage says by how many pixels the body moves."""

import pytest
import torch
from small_scene import bar, cameras

from physics3d.log import Log
from physics3d.mpm.rollout import Trajectory
from physics3d.scenes.base import Capture
from stages.render import Render


@pytest.mark.parametrize(("sideways", "pixels"), [(0.05, 3.0), (0.01, 0.6)])
def test_motion_is_given_in_pixels_and_warned_about_below_one(sideways, pixels, tmp_path):
    """A shift s across the optical axis at depth z is f s/z in the picture."""
    gaussians, body = bar()
    (camera,) = cameras()
    capture = Capture(name="bar", images=(), cameras=(camera,), names=("view",), gaussians=gaussians)
    x = body.position[None] + torch.linspace(0, sideways, 3)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
    eye = torch.eye(3).expand(3, len(body.position), 3, 3).contiguous()
    shift = Trajectory(
        rest_position=body.position, position=x, deformation=eye, fps=10.0, health={}, substeps=1, substep_dt=0.1
    )
    Render(interior=False)(capture, gaussians, body, shift, log=Log(tmp_path, quiet=True))
    text = (tmp_path / "log.txt").read_text()
    line = next(line for line in text.splitlines() if "the body moves by up to" in line)
    said = float(line.split("up to ")[1].split()[0])
    # 60 px at 1 m; the bar's near side is 5 cm nearer, its camera looks 5 degrees down
    assert said == pytest.approx(pixels, rel=0.1)
    assert ("warning" in line) == (pixels < 1)
