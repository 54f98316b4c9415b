"""Laws of filling, on bodies whose volume is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_bodies import annulus, box, cup, discs, joined, sheet, sphere, together, torus, wall

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.fill import Poisson, WindingNumber, clusters, fill, sample_surface
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.mpm.rollout import rollout
from physics3d.world import World

SPACING = 0.006
norm = np.linalg.norm
radius = lambda q: norm(q[:, :2], axis=1)
between = lambda q, a, b: (q[:, 2] > a) & (q[:, 2] < b)


def capped_sphere(rng):
    p, n = sphere(8000, 0.05, rng)
    return p[p[:, 2] > -0.04], n[p[:, 2] > -0.04]


def cylinder(r, height, rng):
    return together(wall(6000, r, 0, height, rng), annulus(600, 0, r, 0, rng, up=-1), annulus(600, 0, r, height, rng))


# body, volume [m^3], inside test
CLOSED = {
    "sphere": (lambda rng: sphere(8000, 0.05, rng), 4 / 3 * np.pi * 0.05**3, lambda q: norm(q, axis=1) < 0.05),
    "torus": (
        lambda rng: torus(8000, 0.06, 0.02, rng),
        2 * np.pi**2 * 0.06 * 0.02**2,
        lambda q: (radius(q) - 0.06) ** 2 + q[:, 2] ** 2 < 0.02**2,
    ),
    "box": (
        lambda rng: box(8000, (0.05, 0.04, 0.03), rng),
        8 * 0.05 * 0.04 * 0.03,
        lambda q: (np.abs(q) < [0.05, 0.04, 0.03]).all(1),
    ),
    "stem": (
        lambda rng: cylinder(0.011, 0.2, rng),
        np.pi * 0.011**2 * 0.2,
        lambda q: (radius(q) < 0.011) & between(q, 0, 0.2),
    ),
}
SOLIDS = [(Poisson(), SPACING), (WindingNumber(), 1.5 * SPACING)]  # direct summation is slow: coarser
WITH = {
    "spacing": SPACING,
    "opacity": 0.1,
    "solid": Poisson(),
    "interior": True,
    "sheet_thickness": None,
    "isolated": "keep",
    "drop_pieces_below": 0.0,
    "attach": False,
    "cameras": (),
    "log": Log(None),
}


def filled(gaussians, **options):
    label = options.pop("label", torch.ones(len(gaussians), dtype=torch.int32))
    return fill(gaussians, label, **{**WITH, **options})


def overlap(solid, gaussians, inside, rng, spacing=SPACING) -> float:
    """Intersection over union of the solid found and the true one, by 20 000 random points (4e-3 rms)."""
    surface, _ = sample_surface(gaussians, spacing)
    point = gaussians.mean.double().numpy()
    q = rng.uniform(point.min(0) - 0.005, point.max(0) + 0.005, (20_000, 3))
    found, true = solid.inside(surface, spacing)(q), inside(q)
    return (found & true).sum() / (found | true).sum()


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(("solid", "spacing"), SOLIDS, ids=["Poisson", "WindingNumber"])
@pytest.mark.parametrize("name", CLOSED)
def test_closed_bodies_are_filled_and_volumes_add_up(name, solid, spacing, rng):
    make, volume, inside = CLOSED[name]
    gaussians = discs(*make(rng), rng)
    spacing = SPACING if name == "stem" else spacing  # else it is two and a half cells thick
    body = filled(gaussians, solid=solid, spacing=spacing)
    assert overlap(solid, gaussians, inside, rng, spacing) > 0.95
    # samples are means over half a spacing, which cuts edges: the 22 mm stem and coarser cells feel it
    tolerance = 0.02 if spacing == SPACING and name != "stem" else 0.05
    assert float(body.volume.double().sum()) == pytest.approx(volume, rel=tolerance)
    assert inside(body.position.double().numpy()).mean() > 0.98


def test_noise_does_not_spoil_filling(rng):
    make, volume, inside = CLOSED["sphere"]
    gaussians = discs(*make(rng), rng, noise=0.001)
    assert overlap(Poisson(), gaussians, inside, rng) > 0.95
    assert float(filled(gaussians).volume.double().sum()) == pytest.approx(volume, rel=0.03)


@pytest.mark.parametrize(("solid", "spacing"), SOLIDS, ids=["Poisson", "WindingNumber"])
def test_a_missing_cap_is_closed(solid, spacing, rng):
    gaussians = discs(*capped_sphere(rng), rng)
    # the cap itself is 2.8 % of the sphere
    assert overlap(solid, gaussians, CLOSED["sphere"][2], rng, spacing) > 0.93


def test_a_cake_without_base_is_filled(rng):
    gaussians = discs(*together(wall(8000, 0.06, 0, 0.06, rng), annulus(4000, 0, 0.06, 0.06, rng)), rng)
    inside = lambda q: (radius(q) < 0.06) & between(q, 0, 0.06)
    assert overlap(Poisson(), gaussians, inside, rng) > 0.95
    assert float(filled(gaussians).volume.double().sum()) == pytest.approx(np.pi * 0.06**3, rel=0.03)


def test_a_cup_stays_open(rng):
    r, t, h = 0.05, 0.012, 0.1  # the wall is two particles thick
    gaussians = discs(*cup(r, t, h, rng), rng)
    body = filled(gaussians)
    q = body.position.double().numpy()
    cavity = (radius(q) < r - t - SPACING) & (q[:, 2] > t + SPACING)
    assert cavity.sum() == 0
    volume = np.pi * (r**2 * h - (r - t) ** 2 * (h - t))
    assert float(body.volume.double().sum()) == pytest.approx(volume, rel=0.03)


def test_a_thin_sheet_stays_thin_and_weighs_area_times_thickness(rng):
    gaussians = discs(*sheet(4000, 0.1, rng), rng)
    body = filled(gaussians, sheet_thickness=0.002)
    assert not bool(body.interior.any())
    assert float(body.position[:, 2].abs().max()) < 1e-3
    # samples end up to half a sample distance before the edge: 4 * 1.5 mm / 100 mm
    assert float(body.volume.double().sum()) == pytest.approx(0.01 * 0.002, rel=0.07)
    # one particle for every spacing^2, within the scatter of random packing
    assert len(body.position) == pytest.approx(0.01 / SPACING**2, rel=0.15)


def test_thickness_is_taken_from_the_gaussians(rng):
    gaussians = discs(*sheet(4000, 0.1, rng), rng, thickness=0.0004)
    body = filled(gaussians)
    assert float(body.volume.double().sum()) == pytest.approx(0.01 * 12**0.5 * 0.0004, rel=0.07)


def test_a_model_of_many_faint_gaussians_is_filled_as_one_of_opaque_ones(rng):
    """A fit may cover a surface by ten layers of a tenth each: all of them are its surface."""
    gaussians = discs(*sphere(8000, 0.05, rng), rng)
    faint = replace(gaussians, opacity_logit=torch.logit(0.06 * gaussians.opacity))
    assert float(faint.opacity.max()) < WITH["opacity"]
    assert torch.equal(filled(faint).position, filled(gaussians).position)


def test_particles_keep_their_distance(rng):
    from scipy.spatial import cKDTree

    q = filled(discs(*sphere(8000, 0.05, rng), rng)).position.double().numpy()
    distance = cKDTree(q).query(q, k=2)[0][:, 1]
    # the lattice inside is exact; cells on the boundary have their centroid moved by up to three eighths of the spacing
    assert np.median(distance) == pytest.approx(SPACING, rel=0.01)
    assert distance.min() > 0.3 * SPACING


def test_without_interior_a_shell_remains(rng):
    gaussians = discs(*sphere(8000, 0.05, rng), rng)
    shell, whole = filled(gaussians, interior=False), filled(gaussians)
    assert not bool(shell.interior.any())
    assert len(shell.position) == int((~whole.interior).sum())
    assert float(shell.position.norm(dim=1).min()) > 0.05 - 2.5 * SPACING


def test_every_moving_gaussian_is_embedded_and_parts_are_kept(rng):
    a, b = discs(*sphere(4000, 0.03, rng), rng), discs(*sphere(4000, 0.03, rng), rng)
    c = discs(*sheet(500, 0.3, rng), rng)
    b = replace(b, mean=b.mean + torch.tensor([0.1, 0, 0]))
    label = torch.cat([torch.full((len(g),), k, dtype=torch.int32) for g, k in ((c, 0), (a, 1), (b, 2))])
    gaussians = joined(c, a, b)
    body = filled(gaussians, label=label)
    assert torch.equal(body.embedding.which, torch.nonzero(label > 0).flatten())
    assert torch.equal(body.part, (body.position[:, 0] > 0.05).to(torch.int32))
    body.check()


def test_small_pieces_are_dropped_when_asked(rng):
    crumb = discs(*sphere(1500, 0.012, rng), rng)
    crumb = replace(crumb, mean=crumb.mean + torch.tensor([0.1, 0, 0]))
    gaussians = joined(discs(*sphere(8000, 0.05, rng), rng), crumb)
    kept, dropped = filled(gaussians), filled(gaussians, drop_pieces_below=0.05)
    assert float(kept.position[:, 0].max()) > 0.08
    assert float(dropped.position[:, 0].max()) < 0.06
    assert len(dropped.embedding.which) == len(gaussians)


def two_pieces(rng, gap: float):
    """Balls of 5 and 2 cm radius, `gap` apart along x."""
    small = discs(*sphere(2500, 0.02, rng), rng)
    small = replace(small, mean=small.mean + torch.tensor([0.07 + gap, 0, 0]))
    return joined(discs(*sphere(8000, 0.05, rng), rng), small)


def pieces(body) -> int:
    return int(clusters(body.position.double().numpy(), 2 * SPACING).max()) + 1


@pytest.mark.parametrize(("isolated", "gap", "count"), [
    ("attach", 3, 1), ("attach", 6, 2), ("keep", 3, 2), ("drop", 3, 1),
])  # fmt: skip
def test_isolated_pieces_are_named_and_treated_as_asked(isolated, gap, count, rng, tmp_path):
    """A gap of 3 spacings is bridged, one of 6 is not; wherever the piece goes, its Gaussians ride along."""
    gaussians = two_pieces(rng, gap * SPACING)
    body = filled(gaussians, isolated=isolated, log=Log(tmp_path, quiet=True))
    assert pieces(body) == count
    assert len(body.embedding.which) == len(gaussians)
    reaches = float(body.position[:, 0].max()) > 0.06
    assert reaches == (isolated != "drop")
    said = (tmp_path / "log.txt").read_text()
    fate = {"attach": "attached across" if gap == 3 else "kept", "keep": "kept", "drop": "dropped"}[isolated]
    assert "isolated piece at (0.1" in said or "isolated piece at (0.0" in said
    assert "% of the volume, " + fate in said
    if isolated == "attach" and gap == 3:
        whole = filled(gaussians, isolated="keep")
        # the bridge is thin: 31 particles of 3000
        assert 1 < float(body.volume.sum() / whole.volume.sum()) < 1.02


def test_pieces_of_different_parts_are_not_joined(rng):
    gaussians = two_pieces(rng, 3 * SPACING)
    label = torch.ones(len(gaussians), dtype=torch.int32)
    label[8000:] = 2
    assert pieces(filled(gaussians, isolated="attach", label=label)) == 2


def test_gaussians_ride_on_their_own_side_of_a_gap(rng):
    gaussians = two_pieces(rng, 2.5 * SPACING)
    body = filled(gaussians)
    side = (body.position[:, 0] > 0.055)[body.embedding.neighbours]
    carried = torch.where(body.embedding.weights != 0, side, side[:, :1])
    assert bool((carried == (torch.arange(len(gaussians)) >= 8000)[:, None]).all())


def stem_on_a_plate(rng, *, speck=False):
    """A stem, 3 cm thick and 14 cm tall, on a static plate: Gaussians, labels. `speck`: some of its top is static."""
    side, top = wall(7000, 0.015, 0, 0.14, rng), annulus(800, 0, 0.015, 0.14, rng)
    stem = discs(*together(side, top), rng)
    plate = discs(*annulus(6000, 0.013, 0.12, 0, rng), rng, sigma=0.003)  # seen up to a little under the rim
    label = torch.cat([torch.ones(len(stem)), torch.zeros(len(plate))]).int()
    if speck:
        label[:200] = torch.where(stem.mean[:200, 2] > 0.1, 0, 1).int()
    return joined(stem, plate), label


@pytest.mark.parametrize("speck", [False, True])
def test_a_body_is_held_where_it_touches_what_is_static(speck, rng):
    """... and by nothing else: not by a few Gaussians of its own that the segmentation took for static."""
    gaussians, label = stem_on_a_plate(rng, speck=speck)
    body = filled(gaussians, label=label, attach=True)
    at = body.position[body.attached]
    assert len(at) >= 8
    assert float(at[:, 2].max()) < SPACING
    assert filled(gaussians, label=label).attached is None
    alone = filled(gaussians.select(label > 0), attach=True)
    assert not bool(alone.attached.any()) and alone.held(()) == ()


def test_held_particles_do_what_a_box_written_by_hand_does(rng):
    gaussians, label = stem_on_a_plate(rng)
    body = filled(gaussians, label=label, attach=True)
    (found,) = body.held(())
    box = FixedRegion(lower=(-1, -1, -1), upper=(1, 1, 0.001))
    assert body.held((box,)) == ()
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
    # the found ones reach up to three quarters of a spacing above the plate, of a stem of 23 spacings
    assert float((moved[0] - moved[1]).norm() / by_hand) < 0.15
    assert float((moved[2] - moved[1]).norm() / by_hand) > 1


def test_floaters_become_no_particles(rng):
    gaussians = discs(*sphere(8000, 0.05, rng), rng)
    far = discs(rng.uniform(-0.2, 0.2, (12, 3)) + np.array([0, 0, 0.4]), np.tile([0.0, 0.0, 1.0], (12, 1)), rng)
    body = filled(joined(gaussians, far))
    assert float(body.position.norm(dim=1).max()) < 0.06
    assert len(body.embedding.which) == 8012


def test_nonsense_is_refused_with_a_remedy(rng):
    gaussians = discs(*sphere(1000, 0.05, rng), rng)
    with pytest.raises(ValueError, match="no Gaussian may move"):
        filled(gaussians, label=torch.zeros(1000, dtype=torch.int32))
    with pytest.raises(ValueError, match=r"fill.spacing is 0 m"):
        filled(gaussians, spacing=0.0)
    with pytest.raises(ValueError, match=r"fill.spacing = 1e-05 m cuts .* take at least"):
        filled(gaussians, spacing=1e-5)
    with pytest.raises(ValueError, match=r"only 3 of 3 moving Gaussians .* segment.prompts"):
        filled(gaussians, label=(torch.arange(1000) < 3).to(torch.int32))
    with pytest.raises(ValueError, match=r"fill.isolated is 'burn'; take one of attach"):
        filled(gaussians, isolated="burn")
