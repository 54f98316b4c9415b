"""MLflow's record: made whole by whoever is first, right after a move, without runs that pretend to go on."""

import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipeline.live
from physics3d.log import Log
from pipeline.stage import Filed, Step
from pipeline.tracking import EXPERIMENT, Tracking, _process, address, free_port, labels, mend

ROOT = Path(__file__).resolve().parent.parent.parent
OPEN = """
import sys
from pathlib import Path
from pipeline.tracking import Tracking
made = Tracking(Path(sys.argv[1]), config={"a": 1}, name=sys.argv[2], tags={})
made.close(scores={}, status="FINISHED")
sys.exit(made.broken)
"""


def opened(folder: Path, name: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", OPEN, str(folder), name], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )


def rows(folder: Path, query: str) -> list[tuple]:
    with sqlite3.connect(folder / "mlflow.db") as record:
        return record.execute(query).fetchall()


def test_a_kill_while_the_tables_are_made_then_two_first_runs_at_once(tmp_path):
    killed = opened(tmp_path, "killed")
    unfinished = tmp_path / "mlflow.db.unfinished"
    while not (unfinished.exists() and unfinished.stat().st_size):
        assert killed.poll() is None and not (tmp_path / "mlflow.db").exists()
        time.sleep(0.005)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert not (tmp_path / "mlflow.db").exists()
    both = [opened(tmp_path, name) for name in ("one", "two")]
    said = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert sorted(rows(tmp_path, "select name, status from runs")) == [("one", "FINISHED"), ("two", "FINISHED")]
    assert len(rows(tmp_path, "select * from experiments where artifact_location like '%/mlartifacts'")) == 1
    assert [p.name for p in tmp_path.glob("mlflow.db*")] == ["mlflow.db"]


# a name with everything that means something to a shell, a URL or a pattern, but for what MLflow cannot address
@pytest.mark.parametrize("name", ["moved", "it's moved & (re) named; $1, [a] = ü@b:c"])
def test_a_record_goes_on_working_where_its_folder_is_moved(folder, tmp_path_factory, name):
    from mlflow.tracking import MlflowClient

    first = Tracking(folder, config={}, name="first", tags={})
    (folder / "note.txt").write_text("kept")
    first.client.log_artifact(first.run, str(folder / "note.txt"))
    first.close(scores={}, status="FINISHED")
    moved = tmp_path_factory.mktemp("elsewhere") / name
    shutil.move(folder, moved)
    mend(moved)
    second = Tracking(moved, config={}, name="second", tags={})
    second.client.log_artifact(second.run, str(moved / "note.txt"))
    assert not second.broken and not folder.exists()
    client = MlflowClient(f"sqlite:///{moved / 'mlflow.db'}")
    for run in (first.run, second.run):
        assert [file.path for file in client.list_artifacts(run)] == ["note.txt"]
        assert Path(client.download_artifacts(run, "note.txt")).read_text() == "kept"
    assert rows(moved, "select artifact_location from experiments where artifact_location like '%mlart%'") == [
        ((moved / "mlartifacts").as_uri(),)
    ]


def test_an_output_folder_that_mlflow_cannot_address_is_said(tmp_path, capsys):
    odd = tmp_path / "what?"
    odd.mkdir()
    assert Tracking(odd, config={}, name="x", tags={}).broken
    assert "output=<another folder>" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["what?"]


def test_runs_whose_processes_are_gone_are_closed_and_no_others(folder):
    Tracking(folder, config={}, name="x", tags={})
    (experiment,) = rows(folder, f"select experiment_id from experiments where name = '{EXPERIMENT}'")[0]
    ended = subprocess.Popen(["true"])  # not waited for: a zombie
    me = _process(os.getpid())
    host, pid, start = me.split()
    processes = {
        "alive": me,
        "elsewhere": f"another-{host} {pid} {int(start) + 1}",
        "no process of ours": "something else",
        "number used again": f"{host} {pid} {int(start) + 1}",
        "never was": f"{host} 999999999 1",
    }
    while "ended" not in _process(ended.pid):
        time.sleep(0.01)
    processes["ended"] = f"{host} {ended.pid} {start}"
    with sqlite3.connect(folder / "mlflow.db") as record:
        for name, process in processes.items():
            values = (name, experiment, name)
            record.execute(
                "insert into runs (run_uuid, experiment_id, name, status) values (?, ?, ?, 'RUNNING')", values
            )
            record.execute("insert into tags (run_uuid, key, value) values (?, 'process', ?)", (name, process))
    mend(folder)
    states = dict(rows(folder, "select name, status from runs"))
    assert {name for name in processes if states[name] == "KILLED"} == {"number used again", "never was", "ended"}
    assert states["x"] == "RUNNING"
    ended.wait()


@pytest.mark.parametrize("content", [b"", b"this is no database", None], ids=["empty", "text", "folder"])
def test_what_is_no_record_is_set_aside_with_a_word(tmp_path, content, capsys):
    file = tmp_path / "mlflow.db"
    file.mkdir() if content is None else file.write_bytes(content)
    mend(tmp_path)
    (aside,) = tmp_path.glob("mlflow.db.damaged-*")
    assert not file.exists() and str(aside) in capsys.readouterr().out
    assert content is None or aside.read_bytes() == content


def test_a_record_in_use_is_left_in_its_place(folder, capsys, monkeypatch):
    with sqlite3.connect(folder / "mlflow.db") as busy:
        busy.execute("begin exclusive")
        plain = sqlite3.connect
        monkeypatch.setattr(sqlite3, "connect", lambda *given, **named: plain(*given, **named, timeout=0.1))
        mend(folder)
    assert "database is locked" in capsys.readouterr().out and (folder / "mlflow.db").exists()


@pytest.mark.parametrize("port", ["abc", "", "0", "70000", "-1", "5000; true", "80.5", "٣"])
def test_what_is_no_port_is_refused(port):
    with pytest.raises(ValueError, match=r"is no port; make ui PORT="):
        free_port(port)


def test_a_port_that_is_taken_is_one_line(folder):
    Tracking(folder, config={}, name="x", tags={})
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        env = {**os.environ, "PORT": str(port)}
        call = [sys.executable, "-m", "pipeline.tracking", str(folder)]
        done = subprocess.run(call, env=env, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and not done.stdout
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: port {port} cannot be served") and "make ui PORT=" in line
    assert free_port(str(port)) == port and str(port) in address(folder, port)


def run_of(folder: Path, modulus: float, psnr: float, hit: bool = False, said: str = "") -> Tracking:
    """The record of a run whose steps are a learned material and a film of it."""
    steps = []
    learned = ["fields.json", "previews/parameters.png", "previews/loss_00003.png"]
    for name, files in (("learn", learned), ("render", ["a.mp4"])):
        step = Step(name, name, {}, (), folder / "artifacts", f"{modulus:g}")
        for file in files:
            (step.folder / file).parent.mkdir(parents=True, exist_ok=True)
            if file.endswith("png"):
                Image.new("RGB", (4, 4)).save(step.folder / file)
            else:
                (step.folder / file).write_text("x")
        steps.append(Filed(step, hit, {"seconds": 3.0, "peak_rss_bytes": 1}))
    tags = {"scene": "ball", "said": said}
    made = Tracking(folder, config={"seed": 1}, name="ball physics3d seed 1 learn.steps=2", tags=tags)
    for filed in steps:
        made.stage(filed)
    scores = {"learned/youngs_modulus": modulus, "score/learned/psnr": psnr, "score/initial/psnr": 9.0}
    made.close(scores=scores, status="FINISHED")
    assert not made.broken
    return made


def test_materials_of_all_runs_can_be_put_in_an_order_also_after_a_move(folder, tmp_path_factory):
    from mlflow.tracking import MlflowClient

    for modulus, psnr in ((1e5, 20.0), (3e5, 30.0), (2e5, 25.0)):
        run_of(folder, modulus, psnr)
    moved = tmp_path_factory.mktemp("elsewhere") / "moved"
    shutil.move(folder, moved)
    mend(moved)
    client = MlflowClient(f"sqlite:///{moved / 'mlflow.db'}")
    (experiment,) = [e for e in client.search_experiments() if e.name == EXPERIMENT]
    order = [{"field_name": "metrics.score/learned/psnr", "ascending": False}]
    best, *rest = client.search_logged_models([experiment.experiment_id], order_by=order)
    assert {m.key: m.value for m in best.metrics} == {"learned/youngs_modulus": 3e5, "score/learned/psnr": 30.0}
    filed = [m.tags["artifact"] for m in (best, *rest)]
    assert filed == ["artifacts/learn/300000", "artifacts/learn/200000", "artifacts/learn/100000"]
    assert best.tags["scene"] == "ball" and best.artifact_location.startswith(moved.as_uri())
    assert [p.name for p in (moved / "mlartifacts").rglob("fields.json")] == ["fields.json"] * 3


def test_a_result_is_labelled_with_what_was_said_of_its_run(folder):
    for modulus, said in ((1e5, ""), (2e5, "learn.search=3 material=elastic")):
        run_of(folder, modulus, 20.0, said=said)
    found = labels(folder)
    assert found["artifacts/render/100000"] == {"scene": "ball", "said": ""}
    assert found["artifacts/render/200000"] == {"scene": "ball", "said": "learn.search=3 material=elastic"}


def test_parents_say_what_was_reused_how_long_it_took_and_show_it(folder):
    made = run_of(folder, 1e5, 20.0, hit=True)
    run = made.client.get_run(made.run)
    assert run.data.tags["cache/learn"] == run.data.tags["cache/render"] == "hit"
    assert {k: v for k, v in run.data.metrics.items() if k.startswith("time/")} == {
        "time/learn_s": 3.0,
        "time/render_s": 3.0,
        "time/all_s": 6.0,
        "time/computed_s": 0.0,
    }
    attached = {f.path for place in ("videos", "plots/learn") for f in made.client.list_artifacts(made.run, place)}
    assert attached == {"videos/a.mp4", "plots/learn/parameters.png"}  # not what belongs to a step of the learning


def test_curves_grow_and_previews_appear_while_a_step_is_at_work_and_none_comes_twice(folder, monkeypatch):
    monkeypatch.setattr(pipeline.live, "EVERY", 0.05)
    monkeypatch.setattr(pipeline.live, "STILL", 0.0)
    step = Step("learn", "learn", {}, (), folder / "artifacts", "0" * 16)
    made = Tracking(folder, config={}, name="x", tags={})
    made.begin(step)
    assert not made.broken
    run, at_work = made.live.run, step.unfinished
    log = Log(at_work, quiet=True)

    def shown() -> list[tuple[int, float]]:
        return [(point.step, point.value) for point in made.client.get_metric_history(run, "loss")]

    for i in range(2):
        log.metric("loss", 5.0 - i, i)
        log.image("frame", np.zeros((4, 4, 3)), i)
        while len(shown()) <= i or len(made.client.list_artifacts(run, "images")) <= i:
            assert made.live.thread.is_alive()
            time.sleep(0.02)
    told = (at_work / "metrics.jsonl").read_text()
    (at_work / "metrics.jsonl").unlink()  # as of a stage that goes on from its checkpoint
    (at_work / "metrics.jsonl").write_text(told)
    log.metric("loss", 3.0, 2)
    at_work.rename(step.folder)
    made.stage(Filed(step, False, {"seconds": 3.0, "peak_rss_bytes": 1}))
    made.close(scores={}, status="FINISHED")
    assert not made.broken and sorted(shown()) == [(0, 5.0), (1, 4.0), (2, 3.0)]
    assert dict(rows(folder, "select name, status from runs")) == {"learn": "FINISHED", "x": "FINISHED"}


def test_the_run_of_a_step_that_fails_ends_with_it(folder):
    made = Tracking(folder, config={}, name="x", tags={})
    made.begin(Step("learn", "learn", {}, (), folder / "artifacts", "0" * 16))
    made.close(scores={}, status="FAILED")
    assert dict(rows(folder, "select name, status from runs")) == {"learn": "FAILED", "x": "FAILED"}


def test_the_experiment_says_that_it_is_of_training_runs(folder):
    """The word is the one that the page of the installed MLflow knows."""
    import mlflow

    made = Tracking(folder, config={}, name="x", tags={})
    kind = made.client.get_experiment(made.experiment).tags["mlflow.experimentKind"]
    made.close(scores={}, status="FINISHED")
    page = Path(mlflow.__file__).parent / "server" / "js" / "build" / "static" / "js"
    assert any(f'CUSTOM_MODEL_DEVELOPMENT="{kind}"' in file.read_text() for file in page.glob("*.js"))


def test_the_load_of_the_machine_is_recorded_until_the_end(folder, monkeypatch):
    monkeypatch.setenv("MLFLOW_SYSTEM_METRICS_SAMPLING_INTERVAL", "0.05")
    made = Tracking(folder, config={}, name="x", tags={})
    while not rows(folder, "select 1 from latest_metrics where key like 'system/%memory%'"):
        time.sleep(0.05)
    made.close(scores={}, status="FINISHED")
    assert made.load._process is None or not made.load._process.is_alive()
    assert rows(folder, "select 1 from latest_metrics where key like 'system/cpu%'")
