"""What a stage tells while it runs, sent to its run in MLflow every few seconds: growing curves, previews as they come.

Points are lines of metrics.jsonl, sent once each, however often a stage that goes on from a checkpoint writes them. A
preview is sent when it has not changed for a second, so that none is read half-written. Whatever fails in between is
tried again at the end (`tracking.py`), where the rest is sent.
"""

import json
import re
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

EVERY = 5.0  # between two looks [s]
STILL = 1.0  # for which a preview is left alone after it was written [s]
BATCH = 1000  # metrics per request that MLflow takes
NUMBERED = re.compile(r"(.+)_(\d{5})")  # a preview of a step


class Live:
    """From a stage's folder to a run; `client` is MLflow's."""

    def __init__(self, client: Any, run: str):
        self.client, self.run = client, run
        self.lines: Counter[str] = Counter()  # that were sent
        self.previews: set[str] = set()
        self.ended = Event()
        self.thread: Thread | None = None

    def follow(self, folder: Path) -> None:
        """Look into a folder, which need not be there yet, until `end`."""

        def look() -> None:
            while not self.ended.wait(EVERY):
                with suppress(Exception):
                    self.send(folder, before=time.time() - STILL)

        self.thread = Thread(target=look, daemon=True, name=f"live {folder.name}")
        self.thread.start()

    def end(self) -> None:
        self.ended.set()
        if self.thread is not None:
            self.thread.join()

    def send(self, folder: Path, before: float | None = None) -> None:
        """What is new; of previews only those last written `before`."""
        from mlflow.entities import Metric

        file = folder / "metrics.jsonl"
        whole = file.read_text().rpartition("\n")[0].splitlines() if file.is_file() else []
        fresh = list((Counter(whole) - self.lines).elements())
        now = int(time.time() * 1000)
        points = map(json.loads, fresh)
        metrics = [Metric(metric_name(p["name"]), p["value"], now, p["step"] or 0) for p in points]
        for i in range(0, len(metrics), BATCH):
            self.client.log_batch(self.run, metrics=metrics[i : i + BATCH])
            self.lines.update(fresh[i : i + BATCH])
        for path in sorted((folder / "previews").glob("*.png")):
            if path.name not in self.previews and (before is None or path.stat().st_mtime < before):
                self._preview(path)
                self.previews.add(path.name)

    def _preview(self, path: Path) -> None:
        """Numbered previews become one picture with a slider over steps, the others plain files."""
        numbered = NUMBERED.fullmatch(path.stem)
        if not numbered:
            self.client.log_artifact(self.run, str(path), "previews")
            return
        from PIL import Image

        self.client.log_image(self.run, Image.open(path), key=numbered[1], step=int(numbered[2]))


def metric_name(text: str) -> str:
    """MLflow takes letters, digits, _ - . / and spaces in names."""
    return re.sub(r"[^\w\-. /]", "_", text)
