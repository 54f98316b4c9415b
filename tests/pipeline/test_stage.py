"""Reuse, damage and everything that may kill a run: nothing half-done looks finished, nothing finished is lost."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.stage import StageError, Step, build, damage, load, run, usual_seconds

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
SCRIPT = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests in the background ignores it
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


def manifest_with(**changes: object) -> str:
    told = {"stage": "b", "fingerprint": "", "seconds": 1.0, "peak_rss_bytes": 1, "files": {"fields.json": [2, "x"]}}
    return json.dumps(told | changes)


MANIFESTS = {
    "null": "null",
    "list": "[]",
    "text": '"b"',
    "number": "1e999",
    "nothing": "",
    "cut off": '{"files": ',
    "too deep": "[" * 100_000,
    "no files": manifest_with(files={}),
    "files is a list": manifest_with(files=[["fields.json", 1, "x"]]),
    "files is null": manifest_with(files=None),
    "entry is null": manifest_with(files={"fields.json": None}),
    "entry is short": manifest_with(files={"fields.json": [1]}),
    "entry of texts": manifest_with(files={"fields.json": ["1", "x"]}),
    "size below zero": manifest_with(files={"fields.json": [-1, "x"]}),
    "without the artifact": manifest_with(files={"log.txt": [0, "x"]}),
    "a file elsewhere": manifest_with(files={"fields.json": [2, "x"], "/etc/passwd": [1, "x"]}),
    "a file above": manifest_with(files={"fields.json": [2, "x"], "../x": [1, "x"]}),
    "another stage": manifest_with(stage="c"),
    "seconds is text": manifest_with(seconds="long"),
    "no memory": manifest_with(peak_rss_bytes=None),
}


@pytest.mark.parametrize("text", MANIFESTS.values(), ids=MANIFESTS.keys())
def test_a_manifest_that_is_none_of_ours_is_damage(tmp_path, text):
    """Of whatever shape: the result is computed again, nobody sees a traceback."""
    step = chain(tmp_path)[0]
    run(step, "cpu")
    (step.folder / "manifest.json").write_text(
        text.replace('"fingerprint": ""', f'"fingerprint": "{step.fingerprint}"')
    )
    assert damage(step)
    assert usual_seconds(step.shelf, "a") in (None, 1.0)
    assert not run(step, "cpu").hit and damage(step) is None


@given(
    keys=st.lists(st.sampled_from(["stage", "fingerprint", "seconds", "peak_rss_bytes", "files"]), min_size=1),
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
        max_leaves=5,
    ),
    whole=st.booleans(),
)
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_other_manifest_is_damage_too(tmp_path, keys, value, whole):
    step = Step("b", "b", {}, (), tmp_path / "artifacts", "0" * 16)
    step.folder.mkdir(parents=True, exist_ok=True)
    told = json.loads(manifest_with(fingerprint=step.fingerprint)) | dict.fromkeys(keys, value)
    (step.folder / "manifest.json").write_text(json.dumps(value if whole else told))
    assert damage(step)  # there is no such file as it names


def spoil(folder: Path, how: str) -> None:
    """Put something else where a result was filed."""
    elsewhere = folder.parent / "elsewhere"
    if how == "a link to a whole one":
        folder.rename(elsewhere)
        folder.symlink_to(elsewhere)
        return
    if how == "a linked file":
        (folder / "fields.json").rename(elsewhere)
        (folder / "fields.json").symlink_to(elsewhere)
        return
    if how == "a folder as manifest":
        (folder / "manifest.json").unlink()
        (folder / "manifest.json").mkdir()
        return
    if how == "a pipe as manifest":  # reading it would wait for ever
        (folder / "manifest.json").unlink()
        os.mkfifo(folder / "manifest.json")
        return
    shutil.rmtree(folder)
    match how:
        case "a file":
            folder.write_text("x")
        case "a broken link":
            folder.symlink_to("nowhere")
        case "a link to itself":
            folder.symlink_to(folder.name)
        case "an empty folder":
            folder.mkdir()


@pytest.mark.parametrize(
    "how",
    [
        *("a file", "a broken link", "a link to itself", "an empty folder", "a link to a whole one", "a linked file"),
        *("a folder as manifest", "a pipe as manifest"),
    ],
)
def test_something_else_in_the_place_of_a_result_is_replaced(tmp_path, how):
    step = chain(tmp_path)[0]
    run(step, "cpu")
    spoil(step.folder, how)
    assert damage(step)
    assert not run(step, "cpu").hit
    assert damage(step) is None and step.folder.is_dir() and not step.folder.is_symlink()


@pytest.mark.parametrize("leftover", ["a file", "a broken link"])
def test_something_in_the_place_of_an_unfinished_result_is_replaced(tmp_path, leftover):
    step = chain(tmp_path)[0]
    unfinished = step.folder.with_name(f".{step.fingerprint}")
    unfinished.mkdir(parents=True)
    spoil(unfinished, leftover)
    assert not run(step, "cpu").hit and not os.path.lexists(unfinished)


def test_a_result_of_other_contents_is_computed_again_when_it_is_needed(tmp_path, capsys):
    """The files are what the manifest says, and yet they are no artifact: made by hand, or by other code."""
    first, second = chain(tmp_path)[:2]
    run(first, "cpu")
    told = json.loads((first.folder / "manifest.json").read_text())
    for text in ("null", '{"__class__": "subprocess:Popen", "fields": {}}', "[" * 100_000):
        (first.folder / "fields.json").write_text(text)
        told["files"]["fields.json"] = [len(text), hashlib.sha256(text.encode()).hexdigest()]
        (first.folder / "manifest.json").write_text(json.dumps(told))
        assert damage(first) is None
        shutil.rmtree(second.folder, ignore_errors=True)
        assert not run(second, "cpu").hit
        assert "a | the stored result is damaged" in capsys.readouterr().out


@pytest.mark.parametrize("place", ["artifacts", "artifacts/a", "artifacts/.locks"])
def test_a_shelf_that_cannot_be_is_one_line(tmp_path, place):
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_text("x")
    with pytest.raises(StageError, match=r"^a: .*(Not a directory|File exists)") as caught:
        run_all(tmp_path)
    assert "\n" not in str(caught.value)


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
