"""Throw-away stages for the tests of the machinery: small artifacts, and switches to be slow, to fail, or to fill the disk."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import torch

from physics3d.log import Log
from physics3d.video import Video


def clip(value: float) -> Video:
    return Video(frames=(torch.full((2, 4, 4, 3), int(value), dtype=torch.uint8),), fps=1.0, names=("toy",))


@dataclass(frozen=True, kw_only=True)
class Add:
    """Adds `amount` to the pixels of its inputs. Every run appends its name to the file `diary`."""

    amount: int
    diary: str
    name: str
    seconds: float = 0.0
    error: str = ""
    size: int = 0  # of an extra file [byte]
    device: str = "cpu"
    table: dict[str, float] = field(default_factory=dict)

    def __call__(self, *inputs: Video, log: Log) -> Video:
        with Path(self.diary).open("a") as lines:
            lines.write(self.name + "\n")
        log.info(f"adding {self.amount}")
        for step in range(3):
            log.metric("curve", self.amount / (step + 1), step)
            log.image("frame", torch.full((8, 8, 3), 0.1 * step), step)
        if self.size:
            log.path("large.bin").write_bytes(bytes(self.size))
        time.sleep(self.seconds)
        if self.error:
            raise ValueError(self.error)
        return clip(self.amount + sum(int(v.frames[0][0, 0, 0, 0]) for v in inputs))
