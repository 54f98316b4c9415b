"""MLflow: one run per flow, one nested run per stage, replayed from what the stage left in its artifact.

A stage that was reused is replayed too (tag cache=hit), so that every run shows all curves and previews. Headline
numbers stand on the parent, because parents are what people compare. Tracking may fail, results may not: any error here
is one warning, and the run goes on without.

    python -m pipeline.tracking <output folder>        prints the address that compares runs, and serves it
"""

import json
import logging
import os
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.stage import Filed

EXPERIMENT = "physics3d"
BATCH = 1000  # metrics per request that MLflow takes; 100 for parameters


class Tracking:
    """The MLflow run of one flow. Every method swallows errors after one warning."""

    def __init__(self, output: Path, *, config: dict[str, Any], name: str, tags: dict[str, str]):
        self.output = output.resolve()
        self.broken = False
        self._attempt(lambda: self._open(config, name, tags))

    def stage(self, filed: Filed) -> None:
        """Replay a filed step as a nested run."""
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
            text = " ".join(str(error).split())[:200]
            print(f"{'mlflow':>16} | warning: not recorded in MLflow, the results are unharmed ({text})", flush=True)

    def _open(self, config: dict[str, Any], name: str, tags: dict[str, str]) -> None:
        os.environ.update(DO_NOT_TRACK="true", MLFLOW_DISABLE_TELEMETRY="true")
        logging.getLogger("alembic").setLevel(logging.WARNING)
        from mlflow.entities import Param
        from mlflow.tracking import MlflowClient

        logging.getLogger("mlflow").setLevel(logging.ERROR)
        self.client = MlflowClient(database(self.output))
        known = self.client.get_experiment_by_name(EXPERIMENT)
        store = (self.output / "mlartifacts").as_uri()
        self.experiment = known.experiment_id if known else self.client.create_experiment(EXPERIMENT, store)
        self.run = self.client.create_run(self.experiment, run_name=name, tags=tags).info.run_id
        params = [Param(key, str(value)[:500]) for key, value in flatten(config).items()]
        for i in range(0, len(params), 100):
            self.client.log_batch(self.run, params=params[i : i + 100])

    def _replay(self, filed: Filed) -> None:
        from mlflow.entities import Metric

        step, folder = filed.step, filed.step.folder
        tags = {
            "mlflow.parentRunId": self.run,
            "stage": step.stage,
            "cache": "hit" if filed.hit else "miss",
            "key": step.fingerprint,
            "artifact": str(folder),
        }
        run = self.client.create_run(self.experiment, run_name=step.name, tags=tags).info.run_id
        now = int(time.time() * 1000)
        metrics = [Metric("seconds", filed.manifest["seconds"], now, 0)]
        metrics.append(Metric("peak_rss_gb", filed.manifest["peak_rss_bytes"] / 1e9, now, 0))
        lines = folder / "metrics.jsonl"
        for line in lines.read_text().splitlines() if lines.is_file() else []:
            point = json.loads(line)
            metrics.append(Metric(_name(point["name"]), point["value"], now, point["step"] or 0))
        for i in range(0, len(metrics), BATCH):
            self.client.log_batch(run, metrics=metrics[i : i + BATCH])
        for path in sorted((folder / "previews").glob("*.png")):
            self._preview(run, path)
        for path in [*sorted(folder.glob("*.mp4")), folder / "manifest.json", folder / "log.txt"]:
            if path.is_file():
                self.client.log_artifact(run, str(path))
        self.client.set_terminated(run)
        self.client.log_metric(self.run, f"time/{step.name}_s", filed.manifest["seconds"])

    def _preview(self, run: str, path: Path) -> None:
        """Numbered previews become one picture with a slider over steps, the others plain files."""
        numbered = re.fullmatch(r"(.+)_(\d{5})", path.stem)
        if not numbered:
            self.client.log_artifact(run, str(path), "previews")
            return
        from PIL import Image

        self.client.log_image(run, Image.open(path), key=numbered[1], step=int(numbered[2]))

    def _close(self, scores: dict[str, float], status: str) -> None:
        for key, value in scores.items():
            self.client.log_metric(self.run, _name(key), value)
        self.client.set_terminated(self.run, status)


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Nested configuration -> {"learn.steps": 50, ...}."""
    items = config.items() if isinstance(config, dict) else enumerate(config)
    flat: dict[str, Any] = {}
    for key, value in items:
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, dict | list) and value else {name: value}
    return flat


def database(output: Path) -> str:
    return f"sqlite:///{output.resolve() / 'mlflow.db'}"


def git_commit(root: Path) -> str:
    """Commit of the working tree, with + if it differs, "none" outside git."""
    call = ["git", "-C", str(root), "describe", "--always", "--abbrev=10", "--dirty=+"]
    try:
        return subprocess.run(call, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "none"


def address(output: Path, port: int = 5000) -> str:
    """The page that compares runs, once `serve` runs."""
    with sqlite3.connect(f"file:{output / 'mlflow.db'}?mode=ro", uri=True) as connection:
        query = "select experiment_id from experiments where name = ?"
        (experiment,) = connection.execute(query, (EXPERIMENT,)).fetchone()
    return f"http://127.0.0.1:{port}/#/experiments/{experiment}/runs?compareRunsMode=CHART"


def serve(output: Path, port: int) -> int:
    """Print the address and serve it until Ctrl-C."""
    try:
        print(f"open {address(output, port)}\n(up in about 15 s; Ctrl-C ends it)", flush=True)
    except (sqlite3.Error, TypeError):
        print(f"error: no runs recorded under {output.resolve()} yet; `make run SCENE=carnation` makes one")
        return 1
    options = ["--backend-store-uri", database(output), "--host", "127.0.0.1", "--port", str(port)]
    try:
        return subprocess.run([sys.executable, "-m", "mlflow", "ui", *options]).returncode
    except KeyboardInterrupt:
        return 0


def _name(text: str) -> str:
    """MLflow takes letters, digits, _ - . / and spaces in names."""
    return re.sub(r"[^\w\-. /]", "_", text)


if __name__ == "__main__":
    sys.exit(serve(Path(sys.argv[1] if len(sys.argv) > 1 else "."), int(os.environ.get("PORT", "5000"))))
