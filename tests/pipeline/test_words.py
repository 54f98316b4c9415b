"""Any path that a file system allows arrives as it stands, through make and directly, and nothing is run on the way."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import __main__ as command
from pipeline.settings import compose
from pipeline.words import literal_paths

ROOT = Path(__file__).resolve().parent.parent.parent
PATHS = [
    "/x/my models/ball.ply",
    "model (1).ply",
    "-rf.ply",
    "--help",
    "a=b.ply",
    "$HOME/$(touch pwned)/${y}/$$.ply",
    "\\${y}\\\\",
    "#1, [2] {3: 4}.ply",
    'it\'s "quoted" `touch pwned`.ply',
    '"',
    "'",
    "'whole'",
    "; touch pwned; .ply",
    "a|b&c>pwned<d*?!~.ply",
    "Äpfel/蘋果/🍎.ply",
    "ends in a blank ",
    "ends in a backslash\\",
    "null",
    "1e3",
    "true",
    "[1,2]",
    "a\tb.ply",
    "%d%20.ply",
    "\udcff\udcfe.ply",  # bytes that are no UTF-8
]


def path_of(words: list[str]) -> str:
    config, _ = compose(literal_paths(words))
    return config["scene"]["source"]["path"]


@pytest.mark.parametrize("path", PATHS)
def test_a_path_reaches_the_source_as_it_stands(path):
    assert path_of(["scene=trained", f"data={path}"]) == path


@given(st.lists(st.sampled_from("\\\\\\'\"${} (),;=#[]:@~!%&*abü\t\udcff")).map("".join))
@settings(max_examples=300, deadline=None)
def test_no_path_means_anything_to_hydra_or_omegaconf(path):
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf import OmegaConf

    (word,) = literal_paths([f"data=/{path}"])
    config = OmegaConf.create({"data": OverridesParser.create().parse_override(word).value(), "file": "${data}/x"})
    assert OmegaConf.to_container(config, resolve=True) == {"data": f"/{path}", "file": f"/{path}/x"}


@pytest.mark.parametrize("text", [p for p in PATHS if p not in ("null", "true", "[1,2]", "-rf.ply", "~")])
def test_any_text_that_is_no_number_arrives_as_it_stands(text):
    """Names of photographs and patterns of names, as browsers and telephones make them; sentences for a prior."""
    config, _ = compose(literal_paths(["scene=thing", f"scene.prompts.0.view={text}", f"capture.clip={text}"]))
    assert config["scene"]["prompts"][0]["view"] == config["capture"]["clip"] == text
    config, _ = compose(
        literal_paths(["scene=clip", "prior=wan", f"scene.source.pattern={text}", f"prior.prompt={text}"])
    )
    assert config["scene"]["source"]["pattern"] == config["prior"]["prompt"] == text


@pytest.mark.parametrize("view", ["3", "-1", "1.5", "nan", "true", "[0]", "{a: 1}", "null"])
def test_what_can_be_no_name_of_a_photograph_is_a_number_or_refused(view):
    word = f"scene.prompts.0.view={view}"
    assert literal_paths([word]) == [word]


def test_which_words_are_paths():
    kept = ["learn.steps=5", "scene=bird", "~simulate.force.x", "scene.source.path=${data}/x", "world.dt=null", "data"]
    assert literal_paths(kept) == kept
    assert path_of(["scene=trained", "scene.source.path=/x/a (1).ply"]) == "/x/a (1).ply"
    assert path_of(["scene=trained", "data=~/x.ply"]) == str(Path.home() / "x.ply")
    assert compose(literal_paths(["output=/x/a, b"]))[0]["output"] == "/x/a, b"


@pytest.mark.parametrize("path", ["a\nb", "\n", "a\rb"])
def test_a_line_break_is_refused(path, capsys):
    assert command.main(["scene=trained", f"data={path}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: data=") and "rename" in line


def from_a_shell(**env: str) -> dict[str, str]:
    """The environment without what a make that runs these tests hands on: its flags, level and values."""
    of_make = {"MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES", "GNUMAKEFLAGS"}
    values = {"SCENE", "PROFILE", "METHOD", "DATA", "ARGS", "PORT", "PYTHON", "BENCH"}
    return {k: v for k, v in os.environ.items() if k not in of_make | values} | env


@pytest.fixture
def made(tmp_path):
    """make in a folder whose .venv/bin/python says what it was called with and by which environment."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "setup.py", "constraints.txt"):
        (tmp_path / name).touch()
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    told = "import json, os, sys; print(json.dumps([sys.argv[1:], dict(os.environ)]))"
    python.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{told}' \"$@\"\n")
    python.chmod(0o755)
    (tmp_path / ".venv" / ".ready").touch()

    def call(*words: str, **env: str) -> tuple[list[str], dict[str, str]]:
        done = subprocess.run(["make", *words], cwd=tmp_path, env=from_a_shell(**env), capture_output=True)
        assert done.returncode == 0, done.stderr.decode(errors="replace")
        there = {"Makefile", ".venv", "pyproject.toml", "setup.py", "constraints.txt"}
        assert {p.name for p in tmp_path.iterdir()} == there
        return tuple(json.loads(done.stdout))

    return call


@pytest.mark.parametrize("text", PATHS)
def test_make_hands_on_what_it_was_given(made, text):
    words, env = made("run", f"DATA={text}", f"SCENE={text}", f"METHOD={text}", f"PROFILE={text}", f"ARGS={text}")
    named = [f"{key}={text}" for key in ("scene", "profile", "method", "data")]
    assert words == ["-m", "pipeline.words", "-m", "pipeline", *named] and env["ARGS"] == text
    assert made("run", DATA=text)[0][-1] == f"data={text}"
    assert made("ui", f"PORT={text}")[1]["PORT"] == text
    for target in ("test", "bench-speed"):
        assert made(target, f"ARGS={text}")[1]["ARGS"] == text
    for target in ("score", "twin", "fit-curves", "export", "film", "still", "report", "train-prior"):
        names = ("DATA", "OUT", "REAL", "PRED", "MATERIAL", "UNSEEN", "FORMAT", "FRAME", "SIZE", "LENGTH")
        env = made(target, *(f"{name}={text}" for name in names))[1]
        assert {env[name] for name in names} == {text}


@pytest.mark.parametrize("text", ["stable_video", "it's $HOME", "a  b", "$(shell touch x)", '"`$x', "[1,2]", ""])
def test_entries_beside_the_values_of_make_are_words_as_in_args(made, text):
    """make run SCENE=plush prior=stable_video: a word that make takes for one of its own variables is not lost."""
    words, env = made("run", f"prior.prompt={text}", "SCENE=plush", "prior=wan", "ARGS=seed=1", home="/x")
    assert words[-3:] == ["scene=plush", "profile=default", "method=physics3d"]
    assert shlex.split(env["ARGS"]) == ["seed=1", "prior=wan", f"prior.prompt={text}"]
    assert made("bench-gpu", "device=cuda", "seed=1")[0][-3:] == ["benchmarks/gpu.py", "device=cuda", "seed=1"]


@pytest.mark.parametrize("text", [t for t in PATHS if "/" not in t and "%" not in t and "=" not in t])
def test_the_name_of_a_benchmark_runs_nothing(made, text):
    target = f"bench-{text}"
    if target.strip() == target and "\t" not in target and not set(target) & set("*?[\\~"):  # make's own patterns
        assert made(target)[0][-1] == f"benchmarks/{text}.py"


def test_files_are_utf_8_whatever_the_locale_says(made):
    for locale in ("C", "POSIX", "de_DE.ISO-8859-1"):
        assert made("why", LC_ALL=locale)[1]["PYTHONUTF8"] == "1"


def split(text: str) -> subprocess.CompletedProcess:
    call = [sys.executable, "-m", "pipeline.words", "-c", "import json, sys; print(json.dumps(sys.argv[1:]))"]
    return subprocess.run(call, env=os.environ | {"ARGS": text}, cwd=ROOT, capture_output=True, text=True)


def test_args_are_split_like_a_shell_would_and_run_by_none(tmp_path):
    pwned = tmp_path / "pwned"
    text = f'a=1 \'b=x y\' "c=\\"" d=\\; ; touch {pwned} $(touch {pwned}) `touch {pwned}` #x'
    words = ["a=1", "b=x y", 'c="', "d=;", ";", "touch", str(pwned), "$(touch", f"{pwned})"]
    assert json.loads(split(text).stdout) == [*words, "`touch", f"{pwned}`", "#x"]
    assert json.loads(split("").stdout) == [] and not pwned.exists()


@pytest.mark.parametrize("text", ["a'b", 'learn.steps="5', "x\\"])
def test_a_stray_quote_is_one_line(text):
    done = split(text)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1 and line.startswith(f"error: ARGS={text}: no ")


def test_make_and_the_pipeline_together():
    path = "/x/it's my $HOME (1), #2; ${y} = ü.ply"
    call = ["make", "-o", ".venv/.ready", "run", "SCENE=trained", f"DATA={path}", "ARGS=--config 'learn.steps=7'"]
    done = subprocess.run(call, cwd=ROOT, env=from_a_shell(), capture_output=True, text=True)
    shown = yaml.safe_load(done.stdout)
    assert shown["scene"]["source"]["path"] == path and shown["learn"]["steps"] == 7, done.stderr
