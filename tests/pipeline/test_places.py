"""Where commands write is looked at before anything is computed: it can be written, or one line names the remedy."""

import os
from pathlib import Path

import pytest

from pipeline import compare, export, film, fit_curves, score, still, train_prior, twin, web
from pipeline.fingerprint import ROOT
from pipeline.places import folder_to_fill, new_place, place
from pipeline.settings import SettingsError

RUBBER = {"DATA": str(ROOT / "docs" / "examples" / "rubber"), "MATERIAL": "rubber"}
CLIPS = {"REAL": "a.mp4", "PRED": "b.mp4"}
SCENE = ["scene=ball", "profile=smoke"]


def on(module, words=(), **more):
    """What make does: the words of a run, and OUT by way of the environment."""
    return lambda out: module.main([*words], {**more, "OUT": out})


NEW = {  # what refuses a place where something is; each with the ending of what it writes
    "export": (on(export, SCENE, FORMAT="ply"), ""),
    "film": (on(film, SCENE), ".mp4"),
    "still": (on(still, SCENE), ".png"),
    "report": (on(web, SCENE), ".html"),
    "twin": (on(twin), ""),
}
FILLED = {  # what fills a folder, which may be there
    "score": lambda out: score.main({**CLIPS, "OUT": out}),
    "fit-curves": lambda out: fit_curves.main({**RUBBER, "OUT": out}),
    "train-prior": on(train_prior),
    "compare": lambda out: compare.main(["scenes=ball", "profile=smoke", f"out={out}"]),
}
ALL = {name: call for name, (call, _) in NEW.items()} | FILLED


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Calls a command in an empty folder: its one line; nothing may be left of it."""
    monkeypatch.chdir(tmp_path)

    def call(command, out, code: int) -> str:
        before = sorted(map(str, tmp_path.rglob("*")))
        assert command(str(out)) == code
        told = capsys.readouterr()
        assert told.out == "" and told.err.count("\n") == 1 and told.err.startswith("error: ")
        assert sorted(map(str, tmp_path.rglob("*"))) == before
        return told.err

    return call


@pytest.mark.parametrize("name", ALL)
def test_nothing_can_be_made_below_a_file_or_a_link_to_nothing(name, refused, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    ending = NEW[name][1] if name in NEW else ""
    for above in ("file", "link"):
        said = refused(ALL[name], tmp_path / above / f"x{ending}", 1)
        assert f"{tmp_path / above} is no folder; say OUT=<another place>" in said


@pytest.mark.parametrize("name", NEW)
def test_what_is_there_is_kept(name, refused, tmp_path):
    call, ending = NEW[name]
    (tmp_path / f"mine{ending}").write_text("mine")
    assert "is there already; remove it" in refused(call, f"mine{ending}", 1)


@pytest.mark.parametrize("name", FILLED)
def test_a_file_is_no_folder_to_fill(name, refused, tmp_path):
    (tmp_path / "mine").write_text("mine")
    assert f"{tmp_path / 'mine'} is no folder" in refused(FILLED[name], "mine", 1)


@pytest.mark.parametrize("name", [name for name, (_, ending) in NEW.items() if ending])
@pytest.mark.parametrize("out", ["film", "film.", "a/", "film.txt", "a/.{}", ".{}"])
def test_a_name_of_another_kind_is_refused(name, out, refused):
    call, ending = NEW[name]
    out = out.format(ending[1:])
    assert refused(call, out, 2) == f"error: OUT={out} names no {ending} file; say OUT=<name>{ending}\n"


def test_a_name_too_long_for_a_file_is_refused(refused):
    assert "is too long for the name of a file" in refused(ALL["export"], "x" * 250, 1)


def test_a_place_that_is_not_ours_to_write_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)  # who runs tests may be root
    with pytest.raises(PermissionError, match="is not yours to write; say OUT="):
        new_place({"OUT": str(tmp_path / "a" / "b")})


def test_a_home_that_no_shell_has_put_in_is_put_in(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    assert place({"REAL": "~/my clip.mp4"}, "REAL") == Path("/home/somebody/my clip.mp4")
    assert place({"REAL": "a~b"}, "REAL") == Path("a~b") and place({}, "REAL") is None


def test_any_ending_is_known_in_capitals_and_a_usual_place_is_taken(tmp_path):
    assert new_place({"OUT": str(tmp_path / "A.MP4")}, ".mp4") == tmp_path / "A.MP4"
    assert new_place({}, ".mp4") is None and folder_to_fill({}, tmp_path / "x") == tmp_path / "x"
    with pytest.raises(SettingsError):
        new_place({"OUT": "a.mp4.png"}, ".mp4")
