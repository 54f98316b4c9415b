"""The small video model: its network and levels, its training, and drawing from it, against closed forms."""

import math
from types import SimpleNamespace

import pytest
import torch

from physics3d.log import Log
from physics3d.priors.denoising import STATE, Training, codes, ddim, denoising_error, draw, motion, train
from physics3d.priors.space_time_transformer import Architecture, SpaceTimeTransformer, pictures, tokens
from physics3d.priors.tiny_video import TinyVideo, level_of, save
from pipeline import train_prior

SMALL = Architecture(frames=4, size=8, patch=4, width=32, layers=1)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def bars(count: int) -> torch.Tensor:
    """Clips [n, 4, 8, 8, 3] uint8 of a bright bar that goes one way or the other by a pixel per frame."""
    clips = torch.zeros(count, 4, 8, 8, 3, dtype=torch.uint8)
    for i in range(count):
        for t in range(4):
            clips[i, t, :, 3 + (t if i % 2 else -t), i % 3] = 255
    return clips


def trained(seed: int = 0) -> SpaceTimeTransformer:
    """With weights that are not zero anywhere."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = SpaceTimeTransformer(SMALL)
        for p in network.parameters():
            p.data += 0.1 * torch.randn(p.shape)
    return network.eval()


class Gaussian:
    """The exact denoiser of clips whose numbers are independent and normal, with mean m and deviation s."""

    architecture = SimpleNamespace(frames=4)

    def __init__(self, mean: float, deviation: float):
        self.mean, self.deviation = mean, deviation

    def __call__(self, z_t, still, alpha, sigma):
        alpha, sigma = (a[:, None, None, None, None] for a in (alpha, sigma))
        gain = alpha * self.deviation**2 / (alpha**2 * self.deviation**2 + sigma**2)
        return self.mean + gain * (z_t - alpha * self.mean)


# ---- network


def test_tokens_are_blocks_of_pixels_and_come_back():
    x = random(2, 4, 3, 8, 8)
    expected = torch.nn.functional.unfold(x.reshape(8, 3, 8, 8), 4, stride=4).mT.reshape(2, 4, 4, 48)
    assert torch.equal(tokens(x, 4, 1), expected)
    of_two = torch.cat([expected[:, 0::2], expected[:, 1::2]], -1)  # a frame, then the next
    assert torch.equal(tokens(x, 4, 2), of_two)
    assert torch.equal(pictures(of_two, 4, 2), x)


def test_an_untrained_network_says_that_nothing_moves():
    z_t, still = random(2, 4, 3, 8, 8), random(2, 3, 8, 8, seed=1)
    found = SpaceTimeTransformer(SMALL)(z_t, still, torch.tensor([0.3, 0.9]), torch.tensor([0.95, 0.4]))
    assert torch.equal(found, still[:, None].expand_as(z_t))


def test_every_number_that_the_network_is_given_matters():
    network, inputs = trained(), (random(1, 4, 3, 8, 8), random(1, 3, 8, 8, seed=1), torch.ones(1), torch.ones(1))
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    # one pixel of the last frame: everything attends to everything
    network(*inputs)[0, -1, 0, 0, 0].backward()
    for x in inputs:
        assert bool((x.grad != 0).all())


# ---- levels and drawing


def test_levels_span_the_ratio_and_keep_the_variance():
    prior = TinyVideo(ratio=(2.0, 32.0))
    for share, ratio in ((0.0, 2.0), (0.5, 8.0), (1.0, 32.0)):
        level = prior.level(share)
        assert math.isclose(level.sigma / level.alpha, ratio, rel_tol=1e-12)
        assert math.isclose(level.alpha**2 + level.sigma**2, 1, rel_tol=1e-12)


def test_a_step_of_drawing_is_that_of_diffusers():
    from diffusers import DDIMScheduler

    scheduler = DDIMScheduler(prediction_type="sample", clip_sample=False, set_alpha_to_one=False)
    scheduler.set_timesteps(10)
    z, x0_hat = random(1, 4, 3, 8, 8), random(1, 4, 3, 8, 8, seed=1)
    for t, after in zip(scheduler.timesteps[:-1], scheduler.timesteps[1:]):
        ratio, less = (float(torch.sqrt(1 / scheduler.alphas_cumprod[i] - 1)) for i in (t, after))
        expected = scheduler.step(x0_hat, int(t), z, eta=0.0).prev_sample
        # float32 tables of the schedule: alpha is 1e-2 where there is most noise, and is divided by
        torch.testing.assert_close(ddim(z, x0_hat, ratio, less), expected, rtol=1e-4, atol=1e-4)


def test_drawing_with_the_exact_denoiser_gives_its_distribution():
    """Along the flow (z - alpha m)/sqrt(alpha^2 s^2 + sigma^2) stays what it was: the end is known for every start."""
    mean, deviation, span = 0.3, 0.5, (0.01, 20.0)
    still = torch.zeros(2, 3, 8, 8)
    start = torch.randn(2, 4, 3, 8, 8, generator=torch.Generator().manual_seed(5))
    first, last = level_of(span[1]), level_of(span[0])
    unit = (start - first.alpha * mean) / math.hypot(first.alpha * deviation, first.sigma)
    z = last.alpha * mean + math.hypot(last.alpha * deviation, last.sigma) * unit
    one = lambda a: torch.full((2,), a)
    expected = Gaussian(mean, deviation)(z, still, one(last.alpha), one(last.sigma))
    errors = []
    for steps in (50, 100):
        drawn = draw(
            Gaussian(mean, deviation), still, ratio=span, steps=steps, generator=torch.Generator().manual_seed(5)
        )
        errors.append(float((drawn - expected).abs().max()))
    assert errors[1] < 0.05 and 1.6 < errors[0] / errors[1] < 2.6  # of first order


def test_the_error_of_the_exact_denoiser_is_the_variance_that_noise_leaves():
    mean, deviation, ratio = -0.2, 0.5, 1.5
    z0 = mean + deviation * random(400, 4, 3, 8, 8)
    found = denoising_error(Gaussian(mean, deviation), z0, torch.full((400,), ratio), random(*z0.shape, seed=1))
    left = z0[0].numel() * deviation**2 * ratio**2 / (deviation**2 + ratio**2)
    # 400 x 768 squares, each with a relative deviation of sqrt(2): 0.26 %
    assert math.isclose(float(found.mean()), left, rel_tol=0.01)


# ---- training


def options(**more) -> Training:
    return Training(**{"steps": 25, "batch": 4, "warm_up": 5, "average": 5, "ratio": (0.5, 8.0), **more})


def test_training_lowers_the_error(tmp_path):
    clips = bars(6)
    network, _ = train(clips, SMALL, options(steps=80, learning_rate=5e-3), folder=tmp_path, log=Log(None))
    z0 = codes(clips)
    with torch.no_grad():
        found = denoising_error(network, z0, torch.full((6,), 1.0), random(*z0.shape, seed=3)).mean()
    # what an untrained one has is exactly the motion; which way the bar goes can be seen through this noise
    assert float(found) < 0.6 * motion(clips)  # 0.51 was seen; 1 says that nothing moves


def test_a_training_that_is_killed_ends_with_the_same_bits(tmp_path):
    class Killed(Log):
        def metric(self, name, value, step=None):
            if step == 10:
                raise KeyboardInterrupt

    clips = bars(6)
    straight, losses = train(clips, SMALL, options(), folder=tmp_path / "straight", log=Log(None))
    with pytest.raises(KeyboardInterrupt):
        train(clips, SMALL, options(), folder=tmp_path / "killed", every=0.0, log=Killed(None))
    assert len(torch.load(tmp_path / "killed" / STATE)["losses"]) == 10
    resumed, again = train(clips, SMALL, options(), folder=tmp_path / "killed", log=Log(None))
    assert again == losses
    for a, b in zip(straight.state_dict().values(), resumed.state_dict().values()):
        assert torch.equal(a, b)


def test_a_folder_of_another_training_is_refused(tmp_path):
    train(bars(2), SMALL, options(steps=2), folder=tmp_path, log=Log(None))
    with pytest.raises(ValueError, match="other options"):
        train(bars(2), SMALL, options(steps=3), folder=tmp_path, log=Log(None))
    with pytest.raises(ValueError, match="architecture takes 4 frames"):
        train(bars(2)[:, :3], SMALL, options(), folder=tmp_path, log=Log(None))


def test_words_that_are_no_options_are_refused(tmp_path, capsys):
    for words in (["stepps=3"], ["steps=0"], ["steps=many"], ["steps"]):
        assert train_prior.main(words, {}) == 2
        assert "make train-prior" in capsys.readouterr().err
    assert train_prior.main(["device=cuda:77"], {"OUT": str(tmp_path)}) == 2  # before any film is made
    assert "device=cuda:77: not available here" in capsys.readouterr().err and not any(tmp_path.iterdir())


# ---- the prior


@pytest.fixture
def prior(tmp_path) -> TinyVideo:
    save(trained(), tmp_path, {})
    return TinyVideo(weights=str(tmp_path))


def test_the_prior_is_its_network(prior):
    video = torch.rand(4, 8, 8, 3, generator=torch.Generator().manual_seed(2))
    z0, still, level = prior.encode(video), prior.condition(video[0], ()), prior.level(0.2)
    assert torch.equal(z0, 2 * video.permute(0, 3, 1, 2) - 1) and torch.equal(still, z0[0])
    z_t = level.alpha * z0 + level.sigma * random(*z0.shape)
    one = lambda a: torch.tensor([a])
    with torch.no_grad():
        expected = trained()(z_t[None], still[None], one(level.alpha), one(level.sigma))[0]
    # weights are kept in half precision: three digits of each
    torch.testing.assert_close(prior.x0_hat(z_t, level, still), expected, rtol=0, atol=2e-2)
    assert prior.trained_frames == 4 and not prior.needs_clip


def test_a_larger_video_is_brought_to_the_size_of_the_network(prior):
    video = torch.full((4, 24, 24, 3), 0.25)
    assert prior.encode(video).shape == (4, 3, 8, 8)
    torch.testing.assert_close(prior.encode(video), torch.full((4, 3, 8, 8), -0.5))


def test_numbers_of_frames_that_it_was_not_trained_on_are_refused(prior):
    for asked in (lambda: prior.encode(torch.zeros(5, 8, 8, 3)), lambda: prior.require_frames(5)):
        with pytest.raises(ValueError, match=r"learn\.frames is 5; .* set learn\.frames=4"):
            asked()


def test_of_a_picture_that_is_not_square_the_middle_is_seen(prior):
    video = random(4, 8, 8, 3)
    for beside, below in ((4, 0), (0, 6)):
        wide = torch.nn.functional.pad(video, (0, 0, beside // 2, beside // 2, below // 2, below // 2), value=9.0)
        assert torch.equal(prior.encode(wide), prior.encode(video))


def test_without_weights_the_remedy_is_named(tmp_path):
    nothing = TinyVideo(weights=str(tmp_path))
    for ask in (nothing.files, lambda: nothing.condition(torch.zeros(8, 8, 3), ())):
        with pytest.raises(ValueError, match=r"config.json and model.safetensors not in .*make train-prior"):
            ask()
    save(trained(), tmp_path, {})
    (tmp_path / "model.safetensors").write_bytes(b"half of it")
    with pytest.raises(ValueError, match="make train-prior again"):
        TinyVideo(weights=str(tmp_path)).network  # noqa: B018


# ---- the weights of the package


def test_the_packaged_weights_hold_the_usual_stiffness_more_probable_than_others():
    """On a body that they have not seen, poked as usual: nearer to the film are estimates of the usual one."""
    from physics3d.priors.distillation import denoising_loss
    from physics3d.scenes.stems import MODE, SPEED, Look, Poke, Stem, Swaying, film, front

    stem = Stem(cubes=19, blossom=1.9, flat=0.9)
    swaying, poke = Swaying.of(stem, log=Log(None)), Poke(speed=SPEED, azimuth=0.1)
    look = Look(blossom=(0.8, 0.2, 0.3), stem=(0.3, 0.5, 0.2), camera=front(12.0, 3.0))
    prior, losses = TinyVideo(ratio=(1.0, 5.0)), {}
    for factor in (0.25, 1.0, 4.0):
        clip = film(stem, look, *swaying.move(stem, poke, modulus=torch.tensor(factor * MODE)))
        losses[factor] = denoising_loss(
            prior, clip, prior.condition(clip[0], ()), generator=torch.Generator().manual_seed(0)
        )
    # the weights come with a tenth of the motion's square as their own error; the valley is deeper than that
    assert losses[1.0] < 0.8 * min(losses[0.25], losses[4.0]), losses
