"""Laws of the estimators, by priors whose answers are known in closed form."""

import pytest
import torch
from gaussian_prior import GaussianPrior, waving

from physics3d.priors.base import AbstractPrior, Level, draws
from physics3d.priors.distillation import denoising_loss, distillation_loss, still_code
from physics3d.priors.estimators.moving_minus_still import MovingMinusStill
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.priors.estimators.stratified import Stratified
from physics3d.priors.exemplar import Exemplar

ESTIMATORS = {
    "sds": ScoreDistillation(),
    "moving_minus_still": MovingMinusStill(),
    "stratified": Stratified(of=ScoreDistillation()),
    "stratified_difference": Stratified(of=MovingMinusStill()),
}
SHAPE = (4, 5, 6, 3)


class Knowing(AbstractPrior):
    """Takes the noise off exactly, as a network would that could see it."""

    def condition(self, first, clips):
        return None

    def encode(self, video):
        return video

    def level(self, share):
        return Level(alpha=1.0, sigma=1.0 + share)

    def x0_hat(self, z_t, level, condition):
        raise NotImplementedError

    def estimate(self, z0, draw, condition):
        return z0


def gradient(prior, estimator, video, condition, seed=0):
    x = video.clone().requires_grad_()
    distillation_loss(prior, estimator, x, condition, generator=torch.Generator().manual_seed(seed)).backward()
    return x.grad


def pulled_from(name, prior, video, mean):
    """What the expected pull is proportional to."""
    return video - (still_code(prior, video) if "difference" in name or "minus" in name else mean)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_with_one_exemplar_every_estimator_has_its_closed_form(name):
    """x0_hat is the clip, whatever the noise: plain ones pull to the clip, differences to the still picture."""
    prior, x, y = Exemplar(blur=(0.0,)), waving(SHAPE), waving(SHAPE).flip(0)
    condition = prior.condition(y[0], (y,))
    found = gradient(prior, ESTIMATORS[name], x, condition)
    difference = "minus" in name or "difference" in name
    torch.testing.assert_close(found, x - (x[:1].expand_as(x) if difference else y), rtol=0, atol=1e-13)
    assert float(found.abs().max()) > 0.1
    assert ESTIMATORS[name].descends != difference


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_expected_gradient_is_that_of_a_quadrature(name):
    """Mean over 400 seeds against the integral over levels; within 4.5 standard errors of the mean, the largest of 360
    numbers."""
    mean = waving(SHAPE).flip(0)
    prior, video = GaussianPrior(mean=mean), waving(SHAPE)
    drawn = torch.stack([gradient(prior, ESTIMATORS[name], video, None, seed) for seed in range(400)])
    expected = prior.expected() * pulled_from(name, prior, video, mean)
    error = (drawn.mean(0) - expected).abs()
    assert bool((error <= 4.5 * drawn.std(0) / 20 + 1e-12).all())
    assert float(expected.abs().max()) > 10 * float(error.max()), "or any gradient would do"


@pytest.mark.parametrize("alpha, sigma", [(1.0, 0.3), (1.0, 7.0), (0.8, 0.6), (0.1, 0.9)])
def test_the_pull_is_weighed_as_dreamfusion_weighs_noise(alpha, sigma):
    """Poole et al. (2022), eq. 3 with w = sigma^2, for z_t of variance one: w (n_hat - n), where n_hat is what z_t says
    of the noise if x0_hat is the clean code. Levels that are not of variance one are brought there, by 1/r."""
    r = (alpha**2 + sigma**2) ** 0.5
    prior, z0, x0_hat = GaussianPrior(mean=waving(SHAPE)), waving(SHAPE), waving(SHAPE).flip(0)
    noise = waving(SHAPE).flip(1)
    z_t = (alpha * z0 + sigma * noise) / r
    n_hat = (z_t - alpha / r * x0_hat) / (sigma / r)
    found = prior.weight(Level(alpha=alpha, sigma=sigma)) * (z0 - x0_hat)
    # float64; noise is taken off and put on again
    torch.testing.assert_close(found, (sigma / r) ** 2 * (n_hat - noise), rtol=0, atol=1e-13)


@pytest.mark.parametrize("of", ["sds", "moving_minus_still"])
def test_several_levels_vary_less_than_as_many_draws_one_by_one(of):
    """The mean of 8 independent draws has an eighth of the variance of one; 4 levels and their mirrored noises less
    than half of that, for a linear prior has no noise left and the levels are stratified."""
    prior, video = GaussianPrior(mean=waving(SHAPE).flip(0)), waving(SHAPE)
    variance = lambda estimator: (
        torch.stack([gradient(prior, estimator, video, None, seed) for seed in range(60)]).var(0).mean()
    )
    assert float(variance(Stratified(of=ESTIMATORS[of], levels=4))) < 0.5 / 8 * float(variance(ESTIMATORS[of]))


def test_the_same_noise_leaves_nothing_of_itself_in_the_difference_of_a_linear_prior():
    """At one level the difference is c (z0 - s0), exactly; the plain score is off by s^2/(s^2 + sigma^2) sigma n."""
    prior = GaussianPrior(mean=waving(SHAPE), sigma=(1.0, 1.0 + 1e-12))
    video = waving(SHAPE).flip(0)
    still = video[:1].expand_as(video)
    exact = prior.shrinkage(0.5)
    torch.testing.assert_close(
        gradient(prior, MovingMinusStill(), video, None), exact * (video - still), rtol=0, atol=1e-10
    )
    plain = gradient(prior, ScoreDistillation(), video, None) - exact * (video - prior.mean)
    s2 = prior.deviation**2
    assert float(plain.std()) == pytest.approx(0.5 * s2 / (s2 + 1), rel=0.2)  # w = 1/2; 360 numbers


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_perfect_denoiser_leaves_no_gradient(name):
    """One that is certain of the very video: no pull; the difference subtracts that of the still one, none either."""
    # float64, a sum and a difference of numbers below 1
    assert float(gradient(Knowing(), ESTIMATORS[name], waving(SHAPE), None).abs().max()) < 1e-15


def test_videos_are_compared_by_their_expected_denoising_error():
    """Against bias and variance in closed form: 3 % is what the middle of eight ranges of levels leaves."""
    mean = waving((6, 12, 16, 3))
    prior = GaussianPrior(mean=mean)
    for video in (mean, mean.flip(0), mean + 1.0):
        found = denoising_loss(prior, video, None, generator=torch.Generator().manual_seed(1))
        assert found == pytest.approx(prior.expected_loss(video), rel=0.03)
    worse = [
        denoising_loss(prior, mean + off, None, generator=torch.Generator().manual_seed(2)) for off in (0, 0.3, 0.6)
    ]
    assert worse == sorted(worse), "what is further from the mean is less probable"


def test_which_of_two_videos_is_more_probable_does_not_depend_on_the_noise():
    """By a noise and its negative what is linear in it cancels: at one level, of a linear prior, the difference of two
    losses is that of the expected ones, exactly."""
    mean = waving(SHAPE)
    prior = GaussianPrior(mean=mean, sigma=(1.0, 1.0 + 1e-12))
    one, other = mean.flip(0), mean + 0.3
    for seed in range(3):
        losses = [
            denoising_loss(prior, video, None, generator=torch.Generator().manual_seed(seed)) for video in (one, other)
        ]
        # float64; sums of 360 squares
        assert losses[0] - losses[1] == pytest.approx(prior.expected_loss(one) - prior.expected_loss(other), rel=1e-8)


def test_draws_cover_every_range_of_levels_once_and_mirror_their_noise():
    prior, like = GaussianPrior(mean=waving(SHAPE), sigma=(1.0, 16.0)), waving(SHAPE)
    found = draws(prior, like, torch.Generator().manual_seed(3), levels=4, mirrored=True)
    bounds = [1, 2, 4, 8, 16]
    for half in (found[:4], found[4:]):
        assert all(low <= draw.level.sigma < high for draw, low, high in zip(half, bounds, bounds[1:]))
    for draw, mirror in zip(found[:4], found[4:]):
        assert torch.equal(draw.noise, -mirror.noise) and draw.level == mirror.level


def test_impossible_numbers_of_levels_are_refused():
    with pytest.raises(ValueError, match=r"estimator\.levels is 0"):
        Stratified(of=ScoreDistillation(), levels=0)
