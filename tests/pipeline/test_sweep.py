"""Many runs at once on Prefect's runners: what they share is done once, a killed worker loses nothing, one table."""

import csv
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from toy import ALL, configuration

from pipeline.settings import SettingsError
from pipeline.stage import read_manifest
from pipeline.sweep import Crew, Variant, asked, run

WITH_RAY = pytest.mark.skipif(find_spec("prefect_ray") is None, reason="prefect-ray is not installed")


def variants(folder: Path, changes: list[dict]) -> list[Variant]:
    """One for each set of changes of the toy experiment."""
    made = []
    for i, change in enumerate(changes):
        config = configuration(folder, **change)
        said = {"scene": "toy", "method": f"m{i}", "seed": "0", "name": f"toy m{i}"}
        made.append(Variant(config=config, tags={}, **said))
    return made


def table(folder: Path) -> list[dict[str, str]]:
    (path,) = (folder / "sweeps").iterdir()
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def diary(folder: Path) -> list[str]:
    return (folder / "diary").read_text().splitlines() if (folder / "diary").exists() else []


def kill_one_of_two(folder: Path, seen: list[str]) -> None:
    """Wait until two workers are learning, kill the first, and let the others go on."""
    at_work = folder / "processes in learn"
    while len(at_work.read_text().splitlines() if at_work.exists() else []) < 2:
        time.sleep(0.05)
    seen += [*at_work.read_text().split(), *map(str, (folder / "artifacts").glob("[!.]*/[!.]*"))]
    os.kill(int(seen[0]), signal.SIGKILL)
    (folder / "stop in learn").unlink()


@pytest.mark.parametrize("runner", ["dask", "process", pytest.param("ray", marks=WITH_RAY)])
def test_a_worker_killed_in_the_middle_loses_nothing(folder, prefect, runner, monkeypatch, capsys):
    """Two variants that differ in what is learned, on two workers."""
    for name in ("PYTHONPATH", "OMP_NUM_THREADS"):
        monkeypatch.setenv(name, prefect[name])
    (folder / "stop in learn").touch()
    seen: list[str] = []
    killer = threading.Thread(target=kill_one_of_two, args=(folder, seen), daemon=True)
    killer.start()
    changes = [{"learn": {"modulus": 1.5}}, {"learn": {"modulus": 2.5}}]
    code = run(Crew(runner=runner, workers=2, address=""), variants(folder, changes))
    out, err = capsys.readouterr()
    assert code == 0, out + err
    assert len({*seen[:2], str(os.getpid())}) == 3, "they learn side by side, elsewhere"
    before = set(map(Path, seen[2:]))
    # each step was computed once, but for what was under way: Dask loses one worker, a broken pool both
    wanted = Counter([*ALL[:5], *["learn", "simulate", "render", "evaluate"] * 2, "simulate", "render"])  # the guess's
    again = Counter(diary(folder)) - wanted
    assert not wanted - Counter(diary(folder))
    assert "learn" in again and again.total() <= 2, diary(
        folder
    )  # the other worker may be further, if slower ones wait
    results = set((folder / "artifacts").glob("[!.]*/[!.]*"))
    assert before <= results and all(read_manifest(result)["files"] for result in results)
    assert not list((folder / "artifacts").glob("[!.]*/.*"))
    rows = table(folder)
    assert [(r["method"], r["state"], float(r["learned/youngs_modulus"])) for r in rows] == [
        ("m0", "done", 1.5),
        ("m1", "done", 2.5),
    ]
    with sqlite3.connect(folder / "mlflow.db") as record:
        query = "select name, status from runs join tags using (run_uuid) where key = 'sweep'"
        assert sorted(record.execute(query).fetchall()) == [("toy m0", "FINISHED"), ("toy m1", "FINISHED")]
        (name,) = {value for (value,) in record.execute("select value from tags where key = 'sweep'")}
    assert f"searchFilter=tags.sweep%20%3D%20%27{name}%27" in out, "one page shows both"


def under_way(folder: Path, prefect: dict[str, str], runner: str) -> tuple[subprocess.Popen, set[int]]:
    """A sweep at a stage that would go on for ever, and the other processes that compute it."""
    (folder / "stop in learn").touch()
    code = (
        "import sys; from pathlib import Path; from test_sweep import variants;"
        "from pipeline.filed import one_line; from pipeline.sweep import Crew, run;"
        f"crew = Crew(runner={runner!r}, workers=2, address='');"
        "work = lambda: run(crew, variants(Path(sys.argv[1]), [{}]));"
        "sys.exit(one_line(work, lambda said: print(said, file=sys.stderr))) if __name__ == '__main__' else None"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)],
        env=prefect,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (folder / "processes in learn").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    return process, {int(pid) for pid in (folder / "processes in learn").read_text().split()} - {process.pid}


def wait_for_the_end(of: set[int]) -> None:
    """For ever, where it does not come."""
    while any(Path(f"/proc/{pid}").exists() for pid in of):
        time.sleep(0.05)


@pytest.mark.parametrize("runner", ["thread", "process", "dask", pytest.param("ray", marks=WITH_RAY)])
def test_an_interrupt_stops_what_is_under_way_and_keeps_what_is_finished(folder, prefect, runner):
    """Wherever it is computed; SIGTERM for the command alone, as a cluster does."""
    process, at_work = under_way(folder, prefect, runner)
    process.terminate()
    _, err = process.communicate(timeout=120)  # for ever, where it waits for the stage
    assert process.returncode == 130 and "interrupted" in err
    wait_for_the_end(at_work)
    assert not list((folder / "artifacts" / "learn").glob("[!.]*"))
    assert len(list((folder / "artifacts" / "fill").glob("[!.]*"))) == 1


@pytest.mark.parametrize("runner", ["process", "dask"])
def test_workers_end_with_a_command_that_is_killed(folder, prefect, runner):
    """Killed outright it tells nobody; they would compute on beside the run that goes on in its place."""
    process, at_work = under_way(folder, prefect, runner)
    assert at_work, "somebody else computes"
    process.kill()
    process.communicate()
    wait_for_the_end(at_work)


def test_what_variants_share_is_computed_once_and_one_that_fails_stops_no_other(folder, prefect, capsys):
    changes = [{}, {"learn": {"error": "no motion\nin sight"}}, {"learn": {"modulus": 2.0}}]
    crew = Crew(runner="thread", workers=2, address="")
    assert run(crew, variants(folder, changes)) == 1
    assert Counter(diary(folder))["capture"] == Counter(diary(folder))["fill"] == 1
    rows = table(folder)
    assert [row["state"] for row in rows][::2] == ["done", "done"]
    assert rows[1]["state"].startswith("learn: no motion in sight (traceback: ") and rows[1]["seconds"] == ""
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and said.err.startswith("toy m1: learn: no motion in sight")
    for file in (folder / "sweeps").iterdir():
        file.unlink()
    written = len(diary(folder))
    assert run(crew, variants(folder, [changes[0], changes[2]])) == 0
    assert len(diary(folder)) == written and [float(row["seconds"]) for row in table(folder)] == [0.0, 0.0]


def test_every_combination_is_a_variant():
    words = ["scenes=ball,carnation", "methods=physics3d,without_filling", "seeds=3, 4", "profile=smoke"]
    crew, made = asked([*words, "learn.steps=2"])
    assert len({(v.scene, v.method, v.seed) for v in made}) == 8 and len({v.name for v in made}) == 8
    assert all(v.config["seed"] in (3, 4) and v.config["learn"]["steps"] == 2 for v in made)
    assert made[0].name == "ball physics3d smoke seed 3 learn.steps=2" and made[0].tags["profile"] == "smoke"
    assert crew.runner == "process" and 1 <= crew.workers <= 8


@pytest.mark.parametrize(
    "words, message",
    [
        (["methods=physics3d"], r"scenes is empty; say SCENES="),
        (["scenes=ball,nowhere"], r"no scene 'nowhere'; there are alocasia, ball"),
        (["scenes=ball", "runner=cloud"], r"runner is 'cloud'; take one of thread, process, dask, ray"),
        (["scenes=ball", "workers=0"], r"workers is '0'; take a number from 1 to 9999"),
        (["scenes=ball", "runner=process", "address=tcp://x:1"], r"address=tcp://x:1: runner=process stays on this"),
        *(
            (
                ["scenes=ball", "runner=dask", f"address={text}"],
                r"is none of a cluster; take address=tcp://<host>:<port>",
            )
            for text in ("tcp://[bad:1", "tcp://127.0.0.1:99999", "tcp://host", "host:8786", "tcp://host:x", "//")
        ),
    ],
)
def test_a_mistake_is_one_line_with_the_remedy(words, message):
    with pytest.raises(SettingsError, match=message):
        asked(words)


def test_a_runner_that_is_not_installed_says_which_package(monkeypatch):
    monkeypatch.setattr("pipeline.sweep.find_spec", lambda name: None)
    with pytest.raises(SettingsError, match=r"runner=ray needs the package prefect-ray; pip install prefect-ray"):
        asked(["scenes=ball", "runner=ray", "address=ray://head:10001"])


def test_a_machine_with_other_code_or_without_the_shelf_refuses(tmp_path):
    from pipeline.flow import first
    from pipeline.stage import strange

    step = first(configuration(tmp_path), tmp_path / "artifacts")
    assert strange(step) is None
    assert "sees no folder" in (strange(replace(step, shelf=tmp_path / "elsewhere")) or "")
    step.made_of["libraries"] = {**step.made_of["libraries"], "torch": "1.0"}
    assert "has other libraries (torch); install there what is installed here" in (strange(step) or "")
