"""Laws of attachment: a body is held where it touches what is static, and there only."""

from functools import cache

import numpy as np
import pytest
import torch
from analytic_bodies import annulus, discs, joined, together, wall
from fillings import SPACING, filled

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.attachment import within_outline
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout
from physics3d.scenes.base import Capture
from physics3d.segmentation import Segmentation
from physics3d.world import World
from stages.fill import Fill
from stages.simulate import Simulate


def stem_on_a_plate(*, speck=False):
    """A stem, 3 cm thick and 14 cm tall, on a static plate: Gaussians, labels. `speck`: some of its top is static."""
    rng = np.random.default_rng(0)
    side, top = wall(7000, 0.015, 0, 0.14, rng), annulus(800, 0, 0.015, 0.14, rng)
    stem = discs(*together(side, top), rng)
    plate = discs(*annulus(6000, 0.013, 0.12, 0, rng), rng, sigma=0.003)  # seen up to a little under the rim
    label = torch.cat([torch.ones(len(stem)), torch.zeros(len(plate))]).int()
    if speck:
        label[:200] = torch.where(stem.mean[:200, 2] > 0.1, 0, 1).int()
    return joined(stem, plate), label


@cache
def held_stem(speck: bool = False):
    """What is filled of it and held."""
    gaussians, label = stem_on_a_plate(speck=speck)
    return filled(gaussians, label=label, attach=True)


@pytest.mark.parametrize("speck", [False, True])
def test_a_body_is_held_where_it_touches_what_is_static(speck):
    """... and by nothing else: not by a few Gaussians of its own that the segmentation took for static."""
    gaussians, label = stem_on_a_plate(speck=speck)
    body = held_stem(speck)
    at = body.position[body.attached]
    assert len(at) >= 8
    assert float(at[:, 2].max()) < SPACING
    assert filled(gaussians, label=label).attached is None
    alone = filled(gaussians.select(label > 0), attach=True)
    assert not bool(alone.attached.any()) and alone.held == ()


@pytest.mark.parametrize("layers", [1, 2, 4])
@pytest.mark.parametrize("strays", [0, 2])
def test_what_touches_above_the_layer_does_not_raise_it(layers, strays):
    """A stem through a disc of soil, held at its rim by the pot; a crumb or two that touch the pot's edge above it."""
    side = np.arange(-6, 7)
    lattice = SPACING * np.stack(np.meshgrid(side, side, np.arange(layers + 8), indexing="ij"), -1).reshape(-1, 3)
    r, layer = np.linalg.norm(lattice[:, :2], axis=1) / SPACING, np.round(lattice[:, 2] / SPACING).astype(int)
    body = lattice[(r < 6) & (layer < layers) | (r < 2)]
    rim = lattice[(r > 4) & (r < 6) & (layer < layers)]
    crumbs = SPACING * np.array([[5.0, 0, layers + 0.6], [-5.0, 0, layers + 0.6]])[:strays]
    held = within_outline(body, np.concatenate([rim, crumbs]), SPACING)
    assert np.array_equal(held, np.round(body[:, 2] / SPACING) < layers)


def test_held_particles_do_what_a_box_written_by_hand_does():
    body = held_stem()
    (found,) = body.held
    top = float(found.position[:, 2].max()) + SPACING / 2  # of the cells of what is held
    box = FixedRegion(lower=(-1, -1, -1), upper=(1, 1, top))
    world = World(
        material=NeoHookean(),
        density=300.0,
        start={"youngs_modulus": 1e5, "poissons_ratio": 0.3},
        dx=2 * SPACING,
        gravity=(0.0, 0.0, 0.0),
    )
    poke = Impulse(force=(0.06, 0.03, 0), centre=(0, 0, 0.13), radius=0.03, duration=0.1)
    moved = []
    for holding in ((found,), (box,), ()):
        more = dict(excitation=(*holding, poke), frames=6, frame_dt=0.04, threads=1, log=Log(None))
        run = rollout(world, world.estimate().parameters, body.position, body.volume, **more)
        moved.append(run.position - body.position)
    by_hand = moved[1].norm()
    # cells at the rim that the plate does not reach are held by the box alone
    assert float((moved[0] - moved[1]).norm() / by_hand) < 0.15
    assert float((moved[2] - moved[1]).norm() / by_hand) > 1


@pytest.fixture(scope="module", params=["auto", "none"])
def through_fill(request, tmp_path_factory):
    """How fill was told to attach, the body that it made of the stem, and what it said."""
    gaussians, label = stem_on_a_plate()
    capture = Capture(name="stem", images=(), cameras=(), names=(), gaussians=gaussians)
    segmentation = Segmentation(label=label, parts=("stem",), masks=None, mask_views=())
    folder = tmp_path_factory.mktemp("fill")
    log = Log(folder, quiet=True)
    body = Fill(spacing=SPACING, attach=request.param)(capture, gaussians, segmentation, log=log)
    return request.param, body, (folder / "log.txt").read_text()


@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_fill_says_is_held_is_what_does_not_move(through_fill, elsewhere, tmp_path):
    """... through the stages, whatever else the scene holds: a region beside the body changes nothing."""
    attach, body, said_by_fill = through_fill
    region = FixedRegion(lower=(0.5, 0.5, 0.5), upper=(0.6, 0.6, 0.6))
    world = World(
        material=NeoHookean(),
        density=300.0,
        start={"youngs_modulus": 1e5, "poissons_ratio": 0.3},
        dx=2 * SPACING,
        gravity=(0.0, 0.0, 0.0),
        boundaries=(region,) if elsewhere else (),
    )
    poke = Impulse(force=(0.06, 0.03, 0), centre=(0, 0, 0.13), radius=0.03, duration=0.1)
    stage = Simulate(world=world, frames=6, fps=25.0, excitation=(poke,))
    run = stage(body, world.estimate(), log=Log(tmp_path, quiet=True))
    moved = (run.position[-1] - run.position[0]).norm(dim=1)
    said = [said_by_fill, (tmp_path / "log.txt").read_text()]
    if attach == "none":
        assert body.attached is None and "attached at" not in said[0] and "nothing holds the body still" in said[1]
        assert float(moved.min()) > 1e-3
        return
    count = int(body.attached.sum())
    assert f"{count} particles beside static Gaussians are held there" in said[0]
    assert f"held: {count} particles where it touches what is static" in said[1]
    # nodes that get three tenths of their mass from held particles stand still; the others give a little
    assert float(moved[body.attached].max()) < 0.03 * float(moved.max())
    assert float(moved[~body.attached].max()) > 1e-3
