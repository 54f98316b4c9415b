"""A stage that was stopped goes on from its checkpoint, and from no other: by Ctrl-C, by SIGKILL, with a full disk."""

import multiprocessing
import re
import resource
import signal
import sys
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch

import physics3d.checkpoint
from physics3d.log import CHECKPOINT
from pipeline.shelf import clean, collect
from pipeline.stage import Filed, Step, damage, half_done, load, run
from pipeline.tracking import Tracking

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
STEPS = 9
RESUMING = re.compile("resuming at step . of 9")


@pytest.fixture(autouse=True)
def always(monkeypatch):
    """A checkpoint after every step; processes find the tests, and compute in one thread."""
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{HERE}")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def counting(folder: Path, **changes: int) -> Step:
    config = {"_target_": "toy.Counting", "steps": STEPS, "diary": str(folder / "diary")} | changes
    return Step.of("count", "count", config, (), folder / "artifacts")


def stopped(folder: Path, at: int, **changes: int) -> Step:
    """The stage, after Ctrl-C in one of its steps."""
    (folder / f"stop at {at}").write_text("interrupt")
    step = counting(folder, **changes)
    with pytest.raises(KeyboardInterrupt):
        run(step, "cpu")
    assert half_done(step), "as `make why` says"
    return step


def diary(folder: Path) -> list[int]:
    """Which steps were computed, in order."""
    return [int(line) for line in (folder / "diary").read_text().split()]


def left(step: Step) -> Path:
    return step.unfinished / CHECKPOINT


def assert_right(filed: Filed, tmp_path: Path) -> None:
    """It is the result of a run that nobody stopped, with the same files but the checkpoint, and the same curve."""
    (tmp_path / "straight").mkdir(exist_ok=True)
    whole = run(counting(tmp_path / "straight", steps=filed.step.config["steps"]), "cpu").step
    assert torch.equal(load(filed.step, "cpu").frames[0], load(whole, "cpu").frames[0])
    assert {p.name for p in filed.step.folder.rglob("*")} == {p.name for p in whole.folder.rglob("*")}
    assert (filed.step.folder / "metrics.jsonl").read_text() == (whole.folder / "metrics.jsonl").read_text()
    assert damage(filed.step, verify=True) is None and not list(filed.step.folder.parent.glob(".*"))


def in_a_process(folder: Path, size: int, limit: int) -> None:
    """The stage in this process, which may write files of so many bytes, with its lines in a file "out"."""
    physics3d.checkpoint.LONGEST = 0.0
    sys.stdout = (folder / "out").open("a", buffering=1)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    run(counting(folder, size=size), "cpu")


def start(folder: Path, *, size: int = 0, limit: int = resource.RLIM_INFINITY) -> BaseProcess:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "toy", "pipeline.stage"])
    process = context.Process(target=in_a_process, args=(folder, size, limit))
    process.start()
    return process


def test_stopped_again_and_again_it_ends_as_if_it_had_not_been(tmp_path, capsys):
    for at in (0, 3, 7):
        step = stopped(tmp_path, at)
    assert_right(run(step, "cpu"), tmp_path)
    assert diary(tmp_path) == [*range(STEPS)], "no step was computed twice"
    assert [f"resuming at step {n} of 9" for n in (1, 4, 8)] == RESUMING.findall(capsys.readouterr().out)


def test_killed_while_another_run_waits_for_it_the_other_goes_on(tmp_path):
    (tmp_path / "stop in 4").touch()  # it stays there
    (tmp_path / "stop at 4").write_text("kill")
    first = start(tmp_path)
    while not (tmp_path / "diary").exists() or 4 not in diary(tmp_path):
        assert first.is_alive()
        time.sleep(0.02)
    second = start(tmp_path)
    while "another run is computing this" not in (tmp_path / "out").read_text():
        assert second.is_alive()
        time.sleep(0.02)
    (tmp_path / "stop in 4").unlink()
    first.join()
    second.join()
    assert (first.exitcode, second.exitcode) == (-signal.SIGKILL, 0)
    assert diary(tmp_path) == [*range(STEPS)]
    filed = run(counting(tmp_path, size=0), "cpu")
    assert filed.hit
    assert_right(filed, tmp_path)


def test_of_another_configuration_nothing_is_taken_over(tmp_path):
    mine = stopped(tmp_path, 3)
    other = run(counting(tmp_path, steps=5), "cpu")
    assert diary(tmp_path) == [0, 1, 2, 3, 0, 1, 2, 3, 4]
    assert left(mine).exists(), "that of the first one stays where it is"
    assert_right(run(mine, "cpu"), tmp_path)
    assert_right(other, tmp_path)
    assert diary(tmp_path)[9:] == [4, 5, 6, 7, 8]


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-1],
        lambda data: data[:40],
        lambda data: b"",
        lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:],
        lambda data: b"\0" * len(data),
    ],
    ids=["one byte short", "cut off", "empty", "one bit", "zeros"],
)
def test_a_damaged_checkpoint_is_one_line_and_counts_as_none(tmp_path, capsys, damage):
    step = stopped(tmp_path, 3)
    left(step).write_bytes(damage(left(step).read_bytes()))
    assert_right(run(step, "cpu"), tmp_path)
    assert diary(tmp_path)[4:] == [*range(STEPS)]
    assert capsys.readouterr().out.count("count | warning: what an earlier run left half-done cannot be used") == 1


def test_one_that_was_being_written_leaves_the_one_before(tmp_path):
    step = stopped(tmp_path, 3)
    left(step).with_name(f"{CHECKPOINT}.unfinished").write_bytes(left(step).read_bytes()[:100])
    for name in ("manifest.json", "arrays.safetensors", "other.bin"):  # killed while the result was written
        left(step).with_name(name).write_bytes(b"half")
    assert_right(run(step, "cpu"), tmp_path)
    assert diary(tmp_path) == [*range(STEPS)]


def test_no_room_for_a_checkpoint_is_one_warning_and_no_more(tmp_path):
    """A limit on the size of files stands for the full disk: writing fails in the same place, half-way."""
    process = start(tmp_path, size=1_000_000, limit=100_000)
    process.join()
    said = (tmp_path / "out").read_text()
    assert process.exitcode == 0 and said.count("warning") == said.count("no checkpoint could be written") == 1
    assert_right(run(counting(tmp_path, size=1_000_000), "cpu"), tmp_path)


def test_what_is_half_done_is_shown_collected_and_cleaned(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    made = Tracking(folder, config={}, name="x", tags={})
    made.close(scores={}, status="FINISHED")
    for remove in (lambda: collect(folder), lambda: clean([Path("artifacts")], Path("artifacts"))):
        step = stopped(folder, 3, size=500_000)
        remove()
        assert not left(step).exists() and " 2 MB" in capsys.readouterr().out  # of float32
        run(step, "cpu")
        assert diary(folder)[4:] == [*range(STEPS)]
        (folder / "diary").unlink()
        for path in step.folder.iterdir():
            path.unlink() if path.is_file() else None


def test_the_seconds_of_a_result_are_those_of_all_its_runs(tmp_path):
    step = stopped(tmp_path, 3)
    kept = physics3d.checkpoint._unpacked(left(step).read_bytes())
    assert run(step, "cpu").manifest["seconds"] > kept["seconds"] > 0
