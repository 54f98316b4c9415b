"""From prompts to labels, end to end, on two balls that stand on a table."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import cameras_around, captured, spheres_on_table

from physics3d.log import Log
from physics3d.scenes.base import Capture
from physics3d.segmentation import Segmentation
from physics3d.segmentation.prompts import Prompt
from stages.segment import Segment

RED, GREEN = (-0.06, 0.0, 0.0), (0.06, 0.0, -0.01)


@pytest.fixture(scope="module")
def scene():
    gaussians, truth, _ = spheres_on_table(np.random.default_rng(0))
    cameras = cameras_around(10, 0.4)
    return captured(gaussians, cameras), gaussians, truth


def at(capture, view, point):
    camera = capture.cameras[view]
    uv, _ = camera.project(torch.tensor([point], dtype=torch.float64))
    return float(uv[0, 0] / camera.width), float(uv[0, 1] / camera.height)


def around(capture, view, point, reach):
    (u, v), camera = at(capture, view, point), capture.cameras[view]
    size = reach * camera.fx / float((torch.tensor(point).double() - camera.centre).norm())
    du, dv = size / camera.width, size / camera.height
    return max(0.0, u - du), max(0.0, v - dv), min(1.0, u + du), min(1.0, v + dv)


def overlap(label, truth, k, gaussians):
    # the underside is seen by no camera: there the truth is nobody's to find
    seen = gaussians.mean[:, 2] > -0.038
    found, true = (label == k) & seen, (truth == k) & seen
    return float((found & true).sum() / (found | true).sum())


CASES = {
    "box": lambda c: [Prompt(part="red", view=2, box=around(c, 2, RED, 0.058))],
    "points": lambda c: [
        Prompt(part="red", view="view_02.png", positive=(at(c, 2, RED),), negative=(at(c, 2, GREEN),))
    ],
    "box in space": lambda c: [Prompt(part="red", lower=(-0.12, -0.06, -0.045), upper=(0.0, 0.06, 0.06))],
    "two parts": lambda c: [
        Prompt(part="red", view=2, box=around(c, 2, RED, 0.058)),
        Prompt(part="green", view=2, box=around(c, 2, GREEN, 0.047)),
    ],
}


@pytest.mark.parametrize("name", CASES)
def test_prompted_parts_are_found(name, scene, tmp_path):
    capture, gaussians, truth = scene
    found = Segment(prompts=tuple(CASES[name](capture)), views=8)(capture, gaussians, log=Log(tmp_path, quiet=True))
    found.check()
    for k, part in enumerate(found.parts, 1):
        assert overlap(found.label, truth, k, gaussians) > 0.95, part
    assert found.masks.shape == (8, 120, 160) and len(found.mask_views) == 8
    assert {p.name for p in (tmp_path / "previews").iterdir()} == {"masks.png", "moving.png", "static.png"}
    found.save(tmp_path / "artifact")
    assert torch.equal(Segmentation.load(tmp_path / "artifact").label, found.label)


def test_mattes_are_the_masks(scene):
    capture, gaussians, truth = scene
    matted = captured(gaussians, capture.cameras, mattes_of=gaussians.select(truth > 0))
    # the matte does not know the table, which hides nothing here but is hidden below the balls
    found = Segment()(matted, gaussians, log=Log(None))
    assert found.parts == ("body",)
    assert overlap(found.label, (truth > 0).long(), 1, gaussians) > 0.95


def test_without_photographs_a_box_in_space_selects(scene):
    _, gaussians, truth = scene
    capture = Capture(name="ply", images=(), cameras=(), names=(), gaussians=gaussians)
    prompt = Prompt(part="red", lower=(-0.12, -0.06, -0.045), upper=(0.0, 0.06, 0.06))
    found = Segment(prompts=(prompt,))(capture, gaussians, log=Log(None))
    assert torch.equal(found.label, ((truth == 1) & (gaussians.mean[:, 2] >= -0.045)).to(torch.int32))
    assert found.masks is None
    with pytest.raises(ValueError, match="needs a box in space"):
        Segment(prompts=(Prompt(box=(0, 0, 1, 1)),))(capture, gaussians, log=Log(None))


def test_nonsense_is_refused_with_a_remedy(scene):
    capture, gaussians, _ = scene
    run = lambda *prompts, **options: Segment(prompts=prompts, **options)(capture, gaussians, log=Log(None))
    with pytest.raises(ValueError, match=r"segment.prompts is empty"):
        run()
    with pytest.raises(ValueError, match=r"mask of 'body' in view view_00.png is empty for box .*move the prompt"):
        run(Prompt(box=(0.0, 0.0, 0.01, 0.01)))
    with pytest.raises(ValueError, match=r"view 'nowhere.png' is not in analytic; .* view_00.png"):
        run(Prompt(view="nowhere.png", box=(0.1, 0.1, 0.5, 0.5)))
    with pytest.raises(ValueError, match=r"positive\.0\.1 is 1\.5; take a number >= 0 and <= 1"):
        run(Prompt(positive=((0.5, 1.5),)))
    with pytest.raises(ValueError, match="in several views"):
        run(Prompt(view=0, box=(0.1, 0.1, 0.5, 0.5)), Prompt(view=1, box=(0.1, 0.1, 0.5, 0.5)))
    with pytest.raises(ValueError, match=r"masks of 'body' are empty"):
        run(Prompt(lower=(1, 1, 1), upper=(2, 2, 2)))
    with pytest.raises(ValueError, match=r"segment.views is 0"):
        run(Prompt(box=(0.1, 0.1, 0.5, 0.5)), views=0)
    with pytest.raises(ValueError, match="no Gaussian may move"):
        replace(Segmentation(label=torch.zeros(3).int(), parts=("a",), masks=None, mask_views=())).check()
