"""A journal of answers: how a computation that consists of few dear questions goes on where it was stopped.

What is asked is computed once and noted. Stopped and called again, the computation runs from its beginning and is told
what was noted, so that in moments it comes, by the same path, to where it was: nothing else of it needs to be kept, not
the state of an optimiser, not even of scipy's. Every answer stands behind a digest of its question; where another one
is asked than was noted, what follows is forgotten. Curves are logged again from the beginning.

Whoever answers may ask in turn, so that of a long answer little is lost as well. These answers, which may be large, are
kept until the one that they are for is known. An answer is handed out as it will be told after a stop, laid out in
memory alike: the order of an array's axes decides how its sums are rounded.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from physics3d.artifact import decode, encode
from physics3d.checkpoint import Checkpoint
from physics3d.log import Log
from physics3d.trajectory import NotMoved


@dataclass
class Book:
    """What is written in a journal."""

    checkpoint: Checkpoint
    # [digest of the question whose answer is sought, [digests of those asked for it, with answers]], outermost first
    levels: list[list[Any]]
    told: list[int] = field(default_factory=lambda: [0])  # how many were told or noted by now, of each level


class Journal:
    """That of the computation which `log` tells of: there is one, whoever opens it."""

    def __init__(self, log: Log):
        self.log = log
        if log.book is None:
            checkpoint = Checkpoint(log)
            log.book = Book(checkpoint=checkpoint, levels=checkpoint.load(curves=False) or [["", []]])
        self.book: Book = log.book

    def ask(self, *question: Any, answer: Callable[[], Any]) -> Any:
        """What `answer` returns, now or when it was noted: made of what a checkpoint may hold, on the CPU, never
        changed by whoever gets it. A `question` is text, numbers, tensors and arrays. NotMoved is an answer as well:
        it is noted, and raised each time."""
        levels, told, key = self.book.levels, self.book.told, _digest(question)
        depth = len(told) - 1
        noted, count = levels[depth][1], told[depth]
        if count < len(noted) and noted[count][0] == key:
            told[depth] += 1
            return _told(noted[count])
        if count < len(noted):
            self.log.warn(f"it takes another path than before it was stopped, from evaluation {count + 1} on")
            del noted[count:]
        if [level[0] for level in levels[depth + 1 : depth + 2]] != [key]:
            levels[depth + 1 :] = [[key, []]]
        told.append(0)
        try:
            entry = [key, decode(*encode(answer()))]
        except NotMoved as reason:  # whoever asks may go on without, and after a stop by the same path
            entry = [key, None, str(reason)]
        finally:
            told.pop()
        del levels[depth + 1 :]
        noted.append(entry)
        told[depth] += 1
        self.book.checkpoint.save(levels, f"after evaluation {'.'.join(map(str, told))}")
        return _told(entry)


def _told(entry: list[Any]) -> Any:
    """The answer of [digest, answer], or raise what [digest, None, reason] says."""
    if len(entry) == 3:
        raise NotMoved(entry[2])
    return entry[1]


def _digest(question: tuple[Any, ...]) -> str:
    essence = hashlib.sha256()
    for part in question:
        if isinstance(part, np.ndarray):
            part = torch.from_numpy(np.ascontiguousarray(part))
        if isinstance(part, torch.Tensor):
            part = (str(part.dtype), tuple(part.shape), part.detach().cpu().contiguous().numpy().tobytes())
        essence.update(repr(part).encode() + b"\n")
    return essence.hexdigest()[:16]
