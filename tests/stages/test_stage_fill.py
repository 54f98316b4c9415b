"""The stage around filling: what moves without a segmentation, its artifact and its picture."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import discs, joined, sphere

from physics3d.filling.body import Body
from physics3d.log import Log
from physics3d.scenes.base import Capture
from physics3d.segmentation import Segmentation
from stages.fill import Fill


def bare(gaussians) -> Capture:
    """A trained model without photographs."""
    return Capture(name="two balls", images=(), cameras=(), names=(), gaussians=gaussians)


@pytest.fixture(scope="module")
def two_balls():
    rng = np.random.default_rng(0)
    a, b = (discs(*sphere(3000, 0.04, rng), rng, sigma=0.002) for _ in "ab")
    return joined(a, replace(b, mean=b.mean + torch.tensor([0.15, 0.0, 0.0])))


def test_what_is_segmented_moves_and_the_body_survives_storage(two_balls, tmp_path):
    label = torch.cat([torch.zeros(3000), torch.ones(3000)]).to(torch.int32)
    segmentation = Segmentation(label=label, parts=("ball",), masks=None, mask_views=())
    body = Fill(spacing=0.008)(bare(two_balls), two_balls, segmentation, log=Log(tmp_path, quiet=True))
    assert float(body.position[:, 0].min()) > 0.1
    # coarser than in test_filling: five cells to the radius
    assert float(body.volume.sum()) == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.04)
    assert (tmp_path / "previews/slices.png").is_file()
    body.save(tmp_path / "artifact")
    again = Body.load(tmp_path / "artifact")
    assert torch.equal(again.position, body.position) and torch.equal(again.embedding.which, body.embedding.which)


def test_without_segmentation_everything_visible_moves(two_balls):
    logit = two_balls.opacity_logit.clone()
    logit[:10], logit[10:20] = -8.0, -3.0  # never drawn; drawn faintly
    body = Fill(spacing=0.008)(bare(two_balls), replace(two_balls, opacity_logit=logit), None, log=Log(None))
    assert body.embedding.which.tolist() == list(range(10, 6000))


def test_labels_of_another_reconstruction_are_refused(two_balls):
    other = Segmentation(label=torch.ones(5).int(), parts=("ball",), masks=None, mask_views=())
    with pytest.raises(ValueError, match="5 labels for 6000 Gaussians"):
        Fill(spacing=0.008)(bare(two_balls), two_balls, other, log=Log(None))


def test_attach_is_auto_or_none(two_balls):
    with pytest.raises(ValueError, match=r"fill.attach is 'glue'; take one of auto, none"):
        Fill(spacing=0.008, attach="glue")(bare(two_balls), two_balls, None, log=Log(None))
