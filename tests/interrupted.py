"""A log whose owner loses patience: the bars of a computation end with Ctrl-C after so many items, of all together."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from physics3d.log import Log


class Interrupted(Log):
    def __init__(self, folder: Path, after: int):
        super().__init__(folder, quiet=True)
        self.after = after

    def progress(self, items: Iterable | None, description: str, total: int | None = None, done: int = 0) -> Any:
        return super().progress(self._until(items or ()), description, total, done)

    def _until(self, items: Iterable):
        for item in items:
            if self.after == 0:
                raise KeyboardInterrupt
            self.after -= 1
            yield item
