"""A thing that was never filmed: its material learned from what a video model holds probable, stage by stage as a run
does it, with a small random Stable Video Diffusion; and what is said where weights are absent."""

import pytest
from small_scene import bar
from tiny_models import save_stable_video

from physics3d.gaussians.ply import write_ply
from pipeline.flow import built, first, idle, plan, suit
from pipeline.settings import compose
from pipeline.stage import StageError, load, run

# the bar of small_scene, poked at its top as there
POKE = (
    "{_target_: physics3d.boundaries.impulse.Impulse, force: [0.0, 0.0, 0.0], centre: [0.0, 0.0, 0.4], radius: 0.12, "
)
SCENE = (
    "scene=trained", "profile=smoke", "device=cpu", "scene.dx=0.05", "scene.spacing=0.025", "simulate.frames=6",
    "scene.gravity=[0.0,0.0,0.0]", "scene.boundaries.0.kind=sticky", "scene.boundaries.0.point=[0.0,0.0,0.06]",
    f"scene.excitation=[{POKE}start: 0.0, duration: 0.1}}]", "simulate.force.x=1.2",
    "scene.source.views=8", "scene.source.width=64", "scene.source.height=48",
)  # fmt: skip
LEARNING = ("learn.frames=4", "learn.steps=2", "learn.search=0", "learn.image_scale=1.0")
PRIOR = ("prior.variant=null", "prior.precision=float32", "prior.height=16", "prior.width=16")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    save_stable_video(folder / "svd")
    write_ply(folder / "bar.ply", bar()[0])
    return folder


def words(folder, *more):
    return [*SCENE, f"data={folder / 'bar.ply'}", f"output={folder}", "prior=stable_video", *PRIOR, *LEARNING, *more]


def through(folder, *more):
    """Every stage in its turn, as `pipeline.flow.execute` runs them, without a server."""
    config, _ = compose(words(folder, *more))
    stages = built(config, "cpu")
    capture = first(config, folder / "artifacts")
    run(capture, "cpu")
    whole = plan(config, capture)
    suit(stages, load(capture, "cpu").outline, idle(config) | whole.left_out)
    for step in whole.steps:
        run(step, "cpu")
    return whole


def test_material_is_learned_from_what_a_video_model_holds_probable(folder):
    whole = through(folder, f"prior.model={folder / 'svd'}")
    names = [step.name for step in whole.steps]
    assert names == ["capture", "guess", "fill", "learn", "simulate", "render"]
    assert set(whole.left_out) == {"reconstruct", "segment", "evaluate"}
    learn = whole.steps[names.index("learn")]
    told = (learn.folder / "log.txt").read_text()
    assert "from take imagined: 4 frames" in told and "GB on cpu" in told and "no intervals" in told
    assert "4 frames are shown to a prior that was trained on clips of" in told
    estimate, guess = load(learn, "cpu"), load(whole.steps[1], "cpu")
    moved = [k for k, v in estimate.parameters.items() if float(v) != float(guess.parameters[k])]
    assert moved and all(bool(estimate.parameters[name].isfinite().all()) for name in moved)


@pytest.mark.parametrize("prior", ["stable_video", "modelscope", "wan", "wan_image"])
def test_absent_weights_are_one_line_before_the_first_stage_that_computes(folder, prior):
    here = (f"data={folder / 'bar.ply'}", f"output={folder}", f"prior={prior}", "prior.model=./nowhere")
    config, _ = compose([*SCENE, *LEARNING, *here])
    with pytest.raises(StageError, match=r"learn: prior\.model=\./nowhere is not a folder") as caught:
        built(config, "cpu")
        capture = first(config, folder / "artifacts")
        run(capture, "cpu")
        plan(config, capture)
    assert "\n" not in str(caught.value)
