"""Wan obeys the laws of every prior, agrees with diffusers' own pipelines, and the memory of all diffusion priors is
known before they are loaded. Tiny random models of the same classes; no published weights."""

from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from tiny_models import save_modelscope, save_stable_video, save_wan
from torch.profiler import ProfilerActivity, profile

from physics3d.priors.base import Level
from physics3d.priors.distillation import distillation_loss
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.priors.memory import Memory, parameter_bytes
from physics3d.priors.modelscope import ModelScope
from physics3d.priors.stable_video import StableVideo
from physics3d.priors.wan import Wan
from physics3d.priors.weights import hollow_pipeline

WANS = ("wan", "wan_image")
SHAPE = (9, 32, 32, 3)  # three codes: two groups of pieces, the second of one


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    save_stable_video(folder / "svd")
    save_modelscope(folder / "ms")
    save_wan(folder / "wan", image=False)
    save_wan(folder / "wan_image", image=True)
    old = {"variant": None, "precision": "float32", "device": "cpu", "height": 16, "width": 16}
    new = {"precision": "float32", "vae_precision": "float32", "device": "cpu", "height": 32, "width": 32}
    words = "a flower sways"
    return {
        "stable_video": StableVideo(model=str(folder / "svd"), **old),
        "modelscope": ModelScope(model=str(folder / "ms"), prompt=words, **old),
        "wan": Wan(model=str(folder / "wan"), prompt=words, **new),
        "wan_image": Wan(model=str(folder / "wan_image"), prompt=words, first_image=True, **new),
    }


def clip(seed, shape=SHAPE):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def pulled(prior, video, condition, seed):
    loss = distillation_loss(
        prior, ScoreDistillation(), video, condition, generator=torch.Generator().manual_seed(seed)
    )
    return torch.autograd.grad(loss, video)[0]


def own_codes(prior, video):
    """As diffusers' pipelines encode a video: the VAE's own `encode`, of a VAE as it is published, then mean and
    standard deviation."""
    from diffusers import AutoencoderKLWan

    vae = AutoencoderKLWan.from_pretrained(prior.model, subfolder="vae").requires_grad_(False)
    means = vae.encode((2 * video - 1).permute(3, 0, 1, 2)[None]).latent_dist.mode()
    mean, std = (torch.tensor(v).view(1, -1, 1, 1, 1) for v in (vae.config.latents_mean, vae.config.latents_std))
    return ((means - mean) / std)[0].transpose(0, 1)


# ---- the laws of priors


@pytest.mark.parametrize("name", WANS)
def test_codes_and_their_gradient_are_those_of_the_published_encoder(models, name):
    """In pieces and recomputed layer by layer, or all at once: the same numbers, up to float32."""
    prior = models[name]
    ours, theirs = clip(1).requires_grad_(), clip(1).requires_grad_()
    codes, expected = prior.encode(ours), own_codes(prior, theirs)
    assert codes.shape == expected.shape and codes.shape[0] == 3
    torch.testing.assert_close(codes, expected, rtol=1e-4, atol=1e-5)
    pull = torch.randn(codes.shape, generator=torch.Generator().manual_seed(2))
    codes.backward(pull)
    expected.backward(pull)
    torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-3, atol=1e-4 * float(theirs.grad.abs().max()))


@pytest.mark.parametrize("name", WANS)
def test_gradient_reaches_every_frame_and_is_pulled_back_through_the_encoder_alone(models, name):
    prior, video = models[name], clip(5).requires_grad_()
    condition = prior.condition(video.detach()[0], ())
    found = pulled(prior, video, condition, 7)
    assert torch.isfinite(found).all() and (found.flatten(1).norm(dim=1) > 0).all()
    assert all(p.grad is None for p in prior.pipeline.transformer.parameters())
    generator = torch.Generator().manual_seed(7)
    level = prior.level(float(torch.rand((), generator=generator)))
    z0 = prior.encode(video)
    with torch.no_grad():
        noise = torch.randn(z0.shape, generator=generator)
        score = prior.weight(level) * (z0 - prior.x0_hat(level.alpha * z0 + level.sigma * noise, level, condition))
    expected = torch.autograd.grad(z0, video, score)[0]
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))  # float32


@pytest.mark.parametrize("name", WANS)
def test_a_perfect_network_gives_no_gradient(models, name, monkeypatch):
    """One that knows z0 and answers n - z0, the velocity from picture to noise."""
    prior, video = models[name], clip(6).requires_grad_()
    condition = prior.condition(video.detach()[0], ())
    z0 = prior.encode(video).detach()
    generator = torch.Generator().manual_seed(1)
    torch.rand((), generator=generator)  # of the level
    velocity = torch.randn(z0.shape, generator=generator) - z0
    answer = lambda *args, **kwargs: (velocity.transpose(0, 1)[None],)
    monkeypatch.setattr(prior.pipeline.transformer, "forward", answer)
    largest = float(torch.autograd.grad(prior.encode(video).square().sum(), video)[0].abs().max())
    # against the pull to a grey code; float32
    assert float(pulled(prior, video, condition, 1).abs().max()) < 1e-5 * largest


@pytest.mark.parametrize("name", WANS)
def test_half_precision_is_the_same_up_to_its_rounding(models, name):
    """Some layers stay in float32 by themselves. 5 %: bfloat16 has 8 bits, a few tens of layers follow each other;
    guidance, which would enlarge the difference, is off."""
    exact, video = replace(models[name], guidance=1.0), clip(4)
    half = replace(exact, precision="bfloat16", vae_precision="bfloat16")
    z0, rounded = exact.encode(video), half.encode(video)
    assert rounded.dtype == torch.float32 and float((rounded - z0).norm() / z0.norm()) < 0.05
    with torch.no_grad():
        answers = [p.x0_hat(z0, p.level(0.5), p.condition(video[0], ())) for p in (exact, half)]
    assert 0 < float((answers[1] - answers[0]).norm() / answers[0].norm()) < 0.05


# ---- diffusers' pipelines


@pytest.mark.parametrize("name", WANS)
def test_estimate_is_the_clean_end_of_a_step_of_the_flow_scheduler(models, name):
    """Fed as diffusers' pipelines feed it; its Euler step from sigma to 0 is sample - sigma v."""
    from diffusers import FlowMatchEulerDiscreteScheduler

    prior, video = models[name], clip(5)
    pipe, z0 = prior.pipeline, prior.encode(video)
    condition = prior.condition(video[0], ())
    for sigma in (0.25, 0.9):
        scheduler = FlowMatchEulerDiscreteScheduler()
        scheduler.set_timesteps(sigmas=[sigma])
        time = scheduler.timesteps[0]
        z_t = (1 - sigma) * z0 + sigma * torch.randn(z0.shape, generator=torch.Generator().manual_seed(2))
        latents, times = z_t.transpose(0, 1)[None], time.expand(1)
        if name == "wan_image":
            mask = torch.ones(1, 1, *latents.shape[2:])
            mask[:, :, 0] = 0
            image = own_codes(prior, video[:1]).transpose(0, 1)[None]
            latents = (1 - mask) * image + mask * latents
            times = (mask[0][0][:, ::2, ::2] * time).flatten()[None]
        with torch.no_grad():
            none, given = (pipe.transformer(latents, times, text[None])[0] for text in prior.embedding)
            ours = prior.x0_hat(z_t, Level(alpha=1 - sigma, sigma=sigma, time=float(time)), condition)
        expected = scheduler.step(none + prior.guidance * (given - none), time, z_t.transpose(0, 1)[None])[0]
        if name == "wan_image":
            expected = (1 - mask) * image + mask * expected
        torch.testing.assert_close(ours, expected[0].transpose(0, 1), rtol=1e-4, atol=1e-4)  # float32


def test_levels_are_those_of_the_published_schedule(models):
    prior = replace(models["wan"], time=(0.0, 1.0))
    vars(prior)["pipeline"] = models["wan"].pipeline
    scheduler = prior.pipeline.scheduler
    scheduler.set_timesteps(8)
    for u, sigma, time in zip(torch.linspace(1, 1e-3, 9)[1:-1], scheduler.sigmas[1:], scheduler.timesteps[1:]):
        level = prior.level(float(u))
        assert level.sigma == pytest.approx(float(sigma), abs=1e-6)  # float32
        assert abs(level.time - float(time)) <= 1, "the scheduler's times are whole numbers"
        assert level.alpha == pytest.approx(1 - level.sigma)


def test_the_sentence_is_read_as_the_pipeline_reads_it(models):
    """Without what pads it, then padded: the same as padded and masked."""
    from diffusers import WanPipeline

    pipe = WanPipeline.from_pretrained(models["wan"].model)
    given, none = pipe.encode_prompt("a flower sways", "", max_sequence_length=512)
    torch.testing.assert_close(models["wan"].embedding, torch.cat([none, given]), rtol=1e-4, atol=1e-5)  # float32
    assert (models["wan"].embedding[1, :5].norm(dim=-1) > 0).tolist() == [True] * 4 + [False]  # three words and an end


# ---- what is refused


@pytest.mark.parametrize(
    "frames, near", [(2, "take 5 "), (8, "5 or 9"), (12, "9 or 13"), (80, "77 or 81"), (1, "take 5 ")]
)
def test_numbers_of_frames_that_do_not_fit_name_those_that_do(models, frames, near):
    with pytest.raises(ValueError, match=rf"learn.frames is {frames}; .*{near}"):
        models["wan"].encode(clip(0, (frames, 32, 32, 3)))


@pytest.mark.parametrize(
    "change, word",
    [
        ({"height": 40}, "prior.height is 40; take .* a multiple of 16"),
        ({"precision": "int8"}, "prior.precision"),
        ({"prompt": " "}, "prior.prompt"),
        ({"time": (0.9, 0.1)}, "prior.time"),
    ],
)
def test_bad_options_name_the_field(models, change, word):
    with pytest.raises(ValueError, match=word):
        replace(models["wan"], **change)


def test_what_the_weights_cannot_do_is_said_before_they_are_loaded(models, tmp_path, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    (tmp_path / "empty").mkdir()
    for wrong, word in (
        (replace(models["wan"], first_image=True), "prior.first_image is true"),
        (replace(models["wan_image"], height=48), "prior.height is 48; take a multiple of 32"),
        (replace(models["wan"], model=str(tmp_path / "nowhere")), "prior.model=.* is not a folder"),
        (replace(models["wan"], model="nobody/no-such-model"), "the weights of prior.model=nobody/no-such-model"),
        (replace(models["wan"], model=str(tmp_path / "empty")), "prior.model=.* no WanPipeline can be read"),
    ):
        for asked in (lambda: wrong.memory(9), lambda: wrong.pipeline):  # noqa: B023
            with pytest.raises(ValueError, match=word) as caught:
                asked()
            assert "\n" not in str(caught.value)


# ---- memory


@pytest.mark.parametrize("name", ["stable_video", "modelscope", *WANS])
def test_the_memory_of_parameters_is_that_of_the_files(models, name):
    """Counted from the headers of the published files, of which not one number is read."""
    prior = models[name]
    hollow = hollow_pipeline(
        type(prior.pipeline), prior.model, key="prior.model", dtype=torch.float32, variant=None, without=("tokenizer",)
    )
    networks = {part: module for part, module in hollow.components.items() if isinstance(module, torch.nn.Module)}
    assert len(networks) == 3
    for part, module in networks.items():
        assert all(p.is_meta for p in module.parameters()), f"{part} has weights"
        assert parameter_bytes(module) == in_files(prior, part), part


def in_files(prior, part):
    total = 0
    for file in prior.files():
        if f"/{part}/" in file and file.endswith(".safetensors"):
            with safe_open(file, "pt") as stored:
                shapes = [stored.get_slice(key).get_shape() for key in stored.keys()]  # noqa: SIM118
                total += sum(4 * torch.Size(shape).numel() for shape in shapes)
    return total


@pytest.mark.parametrize("name", ["stable_video", "modelscope", *WANS])
def test_what_is_said_beforehand_is_what_it_takes(models, name):
    """The largest sum of living allocations of one step, as torch's profiler saw them on the CPU, beside parameters.

    There a convolution in three dimensions copies every input 27 times, which a GPU does not and the estimate leaves
    out: of Wan's VAE with 8 channels of a piece. 20 %: what other operations there take for themselves.
    """
    prior, frames = replace(models[name], height=64, width=64), 5
    video = clip(0, (frames, 64, 64, 3)).requires_grad_()
    condition = prior.condition(video.detach()[0], ())
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as seen:
        pulled(prior, video, condition, 0)
    networks = [m for m in prior.pipeline.components.values() if isinstance(m, torch.nn.Module)]
    weights = sum(map(parameter_bytes, networks))
    copies = {"wan": 27 * 8 * 4 * 64 * 64 * 4, "wan_image": 27 * 8 * 4 * 32 * 32 * 4}.get(name, 0)
    assert prior.memory(frames).needed + copies == pytest.approx(weights + largest(seen), rel=0.2)
    assert largest(seen) > 1.5 * copies, "or the copies alone would do"


def largest(seen):
    now = most = 0
    events = [e for e in seen.profiler.kineto_results.events() if e.name() == "[memory]"]
    for event in sorted(events, key=lambda e: e.start_ns()):
        now += event.nbytes()
        most = max(most, now)
    return most


def test_what_does_not_fit_is_refused_with_the_remedy(models):
    huge = replace(models["wan"], height=16384, width=16384)
    with pytest.raises(ValueError, match=r"the prior takes about .* GB of .* GB on cpu; lower prior.height"):
        huge.memory(81).require()
    assert "on cpu" in models["wan"].memory(9).require()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_device_that_is_not_there_is_said():
    with pytest.raises(ValueError, match=r"prior\.device is cuda:1, and there is no GPU here"):
        Memory(device="cuda:1", needed=1, remedy="").require()


@pytest.mark.parametrize("name", ["modelscope", "wan"])
def test_offload_takes_less_of_the_device_and_answers_the_same(models, name):
    prior, frames = models[name], 5
    here, there = (replace(prior, device="cuda", offload=offload).memory(frames) for offload in (False, True))
    assert there.needed < here.needed and there.beside > here.beside
    lean = replace(prior, offload=True)
    video = clip(3, (frames, prior.height, prior.width, 3))
    z0 = prior.encode(video)
    with torch.no_grad():
        answers = [p.x0_hat(z0, p.level(0.3), p.condition(video[0], ())) for p in (prior, lean)]
    assert torch.equal(*answers)
