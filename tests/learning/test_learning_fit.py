"""The chain theta -> motion -> video -> prior -> gradient, and the descent."""

import math
from dataclasses import replace

import pytest
import torch
from gaussian_prior import GaussianPrior
from scipy.optimize import minimize
from small_scene import DAMPED, bar, bar_chain, cameras, capture, world

from physics3d.gaussians.carry import carry
from physics3d.gaussians.sh import sh_color
from physics3d.gaussians.splat import Numerics
from physics3d.gaussians.twin import rasterize_plainly
from physics3d.journal import Journal
from physics3d.learning.fields import GlobalField
from physics3d.learning.fit import fit, some_frames
from physics3d.learning.linear import linearise, shown
from physics3d.learning.loss import COARSER, Chain
from physics3d.learning.polish import LEAST, polish
from physics3d.learning.search import search
from physics3d.log import Log
from physics3d.priors.exemplar import Exemplar
from physics3d.trajectory import NotMoved


def toy(simulate=None) -> tuple[Chain, GlobalField]:
    """A chain without simulator: a picture whose brightness oscillates with frequency `youngs_modulus`, two views."""
    t = torch.arange(8, dtype=torch.float64)

    def render(motion, view, frames):
        return (0.5 + 0.4 * torch.sin(motion * (1 + 0.1 * view) * t[frames]))[:, None, None, None].expand(-1, 3, 4, 3)

    field = GlobalField(
        start={"youngs_modulus": torch.tensor(0.3), "unseen": torch.tensor(1.0)}, learn=("youngs_modulus", "unseen")
    )
    plain = lambda theta: field.parameters(theta)["youngs_modulus"]
    truth = torch.tensor(0.4, dtype=torch.float64)
    clips = {view: render(truth, view, torch.arange(8)) for view in (0, 1)}
    return Chain(simulate=simulate or plain, render=render, clips=clips, prior=Exemplar(blur=(0.0,))), field


OPTIONS = {
    "steps": 40, "learning_rate": 0.1, "views_per_step": 1, "frames_per_step": 4, "stay": 0.0, "largest_gradient": 3.0,
    "seed": 0, "log": Log(None),
}  # fmt: skip


NAMES = ("youngs_modulus", "branch_shear_modulus", "shear_relaxation_time", "poissons_ratio")


@pytest.fixture(scope="module")
def poked():
    """A clip of six frames, and a chain whose material is not the one that was filmed; simulation in float64."""
    clip = capture(DAMPED, frames=6)
    softer = world(DAMPED | {"youngs_modulus": 1.5e4}, precision="float64")
    field = GlobalField(start=softer.estimate().parameters, learn=NAMES, velocity_scale=1.0)
    return field, bar_chain(softer, field, clip, 6)


def loss(chain: Chain, theta: torch.Tensor) -> torch.Tensor:
    return chain.loss(theta, [0], torch.arange(6), torch.Generator().manual_seed(0))


def gradient(chain: Chain, field: GlobalField) -> torch.Tensor:
    theta = field.zero().requires_grad_()
    loss(chain, theta).backward()
    return theta.grad


def differences(chain: Chain, field: GlobalField, components, step: float) -> torch.Tensor:
    """Central ones, for some components of theta."""
    steps = step * torch.eye(len(field.names), dtype=torch.float64)[list(components)]
    with torch.no_grad():
        found = [float(loss(chain, s).double() - loss(chain, -s).double()) / (2 * step) for s in steps]
    return torch.tensor(found, dtype=torch.float64)


def test_gradient_through_prior_and_simulator_is_exact(poked):
    """With a smooth picture in float64, every particle a spot: only the truncation of the differences is left."""
    field, chain = poked
    u = torch.linspace(-0.3, 0.5, 24, dtype=torch.float64)

    def spots(motion, view, frames):
        x = motion.position[frames]
        near = [torch.exp(-0.5 * ((x[..., axis, None] - u) / 0.05) ** 2) for axis in (0, 2)]
        return torch.einsum("tpi,tpj->tji", *near)[..., None].expand(-1, -1, -1, 3) / 20

    with torch.no_grad():
        filmed = spots(chain.simulate(torch.full((len(field.names),), 0.2, dtype=torch.float64)), 0, torch.arange(6))
    smooth = Chain(simulate=chain.simulate, render=spots, clips={0: filmed}, prior=chain.prior)
    found, expected = gradient(smooth, field)[:5], differences(smooth, field, range(5), 1e-3)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_gradient_of_the_whole_chain_is_that_of_central_differences(poked):
    """Backward through prior, Warp renderer and simulator; differences with the plain float64 renderer.

    The renderer ends a splat where its alpha falls below 1/255. Differences see that edge move (5 to 15 % in so small a
    picture), derivatives do not, so the plain one keeps its splats whole; the tails change the residual by up to 3 %.
    """
    field, chain = poked
    gaussians, body = bar()
    camera, X = cameras()[0], body.position
    whole = Numerics(cutoff=1e-9)

    def plainly(motion, view, frames):
        pictures = []
        for x, F in zip(motion.position[frames], motion.deformation[frames]):
            mean, covariance, _ = carry(gaussians, body.embedding, X, x, F)
            color = sh_color(gaussians.sh.double(), mean - camera.centre)
            white = torch.ones(3, dtype=torch.float64)
            opacity = gaussians.opacity.double()
            arguments = (mean, covariance, opacity, color, camera)
            pictures.append(rasterize_plainly(*arguments, background=white, numerics=whole).color)
        return torch.stack(pictures)

    plain = Chain(simulate=chain.simulate, render=plainly, clips={0: chain.clips[0].double()}, prior=chain.prior)
    components = (0, 4)  # stiffness and a velocity
    found = gradient(chain, field)[list(components)]
    # so short a step that no frame takes another number of substeps
    torch.testing.assert_close(found, differences(plain, field, components, 1e-5), rtol=0.05, atol=0.0)


def test_descent_finds_the_truth_from_random_frames_and_views_and_leaves_the_unseen_alone():
    chain, field = toy()
    theta, course = fit(chain, field, field.zero(), **OPTIONS)
    assert float(field.parameters(theta)["youngs_modulus"]) == pytest.approx(0.4, rel=0.01)  # noiseless, 40 steps
    assert float(field.parameters(theta)["unseen"]) == 1.0
    assert len(course) == 41 and course[-1].loss < 0.01 * course[0].loss, "every step, and the result"
    assert torch.equal(course[-1].theta, theta)


def test_losses_of_a_prior_that_draws_noise_differ_by_the_videos_alone():
    """What is asked between two all but equal materials changes nothing of their losses; another seed does, for it is
    another noise."""
    chain, field = toy()
    noisy = replace(chain, prior=GaussianPrior(mean=chain.clips[0], deviation=0.1))
    at = lambda more: field.zero() + torch.tensor([more, 0.0], dtype=torch.float64)
    first, other, again = (noisy.measure(at(more), 0) for more in (0.0, 0.3, 1e-9))
    assert abs(again - first) < 1e-6 * first
    spread = [noisy.measure(at(0.0), seed) for seed in range(1, 9)]
    assert max(spread) - min(spread) > 1e-3 * first
    assert other != pytest.approx(first, rel=1e-3)


def test_same_seed_same_path():
    one, two = (fit(*toy(), torch.zeros(2, dtype=torch.float64), **OPTIONS | {"steps": 5})[1] for _ in "ab")
    assert [point.loss for point in one] == [point.loss for point in two]
    assert all(torch.equal(a.theta, b.theta) for a, b in zip(one, two, strict=True))


def test_stay_holds_an_uncertain_parameter_near_its_start():
    chain, field = toy()
    free = fit(chain, field, field.zero(), **OPTIONS)[0]
    held = fit(chain, field, field.zero(), **OPTIONS | {"stay": 100.0})[0]
    assert abs(float(held[0])) < 0.5 * abs(float(free[0]))


def seen_as(brightness, start: float, span: float = 1e4) -> tuple[Chain, GlobalField]:
    """A chain whose second picture is as bright as `brightness` of ln E, recorded at E = 1, with stripes that nothing
    explains; the first one is dark."""
    field = GlobalField(start={"youngs_modulus": torch.tensor(start)}, learn=("youngs_modulus",), span=span)
    simulate = lambda theta: field.parameters(theta)["youngs_modulus"].log()
    lit = lambda motion, frames: torch.where(frames > 0, 0.5 + brightness(motion), 0.3)
    render = lambda motion, view, frames: lit(motion, frames)[:, None, None, None].expand(-1, 3, 4, 3)
    stripes = 0.01 * torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None]
    clip = render(torch.tensor(0.0).double(), 0, torch.arange(2)) + stripes
    return Chain(simulate=simulate, render=render, clips={0: clip}, prior=Exemplar(blur=(0.0,))), field


@pytest.mark.parametrize("start", [0.01, 0.1, 1.0, 10.0, 100.0])
def test_the_search_finds_the_valley_from_starts_over_four_decades(start):
    """The nearest of x2 steps to E = 1, whichever way, without trying the whole span."""
    chain, field = seen_as(lambda lnE: 0.02 * lnE, start)
    offsets = (math.log(2) * torch.arange(-2, 3)).tolist()
    theta, course = search(chain, field, torch.ones(1).double(), offsets, seed=0, log=Log(None))
    found = start * math.exp(float(theta))
    assert abs(math.log(found)) <= 0.5 * math.log(2) + 1e-6
    needed = max(0, round(abs(math.log2(start))) - 2)
    assert len(course) - 1 <= len(offsets) + needed + 1 + 2  # the middles beside the best


def test_a_valley_between_two_that_were_tried_is_found():
    """Narrow, at sqrt(2) of the start, beside a shallow one at twice that: a search by factors of 2 falls to either
    side of the deep one, and into the other."""
    dip = lambda lnE: 0.1 - 0.1 * torch.exp(-((lnE / 0.1) ** 2)) - 0.03 * torch.exp(-(((lnE - 0.35) / 0.1) ** 2))
    chain, field = seen_as(dip, math.sqrt(0.5))
    offsets = (math.log(2) * torch.arange(-2, 3)).tolist()
    theta, _ = search(chain, field, torch.ones(1).double(), offsets, seed=0, log=Log(None))
    assert float(theta) == pytest.approx(math.log(2) / 2)


def immovable(where):
    """`seen_as` a slope, from a start 100 times too stiff, of which nothing moves the body `where` E is so."""
    chain, field = seen_as(lambda lnE: 0.02 * lnE, 100.0)

    def simulate(theta):
        if where(field.parameters(theta)["youngs_modulus"].item()):
            raise NotMoved("frame 6: 1 of 11336 particles left the simulated region; enlarge world.lower")
        return chain.simulate(theta)

    return replace(chain, simulate=simulate), field


def test_a_search_passes_over_what_cannot_be_moved_and_says_so(tmp_path):
    """Too soft from a tenth of the answer on, and the start itself too stiff."""
    chain, field = immovable(lambda E: E < 0.1 or E > 60)
    chain = replace(chain, journal=Journal(Log(tmp_path, quiet=True)))
    offsets = (math.log(4) * torch.arange(-2, 3)).tolist()
    theta, course = search(chain, field, torch.ones(1).double(), offsets, seed=0, log=Log(None))
    assert abs(math.log(100 * math.exp(float(theta)))) <= 0.5 * math.log(4) + 1e-6
    assert any(math.isinf(point.loss) for point in course)
    said = (tmp_path / "log.txt").read_text()
    assert "cannot be moved (frame 6: 1 of 11336 particles left the simulated region)" in said
    there, _ = fit(chain, field, theta, **OPTIONS)
    assert float(field.parameters(there)["youngs_modulus"]) == pytest.approx(1.0, rel=0.02)


def test_where_nothing_moves_the_body_it_is_said_why():
    chain, field = immovable(lambda E: True)
    with pytest.raises(NotMoved, match=r"enlarge world\.lower"):
        search(chain, field, torch.ones(1).double(), [-1.0, 0.0, 1.0], seed=0, log=Log(None))


def test_a_descent_and_a_polish_step_back_from_what_cannot_be_moved():
    """The answer lies where nothing moves the body: both end beside it."""
    chain, field = immovable(lambda E: E < 30)
    theta, _ = fit(chain, field, field.zero(), **OPTIONS)
    assert 30 <= float(field.parameters(theta)["youngs_modulus"]) < 60
    theta, _ = polish(chain, field, field.zero(), steps=20, stay=0.0, seed=0, log=Log(None))
    assert 30 <= float(field.parameters(theta)["youngs_modulus"]) < 60


@pytest.mark.parametrize("blurred", [False, True])
def test_a_poor_picture_of_what_stands_still_is_no_reason_to_look_on(blurred, tmp_path):
    """The valley is a wide one, and found; stripes that all pictures lack are most of what is left of the loss."""
    chain, field = seen_as(lambda lnE: 0.05 * lnE, 4.0)
    if blurred:
        chain = replace(chain, clips={0: chain.clips[0] + 0.2 * torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None]})
    offsets = (math.log(2) * torch.arange(-3, 4)).tolist()
    search(chain, field, torch.ones(1).double(), offsets, seed=0, log=Log(tmp_path, quiet=True))
    assert "looking between" not in (tmp_path / "log.txt").read_text()


def test_the_search_ends_at_the_span(tmp_path):
    chain, field = seen_as(lambda lnE: 0.02 * lnE, 100.0, span=10.0)
    offsets = (math.log(2) * torch.arange(-2, 3)).tolist()
    theta, _ = search(chain, field, torch.ones(1).double(), offsets, seed=0, log=Log(tmp_path, quiet=True))
    assert float(theta) == pytest.approx(-3 * math.log(2))
    assert "going on" in (tmp_path / "log.txt").read_text()


def test_two_valleys_are_said(tmp_path):
    """Pictures that come back when E is 16 times as large; one valley, seen just as finely, is not two."""
    offsets = (math.log(2) * torch.arange(-3, 7)).tolist()
    for name, brightness in (("two", lambda lnE: 0.2 * torch.sin(math.pi * lnE / math.log(16))), ("one", torch.tanh)):
        chain, field = seen_as(brightness, 1.0)
        search(chain, field, torch.ones(1).double(), offsets, seed=0, log=Log(tmp_path / name, quiet=True))
        told = (tmp_path / name / "log.txt").read_text()
        assert ("two valleys explain the clip: the stiffness may as well be near x16" in told) == (name == "two")


def test_search_steps_over_a_period_that_descent_cannot():
    """From 1/6 of the true frequency the pictures are out of phase, and descent alone ends elsewhere."""
    chain, field = toy()
    far = GlobalField(start=field.start | {"youngs_modulus": torch.tensor(2.5)}, learn=field.learn)
    chain = Chain(
        simulate=lambda theta: far.parameters(theta)["youngs_modulus"],
        render=chain.render,
        clips=chain.clips,
        prior=chain.prior,
    )
    alone = far.parameters(fit(chain, far, far.zero(), **OPTIONS)[0])["youngs_modulus"]
    assert abs(float(alone) / 0.4 - 1) > 0.2
    directions = torch.tensor([1.0, 0.0], dtype=torch.float64)
    start, _ = search(chain, far, directions, torch.linspace(-3, 3, 13).tolist(), seed=0, log=Log(None))
    assert float(start[1]) == 0
    found = far.parameters(fit(chain, far, start, **OPTIONS)[0])["youngs_modulus"]
    assert float(found) == pytest.approx(0.4, rel=0.01)


class _Poison(torch.autograd.Function):
    """The identity, whose derivative is NaN beyond a threshold."""

    @staticmethod
    def forward(ctx, x, limit):
        ctx.bad = bool(x > limit)
        return x.clone()

    @staticmethod
    def backward(ctx, g):
        return (g * float("nan") if ctx.bad else g), None


def test_a_gradient_that_is_not_finite_is_reported_and_stepped_back_from(tmp_path):
    field = toy()[1]
    poisoned = lambda theta: _Poison.apply(field.parameters(theta)["youngs_modulus"], 0.33)
    theta, _ = fit(toy(poisoned)[0], field, field.zero(), **OPTIONS | {"log": Log(tmp_path, quiet=True), "steps": 8})
    assert torch.isfinite(theta).all() and float(field.parameters(theta)["youngs_modulus"]) <= 0.331
    assert "not finite" in (tmp_path / "log.txt").read_text()


def test_a_gradient_that_stays_not_finite_is_an_error_with_a_remedy():
    field = toy()[1]
    always = lambda theta: _Poison.apply(field.parameters(theta)["youngs_modulus"], 0.0)
    with pytest.raises(ValueError, match="learning_rate"):
        fit(toy(always)[0], field, field.zero(), **OPTIONS)


def test_polish_arrives_in_a_few_steps_and_leaves_the_unseen_alone():
    chain, field = toy()
    theta, _ = polish(chain, field, field.zero(), steps=8, stay=0.0, seed=0, log=Log(None))
    assert float(field.parameters(theta)["youngs_modulus"]) == pytest.approx(
        0.4, rel=1e-3
    )  # noiseless; J is a difference
    assert float(theta[1]) == 0
    assert chain.measure(theta, 0) < 1e-4 * chain.measure(field.zero(), 0)


def test_a_polish_ends_where_the_loss_is_least_along_a_flat_valley_from_any_start():
    """Two rates of decay that stand in for each other, of a curve that is no sum of two decays; the least loss is
    found without derivatives (Nelder and Mead). By differences from theta on, all ends were half of a per cent away
    from it, and half of them by more of the loss than is allowed here."""
    t = torch.linspace(0, 3, 31, dtype=torch.float64)
    clip = torch.exp(-2.0 * t) + torch.exp(-0.9 * t) + 0.1 * torch.cos(7 * t) + 0.045 * torch.sin(2 * t)

    def ended(fast: float, slow: float) -> tuple[dict, float, float]:
        start = {"fast": torch.tensor(fast), "slow": torch.tensor(slow)}
        field = GlobalField(start=start, learn=("fast", "slow"))
        simulate = lambda theta: sum(torch.exp(-rate * t) for rate in field.parameters(theta).values())
        render = lambda motion, view, frames: 0.5 * motion[frames][:, None, None, None].expand(-1, 3, 4, 3)
        chain = Chain(
            simulate=simulate, render=render, clips={0: render(clip, 0, torch.arange(31))}, prior=Exemplar(blur=(0.0,))
        )
        theta, _ = polish(chain, field, field.zero(), steps=20, stay=0.0, seed=0, log=Log(None))
        at = lambda place: 1e4 * chain.measure(torch.as_tensor(place), 0)
        options = dict(xatol=1e-8, fatol=1e-12, maxiter=4000)
        least = minimize(at, theta.numpy(), method="Nelder-Mead", options=options)
        return field.parameters(theta), at(theta), least.fun

    ends = [ended(*start) for start in ((4.0, 0.5), (20.0, 0.8), (2.0, 1.0), (1.5, 0.1))]
    for parameters, loss, least in ends:
        assert loss - least < LEAST * least
        for name, value in parameters.items():
            # a tenth of a standard deviation, of some hundreds of numbers, is a hundredth of a rate here
            assert float(value) == pytest.approx(float(ends[0][0][name]), rel=0.01)


def test_linearised_gradient_is_the_one_of_the_backward_pass():
    chain, field = toy()
    theta = field.zero().requires_grad_()
    chain.loss(theta, [0, 1], torch.arange(8), torch.Generator().manual_seed(0)).backward()
    found = linearise(chain, field, theta.detach(), seed=0, step=1e-6).Jr
    torch.testing.assert_close(found, theta.grad, rtol=1e-6, atol=1e-10)  # differences over 1e-6


def test_what_is_shown_of_the_seen_and_the_unseen():
    chain, field = toy()
    found = shown(chain, field, field.zero(), seed=0)
    assert 255 * found.rms[0] > 1 and found.rms[1] == 0
    assert found.evidence.JJ[0, 0] > 0 and found.evidence.JJ[1, 1] == 0
    assert found.push.tolist() == [0.0, 0.0], "no force is known here"


def test_a_known_force_is_told_from_a_known_motion(poked):
    """The bar is poked by a force: it is drawn larger by what is learned as softer. Pushed by an acceleration it is
    not, and nothing more is simulated."""
    field, chain = poked
    assert chain.pushed is not None
    with torch.no_grad():
        plain, harder = chain.simulate(field.zero()), chain.pushed(field.zero(), 0.1)
    moved, more = (motion.position[-1] - motion.position[0] for motion in (plain, harder))
    # small amplitudes: the motion is proportional to the force, to a hundredth
    assert float((more - moved * math.exp(0.1)).norm()) < 0.02 * float(moved.norm())


def test_what_cells_do_is_told_from_what_a_parameter_does():
    """A rate that cells draw too high in proportion to their size: it is too high by all of that, whatever it is; what
    no picture shows is left alone."""
    chain, field = toy()
    share = 0.08  # of ln of the rate, by the cells that are used
    larger = lambda theta: chain.simulate(theta) * math.exp(share * (COARSER - 1))
    found = shown(replace(chain, coarser=larger), field, field.zero(), seed=0).grid
    # of second order in share/4 = 0.02, times the phase of up to three radians
    assert found.tolist() == pytest.approx([share, 0.0], rel=0.05)
    assert shown(chain, field, field.zero(), seed=0).grid.tolist() == [0.0, 0.0], "no grid here"


def test_drawn_frames_span_the_whole_clip():
    chain, generator = toy()[0], torch.Generator().manual_seed(0)
    for _ in range(50):
        frames = some_frames(chain, 3, generator).tolist()
        assert frames == sorted(set(frames)) and 1 <= frames[0] <= 3 and 5 <= frames[-1] <= 7
    assert some_frames(chain, 0, generator).tolist() == list(range(8))
