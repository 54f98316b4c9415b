"""What `pip install .` installs: everything that a run needs, from any folder, with the same configuration."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "conf", "physics3d", "stages", "pipeline")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, so that nothing is left in the working tree."""
    copy = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, copy)
    target = tmp_path_factory.mktemp("wheel")
    call = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(target)]
    subprocess.run([*call, str(copy)], check=True, capture_output=True)
    (made,) = target.glob("physics3d-*.whl")
    return made


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The wheel unpacked, as pip lays it out."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder)
    return folder


def physics3d(installed: Path, folder: Path, *words: str, without: str = "") -> subprocess.CompletedProcess:
    """The command line of the installed package, in another folder."""
    start = "import sys; " + "".join(f"sys.modules[{name!r}] = None; " for name in without.split())
    call = [sys.executable, "-c", f"{start}from pipeline.command import main; sys.exit(main())", *words]
    env = os.environ | {"PYTHONPATH": str(installed)}
    return subprocess.run(call, cwd=folder, env=env, capture_output=True, text=True)


def test_a_wheel_holds_every_source_and_configuration_and_nothing_else(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    sources = {p for folder in ("physics3d", "stages", "pipeline") for p in (ROOT / folder).rglob("*")}
    wanted = {p.relative_to(ROOT).as_posix() for p in sources if p.is_file() and "__pycache__" not in p.parts}
    wanted |= {f"pipeline/conf/{p.relative_to(ROOT / 'conf').as_posix()}" for p in (ROOT / "conf").rglob("*.yaml")}
    assert {name for name in names if ".dist-info/" not in name} == wanted
    told = zipfile.ZipFile(wheel).read(next(n for n in names if n.endswith("entry_points.txt"))).decode()
    assert "physics3d = pipeline.command:main" in told


def test_the_command_composes_what_the_checkout_composes_from_any_folder(installed, tmp_path):
    words = ["scene=ball", "profile=smoke", "learn.steps=7", "--config"]
    done = physics3d(installed, tmp_path, "run", *words)
    here = subprocess.run([sys.executable, "-m", "pipeline", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == here.returncode == 0, done.stderr
    assert done.stdout == here.stdout and "steps: 7" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_mistake_on_the_command_line_is_one_line(installed, tmp_path):
    for words, code, text in (
        (["walk"], 2, "error: no verb 'walk'; there are run, why, "),
        (["run", "scene=nowhere"], 2, "error: no scene 'nowhere'; there are alocasia, ball, "),
        (["why", "learn.stepps=3"], 2, "error: no 'stepps' in learn; did you mean learn.steps?"),
        (["pin", "learn/0"], 1, "error: RESULT=learn/0 is none of those in artifacts; take RESULT="),
        (["collect"], 1, "error: no record of runs in mlflow.db, "),
    ):
        done = physics3d(installed, tmp_path, *words)
        assert done.returncode == code and done.stderr.startswith(text) and done.stderr.count("\n") == 1, done.stderr
    done = physics3d(installed, tmp_path, "--help")
    assert done.returncode == 0 and "physics3d run scene=carnation" in done.stdout


def test_without_the_extra_the_command_says_what_to_install(installed, tmp_path):
    done = physics3d(installed, tmp_path, "run", "scene=ball", without="hydra mlflow")
    assert done.returncode == 1
    assert done.stderr == "error: hydra, mlflow not installed; pip install 'physics3d[pipeline]'\n"
