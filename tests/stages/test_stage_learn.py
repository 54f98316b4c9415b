"""The learn stage on a clip rendered by the same code: what was put in comes out."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
import torch
from gaussian_prior import GaussianPrior
from small_scene import DAMPED, ELASTIC, POKE, bar, cameras, capture, learner

from physics3d.boundaries.half_space import HalfSpace
from physics3d.filling.doubt import Doubt
from physics3d.learning.chain import chain_of
from physics3d.learning.course import WAYS
from physics3d.learning.imagined import Imagined
from physics3d.learning.interval import Beyond
from physics3d.learning.linear import Shown
from physics3d.learning.sandwich import Evidence
from physics3d.log import Log
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.priors.estimators.stratified import Stratified
from physics3d.priors.exemplar import Exemplar
from physics3d.scenes.base import Footage
from physics3d.world import Estimate, World

START = ELASTIC | {"youngs_modulus": 7e3}


@pytest.fixture(scope="module")
def clip():
    return capture(ELASTIC)


def test_stiffness_is_recovered_and_documented(clip, tmp_path):
    """From a third of the truth. 5 %: ten 8-bit pictures of 48 x 40 px, six steps, no search node at the truth."""
    stage = learner(START, ("youngs_modulus",), search=4, search_span=8.0, steps=6)
    estimate = stage(clip, *bar(), log=Log(tmp_path, quiet=True))
    assert float(estimate.parameters["youngs_modulus"]) == pytest.approx(2e4, rel=0.05)
    assert float(estimate.parameters["poissons_ratio"]) == pytest.approx(0.3)
    told = estimate.intervals["youngs_modulus"]
    assert told.determined and told.low < 2e4 < told.high and list(estimate.intervals) == ["youngs_modulus"]
    for preview in ("parameters", "reference_above_learned"):
        assert (tmp_path / "previews" / f"{preview}.png").stat().st_size > 1000
    text = (tmp_path / "metrics.jsonl").read_text()
    assert all(
        name in text
        for name in ("parameter/youngs_modulus", "sensitivity/youngs_modulus", "search/loss", "loss_learned")
    )
    estimate.save(tmp_path / "estimate")
    again = Estimate.load(tmp_path / "estimate")
    assert again.history == estimate.history and again.intervals == estimate.intervals


@pytest.mark.parametrize(("place", "solver"), [(0.2, "modes"), (0.085, "grid")])
def test_the_solver_is_that_of_what_is_learned_not_of_where_it_starts(place, solver, tmp_path):
    """The bar bends to 0.084 m, ten times as soft to 0.142 m, and its particles are 0.025 m wide: a wall is far away,
    or was touched, and a bar that is five times as stiff, without a wall, fits best. 5 %: as above."""
    wall = HalfSpace(point=(place, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
    stage = learner(START, ("youngs_modulus",), search=4, search_span=8.0, steps=6, solver="auto")
    stage = replace(stage, world=replace(stage.world, boundaries=(*stage.world.boundaries, wall)))
    seen = capture(ELASTIC, solver=solver, boundaries=(wall,))
    estimate = stage(seen, *bar(), log=Log(tmp_path, quiet=True))
    assert float(estimate.parameters["youngs_modulus"]) == pytest.approx(2e4, rel=0.05)
    said = (tmp_path / "log.txt").read_text()
    assert ("solver: grid" in said) == ("the grid takes over" in said) == (solver == "grid")


@pytest.mark.parametrize("work, ways", [
    ({"search": 3, "steps": 2, "polish": 1}, [0] * 6 + [1] * 3 + [2]),  # three, two between, the best
    ({"search": 3, "steps": 0}, [0] * 6),
    ({"steps": 2, "learn_velocity": True}, [1] * 3),
])  # fmt: skip
def test_the_curve_ends_where_the_result_is(clip, work, ways):
    """Whatever was the last thing done, its last point is the estimate, to the float32 that is filed."""
    estimate = learner(START, ("youngs_modulus",), frames=3, **work)(clip, *bar(), log=Log(None))
    assert estimate.history["way"] == ways
    assert {len(curve) for curve in estimate.history.values()} == {len(ways)}
    assert estimate.history["youngs_modulus"][-1] == pytest.approx(
        float(estimate.parameters["youngs_modulus"]), rel=1e-6
    )
    if "learn_velocity" in work:
        last = [estimate.history[f"velocity_{axis}"][-1] for axis in "xyz"]
        assert last == pytest.approx(estimate.velocity.tolist(), rel=1e-6)
        assert set(estimate.intervals) == {"youngs_modulus", "velocity_x", "velocity_y", "velocity_z"}


def test_a_polish_ends_in_the_better_valley_of_a_relaxation_time():
    """From eight times too long, across the period of the swing: there the loss has a bottom of its own, a hundred
    times as high as at the truth. Pictures of 48 x 40 px tell the time to a tenth."""
    times, moduli = ("shear_relaxation_time", "bulk_relaxation_time"), ("branch_shear_modulus", "branch_bulk_modulus")
    start = DAMPED | {name: 8 * DAMPED[name] for name in times} | {"youngs_modulus": 1.4e4}
    usual = dict(ties=(moduli, times), steps=0, search=2, search_span=1.2, polish=4, frames=16, solver="modes")
    usual |= dict(beyond=Beyond(density=0.0))  # as given: a density that is learned besides leaves the time more open
    estimate = learner(start, ("youngs_modulus",), **usual)(
        capture(DAMPED, frames=16, fps=10.0, solver="modes"), *bar(), log=Log(None)
    )
    found = {name: float(value) for name, value in estimate.parameters.items()}
    assert found["shear_relaxation_time"] == pytest.approx(DAMPED["shear_relaxation_time"], rel=0.15)
    assert found["youngs_modulus"] == pytest.approx(DAMPED["youngs_modulus"], rel=0.05)
    loss, way = np.array(estimate.history["loss"]), np.array(estimate.history["way"])
    left = way == WAYS.index("across")
    assert left.sum() == 1 and loss[left][0] > 10 * loss[-1] and way[-1] == WAYS.index("polish")
    for name in (*times, *moduli, "youngs_modulus"):
        assert estimate.intervals[name].low < DAMPED[name] < estimate.intervals[name].high


def test_exact_pictures_leave_what_they_do_not_show():
    """Surface, its mass, grid, density and length at their widths: sqrt(0.1^2 + 0.05^2 + g^2 + 0.1^2 + (2 0.05)^2)."""
    stage = learner(START, ("youngs_modulus",))
    field = stage.field(stage.world.estimate(), speed=1.0)
    exact = Evidence(JJ=1e9 * np.eye(1), score=np.zeros((8, 9, 1)), share=np.ones((8, 9, 1)))
    seen = Shown(evidence=exact, push=np.zeros(1), grid=np.zeros(1), rms=np.ones(1))
    for grid in (0.278, 0.15, 0.0):
        said = stage.said(field, seen, Log(None))
        told = stage.intervals(field, field.zero(), seen, said, [], [], Beyond(grid=grid), 0.0, Log(None))[
            "youngs_modulus"
        ]
        # the prior, 2.3 wide, takes a hundredth of it
        assert told.deviation == pytest.approx(math.sqrt(0.0325 + grid**2), rel=0.02)
        assert told.low * told.high == pytest.approx(7e3**2, rel=1e-6)


@pytest.mark.parametrize("solver", ["grid", "modes"])
def test_what_the_surface_leaves_open_is_in_the_interval_whatever_moves_the_body(solver):
    """Where all matter is in doubt by three tenths, so is the stiffness, in any motion, and the mass, which pulls the
    other way at most as much; of a body whose surface nobody measured the configured tenth is taken, and half of it."""
    seen, (gaussians, body) = capture(ELASTIC, solver=solver), bar()
    here, volume = body.position.double(), 0.3 * body.volume.double()
    doubted = replace(body, doubt=Doubt(position=here, volume=volume, shown=torch.ones(len(here), dtype=torch.bool)))
    only = Beyond(grid=0.0, modes=0.0, density=0.0, length=0.0, force=0.0)
    stage = learner(ELASTIC, ("youngs_modulus",), search=2, search_span=1.2, steps=1, solver=solver, beyond=only)
    square = [
        stage(seen, gaussians, b, log=Log(None)).intervals["youngs_modulus"].deviation ** 2 for b in (body, doubted)
    ]
    # what else is open, cells of a grid among it, is alike. Strain is carried on from neighbours, in whose mean what
    # differs from particle to particle on a grid is lost, an eighth of the width here
    stiff, mass = 0.3**2 - 0.1**2, 0.3**2 - 0.05**2
    assert 0.6 * stiff < square[1] - square[0] < 1.1 * (stiff + mass)


def test_initial_velocity_moves_towards_the_truth(clip):
    """The clip starts at rest; learning that begins with a throw has to slow it down."""
    gaussians, body = bar()
    stage = learner(ELASTIC, ("youngs_modulus",), learn_velocity=True, steps=3, frames=3, duration=0.1)
    thrown = replace(stage.world.estimate(), velocity=torch.tensor([0.5, 0.0, 0.0]))
    known = {field.name: getattr(stage.world, field.name) for field in fields(stage.world)}
    stage = replace(stage, world=_Thrown(**known, thrown=thrown))
    estimate = stage(clip, gaussians, body, log=Log(None))
    assert float(estimate.velocity[0]) < 0.35


@dataclass(frozen=True, kw_only=True)
class _Thrown(World):
    """A world whose estimate starts with a velocity."""

    thrown: Estimate

    def estimate(self):
        return self.thrown


def test_held_out_cameras_are_never_looked_at():
    clean = capture(ELASTIC, frames=3, views=2, held_out=(1,))
    take = clean.takes[0]
    spoiled = replace(clean, takes=(replace(take, videos=(take.videos[0], 255 - take.videos[1])),))
    stage = learner(START, ("youngs_modulus",), frames=3, steps=1, views_per_step=0)
    found = [stage(c, *bar(), log=Log(None)).history for c in (clean, spoiled)]
    assert found[0] == found[1]


def test_no_steps_no_search_leaves_the_start(clip):
    estimate = learner(START, ("youngs_modulus",), steps=0)(clip, *bar(), log=Log(None))
    assert float(estimate.parameters["youngs_modulus"]) == pytest.approx(7e3)


def test_without_a_modulus_there_is_no_search_for_a_stiffness_and_that_is_said(clip, tmp_path):
    stage = learner(START, ("poissons_ratio",), search=3, steps=0)
    estimate = stage(clip, *bar(), log=Log(tmp_path, quiet=True))
    assert float(estimate.parameters["youngs_modulus"]) == pytest.approx(7e3)
    assert "no coarse search" in (tmp_path / "log.txt").read_text()


def test_frames_span_the_duration(clip):
    stage = learner(START, ("youngs_modulus",), frames=4)
    assert stage.spread(clip.takes[0].footage).tolist() == [0, 3, 6, 9]
    assert replace(stage, duration=0.2, frames=3).spread(clip.takes[0].footage).tolist() == [0, 2, 4]


def test_however_many_frames_are_taken_they_cover_the_take():
    """16 of 30 are not the first 16: nothing as long as the mean distance between two is left out at either end."""
    stage = learner(START, ("youngs_modulus",))
    taking = {count: replace(stage, frames=count) for count in range(2, 40)}
    for total in range(2, 40):
        take = Footage(name="poke", role="learn", frames=total, fps=30.0)
        for count in range(2, total + 1):
            at = taking[count].spread(take)
            steps = at.diff()
            assert len(at) == count and at[0] == 0
            assert total - 1 - int(at[-1]) < (total - 1) / (count - 1)
            assert int(steps.min()) >= 1 and int(steps.max()) - int(steps.min()) <= 1, "as even as frames allow"


def test_frames_that_are_not_equally_far_apart_are_compared_with_the_same_instants(clip):
    """At the true parameters what is rendered is what was recorded, to the rounding to 8 bits; a frame too early or
    too late is not."""
    stage = learner(ELASTIC, ("youngs_modulus",), frames=7)
    gaussians, body = bar()
    field = stage.field(stage.world.estimate(), speed=1.0)
    found = {}
    for at in (stage.spread(clip.takes[0].footage), torch.arange(7)):
        how = dict(image_scale=1.0, device="cpu", log=Log(None))
        chain = chain_of(
            stage.world, stage.prior, stage.estimator, field, clip, gaussians, body, clip.takes[0], at, **how
        )
        drawn = chain.render(chain.simulate(field.zero()), 0, torch.arange(7))
        found[tuple(at.tolist())] = drawn
        assert float((drawn - clip.takes[0].videos[0][at].float() / 255).abs().max()) <= 0.5 / 255 + 1e-3
    spread, first = found.values()
    assert float((spread - first).abs().max()) > 20 / 255


@pytest.mark.parametrize(
    "change, word",
    [
        ({"frames": 11}, "has 10 frames"),
        ({"frames": 9, "duration": 0.2}, "raise learn.duration"),
    ],
)
def test_what_does_not_fit_the_take_is_refused(clip, change, word):
    stage = replace(learner(START, ("youngs_modulus",)), **change)
    with pytest.raises(ValueError, match=word):
        stage.fits(clip.outline)  # before any work
    with pytest.raises(ValueError, match=word):
        stage(clip, *bar(), log=Log(None))


@pytest.mark.parametrize(
    "change, word",
    [({"learn": ("stiffness",)}, "learn.learn names 'stiffness'; take some of youngs_modulus"),
     ({"learn": ("poissons_ratio",), "ties": (("poissons_ratio", "youngs_modulus"),)}, "no scale to share")],
)  # fmt: skip
def test_what_does_not_fit_the_material_is_refused_when_it_is_said(change, word):
    with pytest.raises(ValueError, match=word):
        learner(START, change.pop("learn"), **change)


@pytest.mark.parametrize(
    "change",
    [
        {"frames": 1},
        {"learning_rate": 0.0},
        {"search_span": 1.0},
        {"steps": -1},
        {"stay": -1.0},
        {"search": 1},
        {"span": 1},
    ],
)
def test_impossible_options_are_refused(change):
    with pytest.raises(ValueError, match=f"learn.{next(iter(change))}"):
        replace(learner(START, ("youngs_modulus",)), **change)


def test_a_capture_without_a_take_is_refused(clip):
    with pytest.raises(ValueError, match="no take with role learn"):
        learner(START, ("youngs_modulus",))(replace(clip, takes=()), *bar(), log=Log(None))


def test_what_cannot_be_learned_from_is_found_before_learning_begins(clip, tmp_path):
    """... and not after minutes: the push of the take misses the body; a cell is larger than the body."""
    log = Log(tmp_path, quiet=True)
    gaussians, body = bar()
    away = replace(body, position=body.position + torch.tensor([5.0, 0.0, 0.0]))
    stage = learner(START, ("youngs_modulus",))
    with pytest.raises(ValueError, match=r"Impulse.* holds none of .* the body lies in \(4\.9"):
        stage(clip, gaussians, away, log=log)
    with pytest.raises(ValueError, match=r"world.dx is 2 m.* smaller than a cell"):
        replace(stage, world=replace(stage.world, dx=2.0))(clip, gaussians, body, log=log)
    assert not (tmp_path / "log.txt").exists()


# ---- priors that need no recording


def unrecorded(clip):
    """The bar, photographed and never filmed."""
    view = cameras()[0]
    image = clip.takes[0].videos[0][0]
    return replace(clip, images=(image,), cameras=(view,), names=("front",), takes=())


def imagined(**change):
    return Imagined(**({"frames": 10, "fps": 20.0, "excitation": POKE, "view": "front"} | change))


def test_what_a_prior_holds_probable_is_learned_without_a_recording(clip, tmp_path):
    """Videos are normal around the true one, says the prior: E is found as from a recording, by noisy gradients alone.
    15 %: what ten steps of at most that leave."""
    truth = clip.takes[0].videos[0].float() / 255
    prior = GaussianPrior(mean=truth, deviation=0.05, sigma=(0.05, 1.0), frames=10)
    estimator = Stratified(of=ScoreDistillation())
    stage = learner(
        START, ("youngs_modulus",), prior=prior, estimator=estimator, imagined=imagined(), frames=None, search=4,
        search_span=8.0, steps=10, polish=2,
    )  # fmt: skip
    estimate = stage(unrecorded(clip), *bar(), log=Log(tmp_path, quiet=True))
    assert float(estimate.parameters["youngs_modulus"]) == pytest.approx(2e4, rel=0.15)
    assert estimate.intervals == {}
    told = (tmp_path / "log.txt").read_text()
    assert "no intervals: what a video model holds probable" in told and "no polish" in told


def test_frames_are_those_that_the_prior_was_trained_on(clip):
    stage = learner(START, ("youngs_modulus",), prior=GaussianPrior(mean=torch.zeros(1), frames=4), frames=None)
    assert stage.spread(clip.takes[0].footage).tolist() == [0, 3, 6, 9]
    with pytest.raises(
        ValueError, match=r"learn.frames is 14 \(null: as many as the prior was trained on\), but .* 10"
    ):
        replace(stage, prior=GaussianPrior(mean=torch.zeros(1), frames=14)).fits(clip.outline)
    short = replace(stage, prior=GaussianPrior(mean=torch.zeros(1), frames=14), imagined=imagined())
    with pytest.raises(ValueError, match="take imagined has 10 frames"):
        short.fits(unrecorded(clip).outline)


def test_what_cannot_be_imagined_is_refused(clip):
    """Nothing pushes; no such view; a prior that knows recordings alone."""
    stage = learner(START, ("youngs_modulus",), prior=GaussianPrior(mean=torch.zeros(1)))
    scene = unrecorded(clip)
    still = imagined(force={"x": 0.0, "y": 0.0, "z": 0.0})
    for wrong, word in (
        (replace(stage, imagined=still), "nothing pushes the body"),
        (replace(stage, imagined=imagined(excitation=())), "nothing pushes the body"),
        (replace(stage, imagined=imagined(view="back")), "render.view is 'back'"),
        (replace(stage, imagined=imagined(view=3)), "render.view is 3"),
        (replace(stage, imagined=imagined(), prior=Exemplar()), "no take with role learn"),
        (stage, "no take with role learn"),
    ):
        with pytest.raises(ValueError, match=word):
            wrong(scene, *bar(), log=Log(None))
