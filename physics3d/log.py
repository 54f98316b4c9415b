"""What a computation tells the world while it runs: lines, curves, previews and progress, all kept in one folder.

A stage receives a Log whose folder is its own artifact folder; `metrics.jsonl` and `previews/` are later replayed into
MLflow by the pipeline. `Log(None)` keeps nothing and prints nothing, for tests and notebooks.
"""

import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

METRICS, PREVIEWS, LINES = "metrics.jsonl", "previews", "log.txt"
CHECKPOINT = ".checkpoint"  # while it lasts (`checkpoint.py`)
LINES_EVERY = 15.0  # between two lines of progress where there is no screen [s]


class Log:
    """Lines, curves, previews and progress of one computation, kept in `folder`, unless that is None.

    `said` are the lines that the person watching has read, of other computations too: they are kept, not printed again.
    """

    def __init__(self, folder: Path | None, *, name: str = "", quiet: bool = False, said: set[str] | None = None):
        self.folder = folder
        self.name = name
        self.quiet = quiet or folder is None
        self.said = set() if said is None else said
        self.book: Any = None  # of its journal (`journal.py`), once that is opened
        self.started = time.monotonic()

    def hushed(self) -> "Log":
        """One that tells nothing, of the same computation: what is noted goes into the same journal."""
        quiet = Log(None)
        quiet.book = self.book
        return quiet

    def info(self, text: str) -> None:
        """One line for the person watching; kept in log.txt."""
        if not self.quiet and text not in self.said:
            self.said.add(text)
            print(f"{self.name:>16} | {text}", flush=True)
        if self.folder is not None:
            with self.path(LINES).open("a") as lines:
                lines.write(f"{time.monotonic() - self.started:9.2f} s  {text}\n")

    def warn(self, text: str) -> None:
        self.info(f"warning: {text}")

    def metric(self, name: str, value: float, step: int | None = None) -> None:
        """A number of the run (step None) or a point of a curve."""
        if self.folder is not None:
            with self.path(METRICS).open("a") as lines:
                lines.write(json.dumps({"name": name, "value": float(value), "step": step}) + "\n")

    def image(self, name: str, image: Any, step: int | None = None) -> None:
        """Keep a preview: a matplotlib figure, or an array [h, w, 3] or [h, w], uint8 or float in 0..1."""
        if self.folder is None:
            return
        target = self.path(f"{PREVIEWS}/{name}{'' if step is None else f'_{step:05d}'}.png")
        if hasattr(image, "savefig"):
            image.savefig(target, dpi=110, bbox_inches="tight")
            return
        from PIL import Image

        array = np.asarray(image.detach().cpu() if hasattr(image, "detach") else image)
        if array.dtype != np.uint8:
            array = (np.clip(array, 0, 1) * 255 + 0.5).astype(np.uint8)
        Image.fromarray(array).save(target)

    def path(self, name: str) -> Path:
        """A file of the artifact folder, its parents made. Raises ValueError if this log keeps nothing."""
        if self.folder is None:
            raise ValueError("this Log has no folder to keep files in")
        target = self.folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def progress(self, items: Iterable | None, description: str, total: int | None = None, done: int = 0) -> Any:
        """`items` behind a bar with an estimate; call `.set_postfix(loss=...)` on what is returned. None for items:
        call `.update()`. `done`: how many of the `total` came before these, in a run that was stopped."""
        from tqdm import tqdm

        screen = sys.stderr.isatty()
        return tqdm(
            items,
            desc=f"{self.name:>16} | {description}",
            total=total,
            initial=done,
            disable=self.quiet,
            file=sys.stderr if screen else _Lines(),
            bar_format=None if screen else "{desc}: {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]",
            leave=False,
            dynamic_ncols=screen,
        )


class _Lines:
    """Where a bar goes if nobody watches a screen: a line every `LINES_EVERY` seconds."""

    def __init__(self):
        self.last = time.monotonic()

    def write(self, text: str) -> None:
        line = text.strip("\r\n").rstrip()
        if line and time.monotonic() - self.last >= LINES_EVERY:
            self.last = time.monotonic()
            print(line, file=sys.stderr, flush=True)

    def flush(self) -> None:
        pass
