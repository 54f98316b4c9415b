"""The graph, and whole runs of it under Prefect and MLflow, on throw-away stages."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from toy import ALL, configuration

from pipeline.flow import built, first, left_out, plan, suit
from pipeline.page import STAGES
from pipeline.settings import choices, compose
from pipeline.stage import StageError, build, run
from pipeline.tracking import EXPERIMENT, address, flatten

ROOT = Path(__file__).resolve().parent.parent.parent
RUN = """
import json, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests in the background ignores it
from pipeline import __main__ as command
config = json.loads(sys.argv[1])
command.compose = lambda words: (config, dict.fromkeys(command.GROUPS, "toy"))
code = command.main([])
if sys.argv[2:] == ["light"]:
    print("imported:", [m for m in ("torch", "warp", "prefect", "mlflow") if m in sys.modules])
sys.exit(code)
"""


@pytest.mark.parametrize(
    "changes, missing, steps",
    [
        ({}, {}, ALL),
        ({"capture": {"trained": True}}, {"reconstruct": "trained model"}, [s for s in ALL if s != "reconstruct"]),
        ({"capture": {"single_object": True}}, {"segment": "single object"}, [s for s in ALL if s != "segment"]),
        (
            {"capture": {"roles": []}},
            {"learn": "no recorded motion", "evaluate": "no recorded motion"},
            ["capture", "guess", "reconstruct", "segment", "fill", "simulate", "render"],
        ),
        (
            {"learn": None},
            {"learn": "learn=null"},
            ["capture", "guess", "reconstruct", "segment", "fill", "simulate", "render", "evaluate"],
        ),
        ({"capture": {"roles": ["learn"]}}, {}, ALL),
    ],
    ids=["everything", "trained model", "single object", "no recording", "method without learning", "learn only"],
)
def test_a_scene_leaves_out_what_it_does_not_need_and_says_why(tmp_path, changes, missing, steps):
    config = configuration(tmp_path, **changes)
    capture = first(config, tmp_path / "artifacts")
    run(capture, "cpu")
    whole = plan(config, capture)
    assert [s.name for s in whole.steps] == steps
    assert whole.left_out.keys() == missing.keys()
    assert all(missing[name] in why for name, why in whole.left_out.items())


def test_what_is_left_out_says_the_time_it_took_elsewhere(tmp_path):
    config = configuration(tmp_path)
    for folder, seconds in (("a", 10.0), ("b", 20.0), ("c", 90.0)):
        place = tmp_path / "artifacts" / "segment" / folder
        place.mkdir(parents=True)
        told = {"stage": "segment", "fingerprint": folder, "seconds": seconds, "peak_rss_bytes": 1}
        (place / "manifest.json").write_text(json.dumps(told | {"files": {"fields.json": [0, ""]}}))
    config["capture"]["single_object"] = True
    capture = first(config, tmp_path / "artifacts")
    run(capture, "cpu")
    # the median of the three
    assert "20 s" in plan(config, capture).left_out["segment"]


@pytest.mark.parametrize(
    "word, message",
    [
        ("learn.frames=15 learn.duration=0.1", r"learn: learn\.frames is 15, but take learn has 4 frames in 0\.1 s"),
        ("scene.prompts.0.view=view_040", r"segment: prompt: view 'view_040' is not in carnation; .*view_000"),
        ("scene.prompts=[]", r"segment: segment\.prompts is empty and carnation has no mattes"),
    ],
)
def test_a_stage_that_cannot_take_the_scene_is_refused_before_the_scene_is_made(word, message):
    config, _ = compose(["scene=carnation", *word.split()])
    stages = {name: build(config[name], "cpu", name) for name in STAGES}
    with pytest.raises(StageError, match=message):
        suit(stages, stages["capture"].source.outline, {})
    suit(stages, stages["capture"].source.outline, {"learn": "left out", "segment": "left out"})


@pytest.mark.parametrize("prior", choices("prior"))
def test_learning_without_a_recording_is_left_out_only_for_priors_that_need_one(tmp_path, prior):
    """Python's own answer is the truth; the graph reads it off the source."""
    config, _ = compose(["scene=plush", f"prior={prior}"])
    bare = {"takes": [], "gaussians": None, "single_object": False, "images": True}
    module, _, name = config["prior"]["_target_"].rpartition(".")
    needs = getattr(__import__(module, fromlist=[name]), name).needs_clip
    assert ("learn" in left_out(config, bare, tmp_path)) == needs == (prior == "exemplar")
    assert "evaluate" in left_out(config, bare, tmp_path)


def test_what_would_be_imagined_changes_nothing_where_a_motion_was_recorded(tmp_path):
    """Another poke to simulate is no other recording to learn from; without one it is."""
    (tmp_path / "weights").mkdir()
    prior = {"_target_": "physics3d.priors.modelscope.ModelScope", "prompt": "x", "model": str(tmp_path / "weights")}
    for roles, same in ((["learn", "evaluate"], True), ([], False)):
        keys = []
        for force in (1.0, 2.0):
            imagined = {"_target_": "toy.Material", "modulus": force}
            learn = {"imagined": imagined, "prior": prior}
            config = configuration(tmp_path, capture={"roles": roles}, learn=learn)
            capture = first(config, tmp_path / "artifacts")
            run(capture, "cpu")
            keys += [step.fingerprint for step in plan(config, capture).steps if step.name == "learn"]
        assert len(keys) == 2 and (keys[0] == keys[1]) == same


def test_initial_material_is_simulated_without_what_was_learned(tmp_path):
    config = configuration(tmp_path)
    capture = first(config, tmp_path / "artifacts")
    run(capture, "cpu")
    names = {step.name: step for step in plan(config, capture).steps}
    other = {step.name: step for step in plan(configuration(tmp_path, learn={"modulus": 3.0}), capture).steps}
    changed = {name for name in names if names[name].fingerprint != other[name].fingerprint}
    assert changed == {"learn", "simulate", "render", "evaluate"}


def start(config: dict, env: dict[str, str], *words: str) -> subprocess.Popen:
    call = [sys.executable, "-c", RUN, json.dumps(config), *words]
    pipe = subprocess.PIPE
    return subprocess.Popen(call, stdout=pipe, stderr=pipe, text=True, env=env, cwd=ROOT, start_new_session=True)


def test_a_run_its_record_and_the_run_after_it(tmp_path, prefect):
    config = configuration(tmp_path)
    process = start(config, prefect)
    out, err = process.communicate()
    assert process.returncode == 0, out + err
    assert "computed" in out and "reused" not in out and address(tmp_path) in out
    table = [line.split() for line in out.splitlines()]
    # start, learned, no interval, truth
    assert ["youngs_modulus", "1", "1.5", "no", "interval", "is", "known", "2"] in table
    assert ["learned", "11", "-"] in table, out  # every stage added its 1 to what it was given

    with sqlite3.connect(tmp_path / "mlflow.db") as record:
        runs = dict(record.execute("select run_uuid, status from runs").fetchall())
        assert set(runs.values()) == {"FINISHED"} and len(runs) == 1 + len(ALL)
        tags = set(record.execute("select key, value from tags where key in ('stage', 'cache', 'scene')").fetchall())
        assert {("stage", "learn"), ("cache", "miss"), ("scene", "toy")} <= tags
        parent = {key for (key,) in record.execute("select key from latest_metrics")}
        assert {"time/learn_s", "score/learned/psnr", "learned/youngs_modulus", "loss", "curve"} <= parent
        params = dict(record.execute("select key, value from params").fetchall())
        assert params["learn.modulus"] == "1.5"
        (experiment,) = record.execute(
            "select artifact_location from experiments where name=?", (EXPERIMENT,)
        ).fetchone()
        assert experiment == (tmp_path / "mlartifacts").as_uri()
    assert list((tmp_path / "mlartifacts").rglob("*.png")), "previews belong to the record"

    again, _ = start(config, prefect, "light").communicate()
    assert (
        "up to date: all 11 steps" in again
        and again.count("reused") == 11
        and "computed" not in again.split("up to")[0]
    )
    assert "imported: []" in again  # that is what makes it quick

    more, _ = start(configuration(tmp_path, learn={"modulus": 1.7}), prefect).communicate()
    assert more.count("computed") == 4 and more.count("reused") == 7  # learn, simulate, render, evaluate


def test_a_failing_stage_is_one_line_and_the_next_run_goes_on(folder, prefect):
    process = start(configuration(folder, learn={"error": "no motion\nin sight"}), prefect)
    out, err = process.communicate()
    assert process.returncode == 1
    (line,) = err.strip().splitlines()
    assert line.startswith("error: learn: no motion in sight (traceback: ")
    with sqlite3.connect(folder / "mlflow.db") as record:
        assert ("FAILED",) in record.execute("select status from runs").fetchall()
    out, _ = start(configuration(folder), prefect).communicate()
    assert out.count("reused") == 5 and out.count("computed") == 6


def test_bad_value_is_found_before_anything_runs(folder, prefect):
    config = configuration(folder, evaluate={"tolerance": 3})
    process = start(config, prefect)
    _, err = process.communicate()
    assert process.returncode == 1 and "error: evaluate.tolerance: Compare has no such field" in err
    assert not (folder / "artifacts" / "capture").exists()


def test_a_missing_ffmpeg_is_found_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "nowhere"))
    with pytest.raises(StageError, match=r"no ffmpeg found .*; run `make setup`"):
        built(configuration(tmp_path), "cpu")


@pytest.mark.parametrize("name", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_ends_with_130_and_keeps_what_is_finished(folder, prefect, name):
    process = start(configuration(folder, learn={"seconds": 60}), prefect)
    assert process.stdout is not None
    while "estimating" not in (line := process.stdout.readline()) or "learn" not in line:
        assert line, process.communicate()
    os.killpg(process.pid, name)  # as the terminal, or a cluster, does
    _, err = process.communicate()
    assert process.returncode == 130 and "interrupted; finished stages are kept" in err
    assert err.strip().count("\n") == 0
    assert [p.name for p in (folder / "artifacts" / "learn").iterdir()] == []
    assert len(list((folder / "artifacts" / "fill").iterdir())) == 1


def test_a_broken_record_does_not_lose_the_result(tmp_path, prefect):
    (tmp_path / "mlartifacts").write_text("where MLflow wants a folder")
    process = start(configuration(tmp_path), prefect)
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert out.count("not recorded in MLflow, the results are unharmed") == 1
    assert out.count("computed") == 11


def test_flatten():
    assert flatten({"a": {"b": [1, {"c": 2}]}, "d": None, "e": []}) == {"a.b.0": 1, "a.b.1.c": 2, "d": None, "e": []}
