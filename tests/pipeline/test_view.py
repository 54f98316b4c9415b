"""make view: what it needs, and what it says in one line where it cannot be shown."""

import socket
import sys

import pytest
from toy import configuration

from pipeline.flow import first, plan
from pipeline.stage import StageError, run
from pipeline.view import finished, free, main, show

PICKED = {"scene": "toy", "profile": "smoke", "method": "physics3d"}
COMMAND = "make run SCENE=toy PROFILE=smoke METHOD=physics3d"


@pytest.fixture
def whole(tmp_path):
    """A whole run of throw-away stages: (configuration, its steps by name)."""
    config = configuration(tmp_path)
    capture = first(config, tmp_path / "artifacts")
    run(capture, "cpu")
    steps = plan(config, capture).steps
    for step in steps[1:]:
        run(step, "cpu")
    return config, {step.name: step for step in steps}


def told(config, environment=None) -> str:
    with pytest.raises((StageError, ValueError)) as error:
        show(config, PICKED, environment or {})
    text = str(error.value)
    assert "\n" not in text
    return text


def test_nothing_computed_yet(tmp_path):
    assert told(configuration(tmp_path)) == f"nothing is computed yet; {COMMAND}"


def test_a_scene_of_the_command_line_likewise(tmp_path, capsys):
    (tmp_path / "model.ply").touch()
    assert main(["scene=trained", f"output={tmp_path}", f"data={tmp_path / 'model.ply'}"], {}) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "make run SCENE=trained PROFILE=default" in error
    assert main(["scene=carnaton"], {}) == 2
    assert "no scene 'carnaton'" in capsys.readouterr().err


def test_a_run_that_is_not_finished_says_what_is_missing_and_where_the_last_one_is(whole, tmp_path):
    config, steps = whole
    steps["simulate"].folder.rename(tmp_path / "gone")
    folder = steps["render"].folder
    (tmp_path / "artifacts" / ".latest").write_text(str(folder.relative_to(tmp_path / "artifacts")))
    text = told(config)
    assert "simulate of this run is not computed yet" in text and str(folder) in text and COMMAND in text


@pytest.mark.parametrize("stage", ["capture", "fill", "simulate", "render"])
def test_a_damaged_result_is_named(whole, stage):
    config, steps = whole
    (steps[stage].folder / "fields.json").write_text("{}")
    text = told(config)
    assert f"the stored result of {stage} is damaged" in text and COMMAND in text


def test_the_rest_of_a_run_is_not_asked_for(whole, tmp_path):
    config, steps = whole
    steps["evaluate"].folder.rename(tmp_path / "gone")
    assert "render" in finished(config, tmp_path / "artifacts", COMMAND)


def test_without_viser_the_pictures_are_named_all_the_same(whole, monkeypatch, capsys):
    config, steps = whole
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "viser is not installed" in told(config)
    shown = capsys.readouterr().out.splitlines()
    assert str(steps["render"].folder / "previews" / "frame_00000.png") in shown


def test_a_taken_port_is_named_with_the_remedy(whole):
    config, _ = whole
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        text = told(config, {"PORT": str(port)})
    assert f"port {port}" in text and "make view PORT=" in text
    assert free(str(port), "127.0.0.1") == (port, "127.0.0.1")


@pytest.mark.parametrize("port, host", [("0", "127.0.0.1"), ("70000", "127.0.0.1"), ("x", ""), ("8080", "203.0.113.7")])
def test_what_cannot_be_listened_on_is_refused(port, host):
    with pytest.raises(ValueError, match=r"PORT="):
        free(port, host)
