"""make sweep SCENES=carnation,ball METHODS=physics3d,without_viscoelastic SEEDS=0,1 RUNNER=dask: many runs at once.

    python -m pipeline.sweep scenes=... [methods=...] [seeds=...] [runner=thread|process|dask|ray] [workers=2]
                             [address=tcp://host:8786] [key=value ...]

Every combination is a variant: the graph of `make run`, whose steps are Prefect tasks on one of Prefect's own runners.
What variants have in common is computed once. A step is handed over when everything before it is filed, so that no
worker waits; it files its result on the shelf, which all workers see, and what comes back is only word of that. A
worker that dies loses the step it was at: Dask gives it to another one, and where a whole pool ends with it the flow
starts again with what is left. A variant that fails does not keep others from going on.

Each variant that ends is one run in MLflow, tagged with the sweep; the outcome is one table, sweeps/<name>.csv, and one
page. Exit codes: 0 all done, 1 a variant failed, 2 the command line is wrong, 130 interrupted. See docs/clusters.md.
"""

import csv
import ctypes
import itertools
import logging
import multiprocessing
import queue
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from physics3d.cores import usable
from physics3d.log import Log
from pipeline.__main__ import quiet, title
from pipeline.flow import Plan, before, built, first, idle, plan, suit, up_to_date
from pipeline.hired import end_within
from pipeline.report import headline
from pipeline.server import HERE, server
from pipeline.settings import SettingsError, compose
from pipeline.shelf import using
from pipeline.stage import Filed, StageError, Step, as_task, here, load, manifest
from pipeline.tracking import Tracking, address, mend
from pipeline.words import literal_paths

RUNNERS = {"thread": "", "process": "", "dask": "prefect_dask", "ray": "prefect_ray"}  # and the module each needs
OWN = ("scenes", "methods", "seeds", "runner", "workers", "address")
DEATHS = 3  # of workers, one after the other, between which no step was filed


class WorkerDied(Exception):
    """A worker is gone, and the pool with it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Variant:
    """One run of the sweep, and what it is called."""

    scene: str
    method: str
    seed: str
    config: dict[str, Any]
    name: str
    tags: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Crew:
    """Who computes: one of Prefect's runners with so many workers, or those of a cluster that is there already."""

    runner: str
    workers: int
    address: str

    def hired(self) -> Any:
        """A task runner of Prefect, for one flow."""
        from prefect.task_runners import ProcessPoolTaskRunner, ThreadPoolTaskRunner

        match self.runner:
            case "thread":
                return ThreadPoolTaskRunner(max_workers=self.workers)
            case "process":
                return ProcessPoolTaskRunner(max_workers=self.workers)
            case "ray":
                from prefect_ray import RayTaskRunner

                if self.address:
                    return RayTaskRunner(address=self.address)
                return RayTaskRunner(init_kwargs={"num_cpus": self.workers, "include_dashboard": False})
        from prefect_dask import DaskTaskRunner

        if self.address:
            return DaskTaskRunner(address=self.address)
        local = {"n_workers": self.workers, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None}
        return DaskTaskRunner(cluster_kwargs=local)

    def host(self) -> str:
        """The address of this machine that the workers can reach. Raises SettingsError if the cluster has none."""
        there = urlsplit(self.address).hostname
        if there is None or there in HERE:
            return "127.0.0.1"
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.connect((there, urlsplit(self.address).port or 8786))  # sends nothing
                return probe.getsockname()[0]
        except OSError as error:
            raise SettingsError(f"address={self.address}: {error.strerror}; say address=tcp://<host>:<port>") from error


def main(words: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        crew, variants = asked(words)
        return run(crew, variants)
    except SettingsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (StageError, OSError, RuntimeError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; finished stages are kept, the same command goes on from there", file=sys.stderr)
        end_within(130)
        return 130


def asked(words: list[str]) -> tuple[Crew, list[Variant]]:
    """Who is to compute, and what. Raises SettingsError."""
    own = {key: value for key, _, value in (word.partition("=") for word in words) if key in OWN}
    rest = [word for word in words if word.partition("=")[0] not in OWN]
    lists = {key: [v.strip() for v in own.get(key, "").split(",") if v.strip()] for key in OWN[:3]}
    if not lists["scenes"]:
        raise SettingsError("scenes is empty; say SCENES=carnation,ball (scenes=carnation,ball)")
    variants = []
    combinations = list(itertools.product(*(lists[key] or [""] for key in OWN[:3])))
    # a second each; nothing is written
    for scene, method, seed in Log(Path(), name="sweep").progress(combinations, "settings"):
        said = [f"{k}={v}" for k, v in (("scene", scene), ("method", method), ("seed", seed)) if v]
        config, picked = compose(literal_paths([*said, *rest]))
        name, tags = title(picked, config, rest)
        made = {"scene": scene, "method": picked["method"], "seed": str(config["seed"])}
        variants.append(Variant(config=config, name=name, tags=tags, **made))
    return _crew(own, len(variants)), variants


def _crew(own: dict[str, str], most: int) -> Crew:
    runner, where = own.get("runner") or "process", own.get("address", "")
    if runner not in RUNNERS:
        raise SettingsError(f"runner is {runner!r}; take one of {', '.join(RUNNERS)}")
    if RUNNERS[runner] and find_spec(RUNNERS[runner]) is None:
        package = RUNNERS[runner].replace("_", "-")
        raise SettingsError(f"runner={runner} needs the package {package}; pip install {package}, or runner=process")
    if where and runner not in ("dask", "ray"):
        raise SettingsError(f"address={where}: runner={runner} stays on this machine; take runner=dask, or no address")
    if where and not _is_address(where, runner):
        raise SettingsError(f"address={where} is none of a cluster; take address=tcp://<host>:<port>")
    workers = own.get("workers") or str(min(most, usable()))
    if not re.fullmatch("[1-9][0-9]{0,3}", workers):
        raise SettingsError(f"workers is {workers!r}; take a number from 1 to 9999")
    return Crew(runner=runner, workers=int(workers), address=where)


def _is_address(text: str, runner: str) -> bool:
    """Whether a cluster can be asked for there; Ray also knows names without a port."""
    try:
        parts = urlsplit(text)
        return runner == "ray" or bool(parts.scheme and parts.hostname and parts.port)
    except ValueError:
        return False


def run(crew: Crew, variants: list[Variant]) -> int:
    """Compute what is not filed yet, record every variant as it ends, and show the table."""
    return 0 if all(row["state"] == "done" for row in swept(crew, variants).values()) else 1


def swept(crew: Crew, variants: list[Variant]) -> dict[Variant, dict[str, Any]]:
    """The same; the rows of the table, of each variant its `state`, done or what went wrong, and its numbers."""
    output = Path(variants[0].config["output"]).expanduser().resolve()
    shelf, name = output / "artifacts", time.strftime("%Y%m%d-%H%M%S")
    with using(shelf):  # a place that cannot be written is said before anything is imported
        pass
    mend(output)
    rows: dict[Variant, dict[str, Any]] = {}
    recorded: set[Path] = set()  # what one variant computed, the next one found

    def done(variant: Variant, whole: Plan | None, filed: dict[Path, Filed], error: str) -> None:
        row: dict[str, Any] = {"scene": variant.scene, "method": variant.method, "seed": variant.seed}
        rows[variant] = row | {"state": error or "done"}
        if whole is None or error:
            print(f"{variant.name}: {error}", file=sys.stderr, flush=True)
            return
        tracking = Tracking(output, config=variant.config, name=variant.name, tags=variant.tags | {"sweep": name})
        seconds = 0.0
        for step in whole.steps:
            told = filed[step.folder]
            told = Filed(step, told.hit or step.folder in recorded, told.manifest)
            seconds += 0.0 if told.hit else told.manifest["seconds"]
            recorded.add(step.folder)
            tracking.stage(told)
        scores = headline(whole)
        tracking.close(scores=scores, status="FINISHED")
        rows[variant] |= {"seconds": seconds, **scores}
        print(f"{variant.name}: done, {seconds:.0f} s of stages computed", flush=True)

    with using(shelf):
        waiting = []
        for variant in variants:
            if whole := up_to_date(variant.config, shelf, variant.config["verify"]):
                done(variant, whole, {s.folder: Filed(s, True, manifest(s)) for s in whole.steps}, "")
            else:
                waiting.append(variant)
        if waiting:
            compute(crew, waiting, shelf, done)
    table = output / "sweeps" / f"{name}.csv"
    _write(table, [rows[variant] for variant in variants])
    _show([rows[variant] for variant in variants])
    print(f"table     {table}")
    if (output / "mlflow.db").exists():
        print(f"all runs  make ui, or {address(output, sweep=name)}")
    return rows


def compute(crew: Crew, variants: list[Variant], shelf: Path, done: Callable) -> None:
    """Run the steps of all variants; `done(variant, plan, filed, error)` is called as each of them ends."""
    quiet()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # a worker that dies is said in one line, below
    work = _Work(variants, shelf, done)
    with server(shelf.parent / ".prefect", meanwhile=work.check, host=crew.host()):
        deaths = 0
        while work.variants:
            progress = len(work.filed)
            try:
                work.go_on(crew)
            except WorkerDied as error:
                deaths = deaths + 1 if len(work.filed) == progress else 1
                if deaths == DEATHS:
                    raise StageError(f"{DEATHS} workers died at the same steps ({error}); is memory short?") from error
                print(f"{'sweep':>16} | a worker died ({error}); going on with what is left", flush=True)


class _Work:
    """What is to be done: plans, and what of them is filed, failed or under way."""

    def __init__(self, variants: list[Variant], shelf: Path, done: Callable):
        self.variants = list(variants)  # that have not ended
        self.shelf, self.done = shelf, done
        self.plans: dict[Variant, Plan] = {}
        self.stages: dict[Variant, dict[str, Any]] = {}
        self.filed: dict[Path, Filed] = {}
        self.failed: dict[Path, str] = {}

    def check(self) -> None:
        """Build every stage of every variant once. Raises StageError."""
        self.stages = {v: built(v.config, here(v.config["device"])) for v in self.variants}
        self.plans = {v: Plan([first(v.config, self.shelf)]) for v in self.variants}

    def go_on(self, crew: Crew) -> None:
        """One flow, until all variants have ended. Raises WorkerDied."""
        from prefect import flow

        @flow(name="physics3d sweep", task_runner=crew.hired(), persist_result=False)
        def sweep() -> None:
            futures: dict[Path, Any] = {}
            ended: queue.SimpleQueue = queue.SimpleQueue()
            while True:
                for variant in list(self.variants):
                    self._advance(variant, futures, ended)
                if not self.variants:
                    return
                try:
                    self._take(*ended.get())
                except WorkerDied:
                    while not ended.empty():  # what others have filed meanwhile counts
                        with suppress(WorkerDied):
                            self._take(*ended.get())
                    raise
                except BaseException:  # Ctrl-C, or what Prefect makes of SIGTERM
                    interrupt_all()
                    raise

        sweep()

    def _advance(self, variant: Variant, futures: dict[Path, Any], ended: queue.SimpleQueue) -> None:
        """Hand over every step of a variant that can begin, and see whether the variant has ended."""
        whole, error = self.plans[variant], ""
        if len(whole.steps) == 1 and whole.steps[0].folder in self.filed:
            try:
                capture = whole.steps[0]
                whole = self.plans[variant] = plan(variant.config, capture)
                outline = getattr(load(capture, "cpu"), "outline", None)
                suit(self.stages[variant], outline, idle(variant.config) | whole.left_out)
            except StageError as unsuited:
                error = str(unsuited)
        for step in whole.steps if not error else ():
            first_ones = before(step)
            if bad := next((s.folder for s in first_ones if s.folder in self.failed), None):
                self.failed.setdefault(step.folder, self.failed[bad])
            known = step.folder in futures or step.folder in self.filed or step.folder in self.failed
            if not known and all(s.folder in self.filed for s in first_ones):
                after = [futures.get(s.folder, self.filed[s.folder]) for s in first_ones]
                task: Any = as_task(step, variant.config["device"], variant.config["verify"])
                future = futures[step.folder] = task.submit(after)
                future.add_done_callback(lambda future, step=step: ended.put((step, future)))
        error = error or next((self.failed[s.folder] for s in whole.steps if s.folder in self.failed), "")
        if error or (len(whole.steps) > 1 and all(s.folder in self.filed for s in whole.steps)):
            self.variants.remove(variant)
            self.done(variant, whole, self.filed, error)

    def _take(self, step: Step, future: Any) -> None:
        try:
            self.filed[step.folder] = future.result()
        except Exception as error:
            if isinstance(error, BrokenExecutor) or type(error).__name__ in ("KilledWorker", "WorkerCrashedError"):
                raise WorkerDied(f"at {step.name}") from error
            self.failed[step.folder] = " ".join(str(error).split()) or type(error).__name__


def interrupt_all() -> None:
    """What threads and processes compute for this one ends as well: pools wait for them, and a stage takes minutes.
    It goes on from its checkpoint when it is asked for again."""
    for thread in threading.enumerate():
        number = thread.ident or 0
        frame = sys._current_frames().get(number)
        waits = frame is None or frame.f_code.co_name == "_worker"  # for work: its pool wakes it
        if thread.name.startswith("ThreadPoolExecutor") and not waits:
            stop = ctypes.py_object(KeyboardInterrupt)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(number), stop)
    for process in multiprocessing.active_children():
        process.kill()


def _write(table: Path, rows: list[dict[str, Any]]) -> None:
    """All numbers of all variants; complete under its name, or not there."""
    table.parent.mkdir(parents=True, exist_ok=True)
    unfinished = table.with_suffix(".unfinished")
    with unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), restval="")
        writer.writeheader()
        writer.writerows(rows)
    unfinished.rename(table)


def _show(rows: list[dict[str, Any]]) -> None:
    """Parameters, and the scores by which materials are compared, variant by variant; bounds and other scores are in
    the file, for a table of them all is wider than a screen."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    named = list(dict.fromkeys(key for row in rows for key in row))
    shown = [key for key in named if not key.startswith(("score/", "learned_")) or key.endswith("/psnr")]
    made = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for key in shown:
        made.add_column(key.translate(str.maketrans("/_ ", "\n\n\n")), overflow="fold")
    for row in rows:
        made.add_row(*(f"{v:.4g}" if isinstance(v := row.get(key, ""), float) else str(v) for key in shown))
    Console(highlight=False, width=None if sys.stdout.isatty() else 160).print(made)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
