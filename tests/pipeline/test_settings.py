"""The command line: what is wrong with it is said in one line, quickly, and with the remedy."""

import re
import subprocess
import sys

import pytest

from pipeline.settings import CONF, GROUPS, SettingsError, choices, compose


@pytest.mark.parametrize(
    "word, message",
    [
        ("scene=carnaton", r"no scene 'carnaton'; there are .*carnation"),
        ("profile=tiny", r"no profile 'tiny'; there are .*smoke"),
        ("learn.stepss=50", r"no 'stepss' in learn; did you mean learn\.steps\?"),
        ("lern.steps=50", r"no 'lern'; did you mean learn\?"),
        ("simulate.qqqq=1", r"no 'qqqq' in simulate; there are .*fps"),
        ("learn.steps=many", r"learn\.steps must be a number such as \d+, not many"),
        ("verify=maybe", r"verify must be true or false, not maybe"),
        ("carnation", r"'carnation' is not of the form key=value"),
        ("simulate.excitation=[", r"cannot read 'simulate\.excitation=\['"),
    ],
)
def test_a_mistake_is_one_line_with_the_remedy(word, message):
    with pytest.raises(SettingsError, match=message) as caught:
        compose([word])
    assert "\n" not in str(caught.value)


def test_overrides_reach_the_configuration():
    config, picked = compose(["profile=smoke", "learn.steps=7", "world.dt=1e-3"])
    assert config["learn"]["steps"] == 7 and config["world"]["dt"] == config["simulate"]["world"]["dt"] == 1e-3
    assert picked["profile"] == "smoke" and set(picked) == set(GROUPS)


def run(*words: str) -> subprocess.CompletedProcess:
    call = [sys.executable, "-X", "importtime", "-m", "pipeline", *words]
    return subprocess.run(call, capture_output=True, text=True, cwd=CONF.parent)


def test_help_lists_what_there_is_and_imports_nothing_heavy():
    done = run("--help")
    assert done.returncode == 0
    for group in GROUPS:
        assert f"\n{group}=" in done.stdout
        assert all(re.search(rf"^    {name}\s+\S", done.stdout, re.M) for name in choices(group))  # with a description
    assert not re.search(r"\| +(torch|warp|prefect|mlflow|hydra)$", done.stderr, re.M)


def test_a_mistake_ends_with_code_2():
    done = run("scene=nowhere")
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("import time")]
    assert done.returncode == 2 and line.startswith("error: no scene 'nowhere'; there are ")
