"""A process killed in each of the eight stages, one run after the other, with Prefect and MLflow on."""

import multiprocessing
import os
import signal
import sqlite3
import sys
import time
from collections import Counter

import pytest
from toy import ALL, configuration

from pipeline.stage import read_manifest

STAGES = ("capture", "reconstruct", "segment", "fill", "learn", "simulate", "render", "evaluate")


def whole_run(config: dict, out: str) -> None:
    """The command line on a given configuration, in this process."""
    from pipeline import __main__ as command

    sys.stdout = sys.stderr = open(out, "w")  # noqa: SIM115
    command.compose = lambda words: (config, dict.fromkeys(command.GROUPS, "toy"))
    sys.exit(command.main([]))


@pytest.fixture
def processes(prefect, monkeypatch):
    """A way to start processes that have imported everything already: nine runs in seconds."""
    monkeypatch.setenv("PYTHONPATH", prefect["PYTHONPATH"])
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "prefect", "mlflow", "toy", "test_kills"])
    return context.Process


def test_a_kill_in_any_stage_loses_that_stage_only(folder, processes):
    config = configuration(folder)
    diary, shelf = folder / "diary", folder / "artifacts"
    for stage in (*STAGES, None):
        if stage:
            (folder / f"stop in {stage}").touch()
        before = diary.read_text().splitlines() if diary.exists() else []
        process = processes(target=whole_run, args=(config, str(folder / "out")))
        process.start()
        while stage and stage not in (diary.read_text().splitlines() if diary.exists() else [])[len(before) :]:
            assert process.is_alive(), (folder / "out").read_text()
            time.sleep(0.02)
        if stage:
            os.kill(process.pid, signal.SIGKILL)
            (folder / f"stop in {stage}").unlink()
        process.join()
        assert process.exitcode == (-signal.SIGKILL if stage else 0), (folder / "out").read_text()
        for result in shelf.glob("[!.]*/[!.]*"):  # nothing half-done looks finished
            files = read_manifest(result)["files"]
            assert all((result / name).stat().st_size == size for name, (size, _) in files.items())
    # once to its kill, once to its end; some are there twice, for the initial material
    ends = [*STAGES, "guess", "simulate", "render"]
    assert Counter(diary.read_text().splitlines()) == Counter(STAGES) + Counter(ends)
    assert not list(shelf.glob("[!.]*/.*")) and len(list(shelf.glob("[!.]*/[!.]*"))) == len(ALL)
    with sqlite3.connect(folder / "mlflow.db") as record:
        query = "select status, count(*) from runs where run_uuid not in "
        query += "(select run_uuid from tags where key = 'mlflow.parentRunId') group by status"
        # the run killed in its first stage had not begun its record
        assert dict(record.execute(query).fetchall()) == {"KILLED": len(STAGES) - 1, "FINISHED": 1}
        assert record.execute("select count(*) from runs where status = 'RUNNING'").fetchone() == (0,)
