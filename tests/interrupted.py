"""A log whose owner loses patience: the bars of a computation end with Ctrl-C after so many items, of all together, or
at a line that begins with some words."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from physics3d.log import Log


class Interrupted(Log):
    def __init__(self, folder: Path, after: int | str):
        super().__init__(folder, quiet=True)
        self.after = after

    def info(self, text: str) -> None:
        super().info(text)
        if isinstance(self.after, str) and text.startswith(self.after):
            raise KeyboardInterrupt

    def progress(self, items: Iterable | None, description: str, total: int | None = None, done: int = 0) -> Any:
        return super().progress(self._until(items or ()), description, total, done)

    def _until(self, items: Iterable):
        for item in items:
            if self.after == 0:
                raise KeyboardInterrupt
            if isinstance(self.after, int):
                self.after -= 1
            yield item
