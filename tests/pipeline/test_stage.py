"""Reuse, damage and everything that may kill a run: nothing half-done looks finished, nothing finished is lost."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.stage import StageError, Step, build, damage, load, run

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
SCRIPT = """
import sys
from pathlib import Path
from pipeline.stage import StageError
from test_stage import chain
from pipeline.stage import run
try:
    for step in chain(Path(sys.argv[1]), **eval(sys.argv[2])):
        run(step, "cpu")
except StageError as error:
    sys.exit(f"error: {error}")
"""


def chain(folder: Path, **changes: dict) -> list[Step]:
    """a -> b -> c, and d that takes a alone; `changes` are entries of the stages' configurations."""
    steps: dict[str, Step] = {}
    for name, inputs in {"a": "", "b": "a", "c": "b", "d": "a"}.items():
        config = {"_target_": "toy.Add", "amount": 1, "name": name, "diary": str(folder / "diary")}
        config |= changes.get(name, {})
        steps[name] = Step.of(name, name, config, tuple(steps[i] for i in inputs), folder / "artifacts")
    return list(steps.values())


def diary(folder: Path) -> str:
    """Which stages have run, in order."""
    return (folder / "diary").read_text().replace("\n", "") if (folder / "diary").exists() else ""


def run_all(folder: Path, **changes: dict) -> list[bool]:
    return [run(step, "cpu").hit for step in chain(folder, **changes)]


def start(folder: Path, before: str = "", **changes: dict) -> subprocess.Popen:
    """The same in a process of its own."""
    env = {**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}", "OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    call = [sys.executable, "-c", before + SCRIPT, str(folder), repr(changes)]
    return subprocess.Popen(call, stdout=pipe, stderr=pipe, text=True, env=env)


def wait_for(folder: Path, name: str) -> None:
    while name not in diary(folder):
        time.sleep(0.02)


def unfinished(folder: Path) -> list[Path]:
    return [p for p in (folder / "artifacts").glob("?/.*")]


def test_second_run_computes_nothing(tmp_path):
    assert run_all(tmp_path) == [False] * 4
    assert run_all(tmp_path) == [True] * 4
    assert diary(tmp_path) == "abcd"
    assert int(load(chain(tmp_path)[2], "cpu").frames[0][0, 0, 0, 0]) == 3  # a + b + c


def test_a_change_recomputes_what_is_downstream_of_it_only(tmp_path):
    run_all(tmp_path)
    assert run_all(tmp_path, b={"amount": 5}) == [True, False, False, True]
    assert run_all(tmp_path) == [True] * 4  # and the old results are still there


def test_manifest_says_what_it_took(tmp_path):
    step = chain(tmp_path)[0]
    manifest = run(step, "cpu").manifest
    assert manifest["config"] == step.config and manifest["seconds"] >= 0 and manifest["peak_rss_bytes"] > 1e7
    assert set(manifest["files"]) == {p.relative_to(step.folder).as_posix() for p in step.folder.rglob("*.*")} - {
        "manifest.json"
    }
    assert "torch" in manifest["versions"]


def damaged(folder: Path, name: str) -> None:
    path = folder / name
    match name:
        case "arrays.safetensors":  # same size, other content
            path.write_bytes(path.read_bytes()[:-1] + b"\7")
        case "fields.json":
            path.write_text(path.read_text()[:-20])
        case "large.bin":
            with path.open("ab") as stream:
                stream.write(b"x")
        case _:
            path.unlink()


@pytest.mark.parametrize("name", ["arrays.safetensors", "fields.json", "manifest.json", "log.txt", "large.bin"])
def test_damage_is_found_and_repaired(tmp_path, capsys, name):
    changes = {"b": {"size": 2 << 20}}
    run_all(tmp_path, **changes)
    step = chain(tmp_path, **changes)[1]
    damaged(step.folder, name)
    assert damage(step)
    assert run_all(tmp_path, **changes) == [True, False, True, True]
    assert "b | the stored result is damaged" in capsys.readouterr().out
    assert damage(step) is None


def test_large_files_are_checked_by_content_on_request(tmp_path):
    changes = {"a": {"size": 2 << 20}}
    step = chain(tmp_path, **changes)[0]
    run(step, "cpu")
    (step.folder / "large.bin").write_bytes(bytes(2 << 19) + b"\1" * (2 << 19))
    assert damage(step) is None
    assert "large.bin" in damage(step, verify=True)


def test_a_removed_input_is_computed_again_when_it_is_needed(tmp_path):
    run_all(tmp_path)
    shutil.rmtree(chain(tmp_path)[0].folder)
    assert not run(chain(tmp_path, b={"amount": 2})[1], "cpu").hit
    assert diary(tmp_path) == "abcdba" or diary(tmp_path) == "abcdab"


def test_failure_is_one_line_and_keeps_the_traceback(tmp_path):
    with pytest.raises(StageError, match=r"^b: no way  ?\(traceback: (.*)\)$") as caught:
        run_all(tmp_path, b={"error": "no\n way"})
    kept = Path(str(caught.value).split("traceback: ")[1].rstrip(")"))
    assert "Traceback" in kept.read_text() and "adding 1" in kept.read_text()
    assert not unfinished(tmp_path)
    assert run_all(tmp_path) == [True, False, False, False]


def test_kill_in_a_stage_then_resume(tmp_path):
    process = start(tmp_path, b={"seconds": 60})
    wait_for(tmp_path, "b")
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert len(unfinished(tmp_path)) == 1
    assert run_all(tmp_path) == [True, False, False, False]  # the slow b has another fingerprint: swept all the same
    assert not unfinished(tmp_path)


def test_interrupt_leaves_nothing_half_done(tmp_path):
    process = start(tmp_path, b={"seconds": 60})
    wait_for(tmp_path, "b")
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert process.returncode != 0 and not unfinished(tmp_path)
    assert run_all(tmp_path) == [True, False, False, False]


def test_two_runs_at_once_compute_once(tmp_path):
    slow = {"b": {"seconds": 3.0}}
    both = [start(tmp_path, **slow) for _ in range(2)]
    outputs = [process.communicate() for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    assert sorted(diary(tmp_path)) == list("abcd")
    assert any("another run is computing this" in out for out, _ in outputs)


def test_full_disk_is_one_line_and_leaves_nothing(tmp_path):
    """A limit on the size of files stands for the full disk: writing fails in the same place, half-way."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
    process = start(tmp_path, before=limit, b={"size": 1_000_000})
    _, err = process.communicate()
    assert process.returncode == 1
    (line,) = err.strip().splitlines()
    assert line.startswith("error: b: the disk is full") and "output=" in line
    assert not unfinished(tmp_path) and damage(chain(tmp_path, b={"size": 1_000_000})[1])
    assert run_all(tmp_path)[0]  # a, which was finished before, is not lost


@pytest.mark.parametrize(
    "config, message",
    [
        ({"_target_": "toy.Add", "amont": 1}, r"b\.amont: Add has no such field; did you mean amount\?"),
        ({"_target_": "toy.Sub"}, r"b\._target_ is toy\.Sub: .*no attribute"),
        ({"_target_": "toy.Add", "amount": 1}, r"b: .*missing 2 required .*'diary' and 'name'"),
    ],
)
def test_wrong_configuration_names_the_entry(config, message):
    with pytest.raises(ValueError, match=message):
        build(config, "cpu", "b")


def test_build_turns_lists_into_tuples_and_auto_into_the_device():
    import toy

    stage = build({"_target_": "toy.Add", "amount": 1, "diary": "", "name": "x", "device": "auto"}, "cuda", "x")
    assert stage == toy.Add(amount=1, diary="", name="x", device="cuda")
    assert build({"gravity": [0.0, [1.0]]}, "cpu") == {"gravity": (0.0, (1.0,))}


def test_a_lock_dies_with_its_holder(tmp_path):
    slow = {"b": {"seconds": 60}}
    for times in (1, 2):  # the second one, of the same fingerprint, gets to work at once
        process = start(tmp_path, **slow)
        wait_for(tmp_path, "b" * times)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    assert diary(tmp_path) == "abb"
