"""MLflow: one run per flow, one nested run per stage, with what the stage tells while it runs and what it leaves.

A stage that was reused is replayed (tag cache=hit), so that every run shows all curves and previews. What people
compare stands on the parent: headline numbers, seconds per stage (`time/<step>_s`), which of them were reused
(tag `cache/<step>`), videos, plots, and the load of the machine. The learned material is an object of its own, a logged
model with its parameters and scores as metrics, so that all materials of all runs can be put in an order. Tracking may
fail, results may not: any error here is one warning, and the run goes on without.

The database is made beside its place and renamed, under a lock: a kill while MLflow creates its tables, or two first
runs at once, leave a whole one or none. MLflow stores where pictures lie as absolute addresses, and keeps a run whose
process was killed as running; `mend`, before every run, corrects both, and sets aside what is no record. It needs no
MLflow, only SQLite.

    python -m pipeline.tracking <output folder>        prints the address that compares runs, and serves it
"""

import fcntl
import logging
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pipeline.live import NUMBERED, Live, metric_name
from pipeline.stage import Filed, Step

EXPERIMENT = "physics3d"
KIND = {"mlflow.experimentKind": "custom_model_development"}  # else the page may open on tools for chats and traces
SHOWN = ("learn", "render", "foretell", "evaluate")  # steps whose videos and plots are attached to the parent as well


class Tracking:
    """The MLflow run of one flow. Every method swallows errors after one warning."""

    def __init__(self, output: Path, *, config: dict[str, Any], name: str, tags: dict[str, str]):
        self.output = output.resolve()
        self.name = name
        self.broken = False
        self.seconds = {"all": 0.0, "computed": 0.0}  # of the steps, and of those that this run computed
        self.learned: Filed | None = None
        self.load: Any = None  # what records the load of the machine
        self.live: Live | None = None  # what the step at work tells
        self._attempt(lambda: self._open(config, name, tags))

    def begin(self, step: Step) -> None:
        """Open the nested run of a step that is about to be computed, and have it show what the step tells."""
        self._attempt(lambda: self._begin(step))

    def stage(self, filed: Filed) -> None:
        """Show in a nested run what a step has left, as far as it was not shown while it ran."""
        self._attempt(lambda: self._replay(filed))

    def close(self, *, scores: dict[str, float], status: str) -> None:
        """Headline numbers on the parent. `status` is FINISHED, FAILED or KILLED."""
        self._attempt(lambda: self._close(scores, status))

    def _attempt(self, action: Callable[[], None]) -> None:
        if self.broken:
            return
        try:
            action()
        except Exception as error:
            self.broken = True
            _warn(error)

    def _open(self, config: dict[str, Any], name: str, tags: dict[str, str]) -> None:
        os.environ.update(DO_NOT_TRACK="true", MLFLOW_DISABLE_TELEMETRY="true")
        logging.getLogger("alembic").setLevel(logging.WARNING)
        from mlflow.entities import Param
        from mlflow.tracking import MlflowClient

        logging.getLogger("mlflow").setLevel(logging.CRITICAL)  # it would print whole tracebacks; we say one line
        with _lock(self.output):
            if not (self.output / "mlflow.db").exists():
                _make(self.output)
            self.client = MlflowClient(database(self.output))
            known = self.client.get_experiment_by_name(EXPERIMENT)
            store = _store(self.output)
            self.experiment = known.experiment_id if known else self.client.create_experiment(EXPERIMENT, store)
            for key, value in KIND.items():
                self.client.set_experiment_tag(self.experiment, key, value)
        tags = {**tags, "process": _process(os.getpid())}
        self.run = self.client.create_run(self.experiment, run_name=name, tags=tags).info.run_id
        params = [Param(key, str(value)[:500]) for key, value in flatten(config).items()]
        for i in range(0, len(params), 100):
            self.client.log_batch(self.run, params=params[i : i + 100])
        from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

        self.load = SystemMetricsMonitor(self.run, tracking_uri=database(self.output))
        self.load.start()

    def _begin(self, step: Step) -> None:
        self.live = Live(self.client, self._nested(step))
        self.live.follow(step.unfinished)

    def _nested(self, step: Step) -> str:
        tags = {
            "mlflow.parentRunId": self.run,
            "stage": step.stage,
            "key": step.fingerprint,
            "artifact": os.path.relpath(step.folder, self.output),
            "process": _process(os.getpid()),
        }
        return self.client.create_run(self.experiment, run_name=step.name, tags=tags).info.run_id

    def _replay(self, filed: Filed) -> None:
        step, folder = filed.step, filed.step.folder
        cache = "taken" if step.taken else "hit" if filed.hit else "miss"
        live, self.live = self.live or Live(self.client, self._nested(step)), None
        live.end()
        live.send(folder)
        run = live.run
        self.client.set_tag(run, "cache", cache)
        self.client.log_metric(run, "seconds", filed.manifest["seconds"])
        self.client.log_metric(run, "peak_rss_gb", filed.manifest["peak_rss_bytes"] / 1e9)
        for path in [*sorted(folder.glob("*.mp4")), folder / "manifest.json", folder / "log.txt"]:
            if path.is_file():
                self.client.log_artifact(run, str(path))
        self.client.set_terminated(run)
        self.client.log_metric(self.run, f"time/{step.name}_s", filed.manifest["seconds"])
        self.client.set_tag(self.run, f"cache/{step.name}", cache)
        self.seconds["all"] += filed.manifest["seconds"]
        self.seconds["computed"] += 0.0 if filed.hit else filed.manifest["seconds"]
        if step.name in SHOWN:
            for path in sorted(folder.glob("*.mp4")):
                self.client.log_artifact(self.run, str(path), "videos")
            for path in sorted((folder / "previews").glob("*.png")):
                if not NUMBERED.fullmatch(path.stem):
                    self.client.log_artifact(self.run, str(path), f"plots/{step.name}")
        if step.name == "learn":
            self.learned = filed

    def _close(self, scores: dict[str, float], status: str) -> None:
        if self.live is not None:  # of the step that failed, or was interrupted
            self.live.end()
            self.client.set_terminated(self.live.run, status)
        for key, value in scores.items():
            self.client.log_metric(self.run, metric_name(key), value)
        for key, seconds in self.seconds.items():
            self.client.log_metric(self.run, f"time/{key}_s", seconds)
        if self.load is not None:
            self.load.finish()
        if self.learned is not None and status == "FINISHED":
            self._material(self.learned, scores)
        self.client.set_terminated(self.run, status)

    def _material(self, filed: Filed, scores: dict[str, float]) -> None:
        """The learned material as a logged model: `search_logged_models` and the tab Models of the page order them."""
        from mlflow.entities import LoggedModelOutput

        told = self.client.get_run(self.run).data
        step = filed.step
        made = self.client.create_logged_model(
            self.experiment,
            name=re.sub(r"[/:.%\"']", " ", self.name)[:200],
            source_run_id=self.run,
            tags={k: v for k, v in told.tags.items() if not k.startswith(("mlflow.", "cache/", "process"))}
            | {"key": step.fingerprint, "artifact": os.path.relpath(step.folder, self.output)},
            params={k: v for k, v in told.params.items() if k.startswith(("material.", "world.", "learn."))},
            model_type="material",
        )
        for name in ("fields.json", "arrays.safetensors"):  # physics3d.artifact reads them
            if (step.folder / name).is_file():
                self.client.log_model_artifact(made.model_id, str(step.folder / name))
        for key, value in scores.items():
            if key.startswith(("learned/", "score/learned/")):
                self.client.log_metric(self.run, metric_name(key), value, model_id=made.model_id)
        self.client.finalize_logged_model(made.model_id, "READY")
        self.client.log_outputs(self.run, [LoggedModelOutput(made.model_id, step=0)])


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Nested configuration -> {"learn.steps": 50, ...}."""
    items = config.items() if isinstance(config, dict) else enumerate(config)
    flat: dict[str, Any] = {}
    for key, value in items:
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, dict | list) and value else {name: value}
    return flat


def mend(output: Path) -> None:
    """Give a record whose folder was moved its new addresses, and close the runs whose processes are gone."""
    file = output.resolve() / "mlflow.db"
    if not file.exists():
        return
    try:
        with _lock(output):
            if not _is_record(file):
                aside = file.with_name(f"mlflow.db.damaged-{time.strftime('%Y%m%d-%H%M%S')}")
                file.rename(aside)
                print(f"{'mlflow':>16} | warning: the record was damaged; it is kept as {aside}, and begun anew")
                return
            with closing(_connect(file, "rw")) as record, record:
                query = "select experiment_id, artifact_location from experiments where name = ?"
                for experiment, old in record.execute(query, (EXPERIMENT,)).fetchall():
                    _move(record, experiment, old, _store(output))
                    _close_dead(record, experiment)
    except (OSError, sqlite3.Error) as error:
        _warn(error)


def _is_record(file: Path) -> bool:
    """Whether it has tables of MLflow; one that is busy, or not ours to read, counts as a record."""
    if not file.is_file():
        return False
    try:
        with closing(_connect(file, "ro")) as record:
            record.execute("select 1 from experiments, runs, tags limit 1").fetchall()
        return True
    except sqlite3.DatabaseError as error:
        return isinstance(error, sqlite3.OperationalError) and "no such table" not in str(error)


def _move(record: sqlite3.Connection, experiment: int, old: str, new: str) -> None:
    if old == new:
        return
    places = (("experiments", "artifact_location"), ("runs", "artifact_uri"), ("logged_models", "artifact_location"))
    for table, column in places:
        change = f"update {table} set {column} = ? || substr({column}, ?) "
        change += f"where experiment_id = ? and substr({column}, 1, ?) = ?"
        record.execute(change, (new, len(old) + 1, experiment, len(old), old))


def _close_dead(record: sqlite3.Connection, experiment: int) -> None:
    query = "select run_uuid, value from runs join tags using (run_uuid) "
    query += "where experiment_id = ? and status = 'RUNNING' and key = 'process'"
    dead = [run for run, process in record.execute(query, (experiment,)).fetchall() if _gone(process)]
    close = "update runs set status = 'KILLED', end_time = ? where run_uuid = ?"
    record.executemany(close, [(int(time.time() * 1000), run) for run in dead])


@contextmanager
def _lock(output: Path) -> Iterator[None]:
    with (output / ".mlflow.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the system takes it back from a dead process
        yield


def database(output: Path) -> str:
    """Raises ValueError for a folder that MLflow cannot address."""
    if odd := set("?#%") & set(str(output.resolve())):
        raise ValueError(f"no address of SQLAlchemy's may hold {' '.join(sorted(odd))}; output=<another folder>")
    return f"sqlite:///{output.resolve() / 'mlflow.db'}"


def _store(output: Path) -> str:
    return (output.resolve() / "mlartifacts").as_uri()


def _make(output: Path) -> None:
    """A database with MLflow's tables: complete under its name, or not there."""
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    for old in output.glob("mlflow.db.unfinished*"):  # of a run that was killed here
        old.unlink()
    unfinished = output / "mlflow.db.unfinished"
    store = SqlAlchemyStore(f"{database(output)}.unfinished", _store(output))
    store.engine.dispose()
    unfinished.rename(output / "mlflow.db")


def _connect(file: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{file.as_uri()}?mode={mode}", uri=True)


def _process(pid: int) -> str:
    """What tells a process from a later one of the same number: machine, number, start in ticks of its clock."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        start = "ended" if told[0] in "ZX" else told[19]
    except OSError:  # no Linux
        start = "?"
    return f"{socket.gethostname()} {pid} {start}"


def _gone(process: str) -> bool:
    """Whether the process of a tag has ended; one of another machine counts as alive."""
    found = re.fullmatch(r"(.*) (\d{1,9}) (\w+|\?)", process)
    if not found or found[1] != socket.gethostname():
        return False
    try:
        os.kill(int(found[2]), 0)
    except ProcessLookupError:
        return True
    except PermissionError:  # alive, and somebody else's
        pass
    return _process(int(found[2])) != process


def _warn(error: Exception) -> None:
    text = " ".join(str(error).split())[:200]
    print(f"{'mlflow':>16} | warning: not recorded in MLflow, the results are unharmed ({text})", flush=True)


def git_commit(root: Path) -> str:
    """Commit of the working tree, with + if it differs, "none" outside git, or where the package is installed."""
    if not (root / ".git").exists():
        return "none"
    call = ["git", "-C", str(root), "describe", "--always", "--abbrev=10", "--dirty=+"]
    try:
        return subprocess.run(call, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "none"


def labels(output: Path) -> dict[str, dict[str, str]]:
    """artifacts/<stage>/<fingerprint> -> scene, method, profile, seed and what else was said (`said`) of the newest run
    that had it; none without record."""
    query = "select art.value, tag.key, tag.value from tags art join tags parent on parent.run_uuid = art.run_uuid "
    query += "join tags tag on tag.run_uuid = parent.value join runs on runs.run_uuid = parent.value "
    query += "where art.key = 'artifact' and parent.key = 'mlflow.parentRunId' "
    query += "and tag.key in ('scene', 'method', 'profile', 'seed', 'said') order by runs.start_time"
    found: dict[str, dict[str, str]] = {}
    try:
        with closing(_connect(output.resolve() / "mlflow.db", "ro")) as record:
            for artifact, key, value in record.execute(query).fetchall():
                found.setdefault(artifact, {})[key] = value
    except sqlite3.Error:
        pass
    return found


def address(output: Path, port: int = 5000, sweep: str = "") -> str:
    """The page that compares runs, or those of a sweep, once `serve` runs."""
    with closing(_connect(output.resolve() / "mlflow.db", "ro")) as record:
        query = "select experiment_id from experiments where name = ?"
        (experiment,) = record.execute(query, (EXPERIMENT,)).fetchone()
    return f"http://127.0.0.1:{port}/#/experiments/{experiment}/runs?compareRunsMode=CHART{_filter(sweep)}"


def _filter(sweep: str) -> str:
    only = f"tags.sweep = '{sweep}'"
    return f"&searchFilter={quote(only)}" if sweep else ""


def serve(output: Path, port: str) -> int:
    """Print the address and serve it until Ctrl-C."""
    try:
        number = free_port(port)
        mend(output)
        print(f"open {address(output, number)}\n(up in about 15 s; Ctrl-C ends it)", flush=True)
        options = ["--backend-store-uri", database(output), "--host", "127.0.0.1", "--port", str(number)]
    except (sqlite3.Error, TypeError):
        print(
            f"error: no runs recorded under {output.resolve()} yet; `make run SCENE=carnation` makes one",
            file=sys.stderr,
        )
        return 1
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with subprocess.Popen([sys.executable, "-m", "mlflow", "ui", *options]) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            return 0


def free_port(port: str, command: str = "make ui") -> int:
    """The number of a port that can be served. Raises ValueError with the remedy."""
    remedy = f"{command} PORT=<a number from 1024 to 65535>"
    if not re.fullmatch("[0-9]{1,5}", port) or not 0 < int(port) < 65536:
        raise ValueError(f"PORT={port} is no port; {remedy}")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one that was closed a moment ago is free
        try:
            probe.bind(("127.0.0.1", int(port)))
        except OSError as error:
            taken = f"port {port} cannot be served ({error.strerror}); is `{command}` running elsewhere?"
            raise ValueError(f"{taken} {remedy}") from error
    return int(port)


def main(words: list[str]) -> int:
    return serve(Path(words[0] if words else "."), os.environ.get("PORT") or "5000")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
