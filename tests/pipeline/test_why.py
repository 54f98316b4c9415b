"""`make why` names what a run would compute and every kind of change; `use` takes a result in place of a step."""

import json
from pathlib import Path

import pytest
from toy import ALL, configuration

from pipeline import fingerprint, why
from pipeline.flow import first, plan, up_to_date
from pipeline.settings import SettingsError, compose
from pipeline.stage import StageError, load, manifest, run
from pipeline.words import literal_paths


def filed(folder: Path, config: dict) -> dict:
    """Everything computed and filed, without Prefect: step name -> step."""
    capture = first(config, folder / "artifacts")
    run(capture, "cpu")
    steps = plan(config, capture).steps
    for step in steps:
        run(step, "cpu")
    return {step.name: step for step in steps}


def told(folder: Path, config: dict) -> dict[str, list[str]]:
    """What is said of each step, its own line first."""
    found: dict[str, list[str]] = {"": []}
    for line in why.explain(config, folder / "artifacts"):
        name, bar, text = line.partition(" | ")
        if name.strip() and bar:
            found[name.strip()] = [text.strip()]
        elif bar:
            list(found.values())[-1].append(" ".join(text.split()))
        else:
            found[""].append(line)
    return found


def waiting(said: dict[str, list[str]]) -> set[str]:
    return {name for name, lines in said.items() if name and lines[0].startswith("would run")}


def diary(folder: Path) -> str:
    return (folder / "diary").read_text() if (folder / "diary").exists() else ""


def test_before_the_first_run_and_after_it(tmp_path):
    config = configuration(tmp_path)
    said = told(tmp_path, config)
    assert waiting(said) == {"capture"} and "nothing of this stage is filed here" in said["capture"][1]
    assert "what comes after capture depends on what it finds" in said["capture"][2] and not diary(tmp_path)
    filed(tmp_path, config)
    before = diary(tmp_path)
    said = told(tmp_path, config)
    assert not waiting(said) and said[""] == [f"up to date: all {len(ALL)} steps were computed before"]
    assert diary(tmp_path) == before, "it runs nothing"


def test_an_entry_of_the_configuration_with_its_old_and_new_value(tmp_path):
    filed(tmp_path, configuration(tmp_path))
    said = told(tmp_path, configuration(tmp_path, learn={"modulus": 1.75}))
    assert waiting(said) == {"learn", "simulate", "render", "evaluate"}  # as a run would: test_flow.py
    assert said["learn"][1:] == ["configuration modulus: 1.5 -> 1.75"]
    assert said["simulate"][1:] == ["input learn is another one"]
    assert said["evaluate"][1:] == ["input render is another one", "input learn is another one"]
    assert said[""][0].startswith(f"4 of {len(ALL)} steps would run")


def test_a_first_stage_that_changed_leaves_the_rest_as_far_as_can_be_known(tmp_path):
    filed(tmp_path, configuration(tmp_path))
    said = told(tmp_path, configuration(tmp_path, capture={"single_object": True}))
    assert said["capture"][1:] == ["configuration single_object: nothing -> true"]
    assert "fill" in waiting(said) and any("if the capture is again such as in" in line for line in said["evaluate"])


def test_code_data_and_versions_are_named(tmp_path, monkeypatch):
    model = tmp_path / "model"
    (model / "weights").mkdir(parents=True)
    for name in ("a", "b", "c"):
        (model / "weights" / name).write_text(name)
    config = configuration(tmp_path, fill={"table": {}})
    config["fill"]["table"]["path"] = str(model)
    parts = fingerprint.made_of(config["fill"], ["x"])
    assert parts["data"].keys() == {"table.path", *(f"table.path/weights/{n}" for n in "abc")}
    (model / "weights" / "a").write_text("other")
    (model / "weights" / "b").rename(model / "weights" / "d")
    moved = tmp_path / "moved"
    model.rename(moved)
    config["fill"]["table"]["path"] = str(moved)
    lines = why.differences(parts, fingerprint.made_of(config["fill"], ["x"]), ["body"])
    assert [" ".join(line.split()) for line in lines] == [
        "data table.path/weights/a has changed",
        "data table.path/weights/b is gone",
        "data table.path/weights/d is new",
    ]

    config = {"_target_": "stages.fill.Fill", "spacing": 0.1}
    old = fingerprint.made_of(config, [])
    monkeypatch.setattr(fingerprint, "code", lambda names: old["code"] | {"stages.fill": "x", "physics3d.new": "y"})
    monkeypatch.setattr(fingerprint, "libraries", lambda names: old["libraries"] | {"torch": "99.1"})
    lines = [" ".join(line.split()) for line in why.differences(old, fingerprint.made_of(config, []), [])]
    assert lines[:2] == ["code physics3d.new is new", "code stages.fill has changed"]
    assert lines[2:] == [f'version torch: "{old["libraries"]["torch"]}" -> "99.1"']


def test_the_nearest_of_several_results_is_compared_with(tmp_path):
    for modulus, name in ((1.0, "far"), (2.0, "near"), (3.0, "other")):
        filed(tmp_path, configuration(tmp_path, learn={"modulus": modulus, "error": "", "name": name}))
    said = told(tmp_path, configuration(tmp_path, learn={"modulus": 2.5, "error": "", "name": "near"}))
    assert said["learn"][1:] == ["configuration modulus: 2.0 -> 2.5"]


@pytest.mark.parametrize("made_of", [None, [], {"config": {}}, {"config": 1, "code": 2}])
def test_a_result_of_an_older_version_does_not_say_what_it_was_made_of(tmp_path, made_of):
    step = filed(tmp_path, configuration(tmp_path))["learn"]
    text = manifest(step)
    del text["made_of"]
    if made_of is not None:
        text["made_of"] = made_of
    (step.folder / "manifest.json").write_text(json.dumps(text))
    said = told(tmp_path, configuration(tmp_path, learn={"modulus": 9.0}))
    assert said["learn"][1] == "the results that are filed are of other things, or do not say what they were made of"
    assert not waiting(told(tmp_path, configuration(tmp_path))), "it is used as before"


def test_damage_is_a_reason(tmp_path):
    step = filed(tmp_path, configuration(tmp_path))["fill"]
    (step.folder / "fields.json").write_text("{}")
    said = told(tmp_path, configuration(tmp_path))
    assert waiting(said) == {"fill"} and said["fill"][1].startswith("the stored result is damaged (fields.json has 2")


# ---- use


def test_a_result_that_is_taken_stands_for_its_stage_whatever_it_was_made_of(tmp_path):
    steps = filed(tmp_path, configuration(tmp_path))
    before = diary(tmp_path)
    changed = configuration(tmp_path, learn={"modulus": 7.0}, fill={"amount": 2})
    changed["use"] = {"learn": steps["learn"].fingerprint[:6], "fill": steps["fill"].fingerprint, "render": None}
    again = filed(tmp_path, changed)
    assert diary(tmp_path) == before, "with both taken, everything after them is as it was"
    assert [s for s in again if again[s].taken] == ["fill", "learn"]
    assert {s: again[s].fingerprint for s in again} == {s: steps[s].fingerprint for s in steps}
    assert float(load(again["learn"], "cpu").parameters["youngs_modulus"]) == 1.5
    assert up_to_date(changed, tmp_path / "artifacts", False) is not None
    assert told(tmp_path, changed)["learn"][0].startswith("taken as it is")


def test_a_result_that_cannot_be_taken_is_one_line(tmp_path):
    steps = filed(tmp_path, configuration(tmp_path))
    config, key = configuration(tmp_path), steps["learn"].fingerprint
    wrong = "0" if key[0] != "0" else "1"
    no_result = rf"use\.learn is {wrong}, which is no result in .*; take one of: {key}; or use\.learn=null"
    no_step = r"use\.foretell takes the place of no step of this scene; set use\.foretell=null"
    damaged = rf"use\.learn is {key}, which is damaged \(fields.json is no file\); take another"
    with pytest.raises(StageError, match=no_result):
        filed(tmp_path, config | {"use": {"learn": wrong}})
    (tmp_path / "artifacts" / "foretell" / key).mkdir(parents=True)
    with pytest.raises(StageError, match=no_step):
        filed(tmp_path, config | {"use": {"foretell": key}})
    (steps["learn"].folder / "fields.json").unlink()
    with pytest.raises(StageError, match=damaged):
        filed(tmp_path, config | {"use": {"learn": key}})


@pytest.mark.parametrize("key", ["1234567890123456", "12e4567890123456", "0x12", "null", "abc"])
def test_a_fingerprint_is_text_whatever_it_looks_like(key):
    if key == "0x12":
        with pytest.raises(SettingsError, match=r"use\.learn is '0x12'; take the fingerprint of a result"):
            compose(literal_paths([f"use.learn={key}"]))
        return
    config, _ = compose(literal_paths([f"use.learn={key}"]))
    assert config["use"]["learn"] == (None if key == "null" else key)
