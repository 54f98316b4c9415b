"""Laws that every video prior obeys, and the closed forms of the exemplar prior."""

import math

import pytest
import torch

from physics3d.priors.base import AbstractPrior, Level, x0_from
from physics3d.priors.distillation import distillation_loss
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.priors.exemplar import Exemplar
from physics3d.priors.modelscope import ModelScope
from physics3d.priors.stable_video import StableVideo

LEVELS = {  # (alpha, sigma) that each parametrisation is used with
    "epsilon": (0.8, 0.6),
    "v_prediction": (0.8, 0.6),
    "v_prediction in sigma space": (1.0, 3.0),
    "flow_prediction": (0.4, 0.6),
}


def distilled(prior, video, condition, *, generator):
    """The loss of plain score distillation."""
    return distillation_loss(prior, ScoreDistillation(), video, condition, generator=generator)


def clip(seed: int, shape=(3, 8, 10, 3), dtype=torch.float64):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def network_output(prediction, z0, noise, level):
    """What a perfect network of that kind puts out: the definitions, written independently of x0_from."""
    r = math.hypot(level.alpha, level.sigma)
    match prediction:
        case "epsilon":
            return noise
        case "v_prediction":
            return (level.alpha * noise - level.sigma * z0) / r
        case "flow_prediction":
            return noise - z0


@pytest.mark.parametrize("case", LEVELS)
def test_a_perfect_network_of_any_kind_gives_back_the_clean_code(case):
    prediction, (alpha, sigma) = case.split(" ")[0], LEVELS[case]
    z0, noise, level = clip(0), clip(1) - 0.5, Level(alpha=alpha, sigma=sigma)
    estimate = x0_from(prediction, network_output(prediction, z0, noise, level), alpha * z0 + sigma * noise, level)
    # float64, a few operations
    torch.testing.assert_close(estimate, z0, rtol=0, atol=1e-13)


def test_unknown_prediction_is_refused():
    with pytest.raises(ValueError, match="prediction_type"):
        x0_from("velocity", clip(0), clip(1), Level(alpha=1, sigma=1))


def test_one_exemplar_gives_the_closed_form_gradient():
    prior = Exemplar(blur=(0.0,))
    x, y = clip(0).requires_grad_(), clip(1)
    distilled(prior, x, prior.condition(y[0], (y,)), generator=torch.Generator().manual_seed(3)).backward()
    torch.testing.assert_close(x.grad, x.detach() - y, rtol=0, atol=1e-14)  # w = 1, encode = identity


def test_pyramid_gradient_is_that_of_the_filtered_difference():
    prior = Exemplar(blur=(1.0, 3.0))
    x, y = clip(0).requires_grad_(), clip(1)
    distilled(prior, x, prior.condition(y[0], (y,)), generator=torch.Generator().manual_seed(3)).backward()
    expected = torch.autograd.functional.vjp(prior.encode, x.detach(), prior.encode(x.detach() - y))[1]
    torch.testing.assert_close(x.grad, expected, rtol=0, atol=1e-12)  # A^T A (x - y) because A is linear


def test_gradient_vanishes_at_the_exemplar_and_only_there():
    prior = Exemplar(blur=(1.0, 3.0))
    y = clip(1)
    for x, zero in ((y.clone(), True), (y + 0.01, False)):
        x.requires_grad_()
        distilled(prior, x, prior.condition(y[0], (y,)), generator=torch.Generator().manual_seed(3)).backward()
        assert (x.grad.abs().max() == 0) == zero


@pytest.mark.parametrize("sigma", [0.3, 2.0, 100.0])
def test_two_exemplars_give_the_posterior_mean(sigma):
    prior = Exemplar(blur=(0.0,))
    y1, y2 = clip(1), clip(2)
    codes = prior.condition(y1[0], (y1, y2))
    z_t = prior.encode(0.6 * y1 + 0.4 * y2)
    # the odds of y1 follow from the two distances 0.4 d and 0.6 d with d = |y1 - y2|
    d2 = ((y1 - y2) ** 2).sum()
    p = torch.sigmoid(-(0.16 - 0.36) * d2 / (2 * sigma**2))
    expected = (p * y1 + (1 - p) * y2).permute(0, 3, 1, 2).flatten()
    torch.testing.assert_close(prior.x0_hat(z_t, Level(alpha=1, sigma=sigma), codes), expected, rtol=0, atol=1e-12)
    if sigma == 100.0:  # much noise: nothing is known, the mean of both, up to d^2/(20 sigma^2) = 1e-3
        torch.testing.assert_close(expected, codes.mean(0), rtol=0, atol=1e-3)


def test_exemplar_is_stable_at_tiny_noise():
    prior = Exemplar(blur=(0.0,))
    codes = prior.condition(clip(1)[0], (clip(1), clip(2)))
    estimate = prior.x0_hat(codes[0] + 1e-3, Level(alpha=1, sigma=1e-9), codes)  # exponents near -1e19
    assert torch.equal(estimate, codes[0])


def test_blur_sees_a_small_thing_move_beyond_its_width():
    """A 1 px dot, 6 px from where it should be: sharp images give no gradient, blurred ones point the right way."""

    def gradient(prior):
        u = torch.arange(40, dtype=torch.float64)
        dot = lambda centre: torch.exp(-0.5 * (u - centre) ** 2 / 0.6**2)[None, None, :, None].expand(2, 30, 40, 3)
        centre = torch.tensor(14.0, dtype=torch.float64, requires_grad=True)
        reference = dot(20.0)
        distilled(
            prior, dot(centre), prior.condition(reference[0], (reference,)), generator=torch.Generator()
        ).backward()
        return float(centre.grad)

    assert abs(gradient(Exemplar(blur=(0.0,)))) < 1e-6
    assert gradient(Exemplar(blur=(5.0,))) < -1e-2  # descending moves the dot towards 20


def test_same_seed_same_gradient_other_seed_other_noise():
    prior = Exemplar(blur=(0.0,), sigma=(5.0, 5.0))
    y1, y2 = clip(1), clip(2)
    codes = prior.condition(y1[0], (y1, y2))
    x = 0.5 * (y1 + y2)
    loss = [float(distilled(prior, x, codes, generator=torch.Generator().manual_seed(s))) for s in (0, 0, 1)]
    assert loss[0] == loss[1] != loss[2]


@pytest.mark.parametrize(
    "build, word",
    [
        (lambda: Exemplar(blur=()), "prior.blur"),
        (lambda: Exemplar(sigma=(1.0, 0.1)), "prior.sigma"),
        (lambda: Exemplar().condition(clip(0)[0], ()), "role learn"),
        (lambda: Exemplar().condition(clip(0)[0], (clip(0), clip(0)[:2])), "equal shape"),
        (lambda: StableVideo(width=1001), "prior.width is 1001; take .* a multiple of 8"),
        (lambda: StableVideo(sigma=(0.0, 1.0)), "prior.sigma"),
        (lambda: ModelScope(prompt=" "), "prior.prompt"),
        (lambda: ModelScope(prompt="x", time=(0.5, 0.1)), "prior.time"),
    ],
)
def test_bad_options_name_the_field(build, word):
    with pytest.raises(ValueError, match=word):
        build()


def test_exemplars_and_video_of_different_size_are_refused():
    prior = Exemplar()
    codes = prior.condition(clip(0)[0], (clip(0),))
    with pytest.raises(ValueError, match="as many frames"):
        distilled(prior, clip(0)[:2], codes, generator=torch.Generator())


# --- diffusion models, tiny and random ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    from tiny_models import save_modelscope, save_stable_video

    folder = tmp_path_factory.mktemp("models")
    save_stable_video(folder / "svd")
    save_modelscope(folder / "ms")
    options = {"variant": None, "precision": "float32", "device": "cpu", "height": 16, "width": 16}
    return {
        "stable_video": StableVideo(model=str(folder / "svd"), **options),
        "modelscope": ModelScope(model=str(folder / "ms"), prompt="a flower sways", **options),
    }


@pytest.mark.parametrize("name", ["stable_video", "modelscope"])
def test_gradient_reaches_every_frame_of_the_pixels(models, name):
    prior: AbstractPrior = models[name]
    video = clip(5, (4, 16, 16, 3), torch.float32).requires_grad_()
    condition = prior.condition(video.detach()[0], (video.detach(),))
    loss = distilled(prior, video, condition, generator=torch.Generator().manual_seed(0))
    loss.backward()
    assert torch.isfinite(video.grad).all() and (video.grad.flatten(1).norm(dim=1) > 0).all()
    assert all(p.grad is None for p in prior.pipeline.unet.parameters())


@pytest.mark.parametrize("name", ["stable_video", "modelscope"])
def test_gradient_is_the_score_pulled_back_through_the_encoder_alone(models, name):
    """Equal to vjp(encode)(w (z0 - x0_hat)) with level and noise drawn again from the seed: no network Jacobian."""
    prior: AbstractPrior = models[name]
    video = clip(5, (3, 16, 16, 3), torch.float32).requires_grad_()
    condition = prior.condition(video.detach()[0], (video.detach(),))
    distilled(prior, video, condition, generator=torch.Generator().manual_seed(7)).backward()
    generator = torch.Generator().manual_seed(7)
    level = prior.level(float(torch.rand((), generator=generator)))
    z0 = prior.encode(video)
    with torch.no_grad():
        noise = torch.randn(z0.shape, generator=generator)
        score = prior.weight(level) * (z0 - prior.x0_hat(level.alpha * z0 + level.sigma * noise, level, condition))
    expected = torch.autograd.grad(z0, video, score)[0]
    torch.testing.assert_close(video.grad, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))  # float32


@pytest.mark.parametrize("name", ["stable_video", "modelscope"])
def test_a_perfect_network_gives_exactly_no_gradient(models, name, monkeypatch):
    """A network that knows z0 and answers in its own parametrisation: x0_hat is z0, the gradient zero."""
    prior: AbstractPrior = models[name]
    video = clip(6, (3, 16, 16, 3), torch.float32).requires_grad_()
    condition = prior.condition(video.detach()[0], (video.detach(),))
    z0 = prior.encode(video).detach()
    generator = torch.Generator().manual_seed(1)
    level = prior.level(float(torch.rand((), generator=generator)))
    noise = torch.randn(z0.shape, generator=generator)
    kind = prior.pipeline.scheduler.config.prediction_type
    output = network_output(kind, z0, noise, level)
    stacked = {"stable_video": output[None], "modelscope": output.transpose(0, 1)[None]}[name].repeat(2, 1, 1, 1, 1)
    monkeypatch.setattr(prior.pipeline.unet, "forward", lambda *args, **kwargs: (stacked,))
    estimate = prior.x0_hat(level.alpha * z0 + level.sigma * noise, level, condition)
    torch.testing.assert_close(estimate, z0, rtol=0, atol=2e-5)  # float32: sigma eps with sigma up to 30 cancels
    distilled(prior, video, condition, generator=torch.Generator().manual_seed(1)).backward()
    assert float(video.grad.abs().max()) < 1e-4 * float(z0.abs().max() / 0.18)


def test_stable_video_agrees_with_the_euler_scheduler(models):
    """x0_hat = pred_original_sample of diffusers' scheduler, fed as diffusers' pipeline feeds it."""
    prior: StableVideo = models["stable_video"]
    pipe = prior.pipeline
    video = clip(5, (4, 16, 16, 3), torch.float32)
    condition = prior.condition(video[0], (video,))
    pipe.scheduler.set_timesteps(6)
    for index in (1, 3):
        sigma, time = float(pipe.scheduler.sigmas[index]), pipe.scheduler.timesteps[index]
        level = Level(alpha=1.0, sigma=sigma, time=math.log(sigma) / 4)
        assert level.time == pytest.approx(float(time), abs=1e-5)
        z_t = prior.encode(video) + sigma * torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(2))
        pipe.scheduler._step_index = None
        scaled = pipe.scheduler.scale_model_input(torch.stack([z_t, z_t]), time)
        latents = torch.stack([torch.zeros_like(z_t), condition.latent.expand(4, -1, -1, -1)])
        ids = pipe._get_add_time_ids(
            prior.fps - 1, prior.motion_bucket, prior.noise_strength, torch.float32, 1, 1, True
        )
        embedding = torch.cat([torch.zeros_like(condition.embedding), condition.embedding])
        with torch.no_grad():
            out = pipe.unet(torch.cat([scaled, latents], 2), time, encoder_hidden_states=embedding, added_time_ids=ids)[
                0
            ]
        out = out[:1] + torch.linspace(1, 3, 4)[None, :, None, None, None] * (out[1:] - out[:1])
        expected = pipe.scheduler.step(out, time, z_t[None], s_churn=0.0).pred_original_sample[0]
        with torch.no_grad():
            ours = prior.x0_hat(z_t, level, condition)
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))  # float32


def test_stable_video_embeds_the_image_as_its_pipeline_does(models):
    prior: StableVideo = models["stable_video"]
    image = clip(8, (16, 16, 3), torch.float32)
    expected = prior.pipeline._encode_image(image.permute(2, 0, 1)[None], "cpu", 1, False)
    torch.testing.assert_close(prior.condition(image, ()).embedding, expected, rtol=1e-4, atol=1e-5)


def test_modelscope_agrees_with_the_ddim_scheduler(models):
    prior: ModelScope = models["modelscope"]
    pipe = prior.pipeline
    video = clip(5, (4, 16, 16, 3), torch.float32)
    pipe.scheduler.set_timesteps(10)
    z0 = prior.encode(video)
    for time in pipe.scheduler.timesteps[[1, 6]]:
        abar = float(pipe.scheduler.alphas_cumprod[time])
        level = Level(alpha=math.sqrt(abar), sigma=math.sqrt(1 - abar), time=float(time))
        z_t = level.alpha * z0 + level.sigma * torch.randn(z0.shape, generator=torch.Generator().manual_seed(2))
        batch = z_t.transpose(0, 1)[None]
        with torch.no_grad():
            out = pipe.unet(batch.repeat(2, 1, 1, 1, 1), time, encoder_hidden_states=prior.embedding)[0]
        out = out[:1] + prior.guidance * (out[1:] - out[:1])
        frames = out[0].transpose(0, 1)  # as the pipeline: frames as the batch of the scheduler
        expected = pipe.scheduler.step(frames, time, z_t).pred_original_sample
        with torch.no_grad():
            ours = prior.x0_hat(z_t, level, prior.condition(video[0], ()))
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))  # float32


@pytest.mark.parametrize("kind", [lambda m: StableVideo(model=m), lambda m: ModelScope(model=m, prompt="x")])
def test_missing_weights_give_one_message_naming_the_key(kind, tmp_path, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    for name in (str(tmp_path / "nowhere"), "nobody/no-such-model"):
        with pytest.raises(ValueError, match=r"prior\.model"):
            _ = kind(name).pipeline
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"prior\.model"):
        _ = kind(str(tmp_path / "empty")).pipeline


def test_a_single_frame_is_refused(models):
    for prior in models.values():
        with pytest.raises(ValueError, match=r"learn\.frames"):
            prior.encode(clip(0, (1, 16, 16, 3), torch.float32))
