"""A checkpoint: all that decides how a long computation goes on, kept while it lasts beside what its log keeps.

A loop saves its state after every step, which is written every few seconds, and loads it before its first one: killed
and called again, it goes on from there and ends with the same numbers, bit for bit. The folder of its log belongs to
one fingerprint and to one process at a time (`pipeline/stage.py`), which removes the checkpoint when the result is
filed. Curves of the log come back as they were at the checkpoint. Nothing is pickled: tensors are those of safetensors,
behind a sha256 of the file; one that is damaged counts as none. (`mpm/checkpoints.py` are others, of the adjoint.)
"""

import hashlib
import json
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from physics3d.artifact import ArtifactError, decode, encode
from physics3d.log import CHECKPOINT, METRICS, Log

SHORTEST, LONGEST = 2.0, 25.0  # between two that are written [s]
SHARE = 0.02  # of the time may go to writing them, unless they get rarer than LONGEST
ALIVE = 1.0  # how often it is marked that the computation still runs [s]
DIGEST = hashlib.sha256().digest_size


class Checkpoint:
    """That of the computation which `log` tells of; without a folder nothing is kept."""

    def __init__(self, log: Log):
        self.log = log
        self.file = None if log.folder is None else log.folder / CHECKPOINT
        self.written = self.marked = time.monotonic()
        self.wait = min(SHORTEST, LONGEST)
        self.failed = False

    def load(self, *, curves: bool = True) -> Any:
        """The state that was saved last, its tensors on the CPU, and with it the curves; None if there is none.

        `curves` are left out by whoever logs all of them again."""
        if self.file is None or not self.file.is_file():
            return None
        try:
            kept = _unpacked(self.file.read_bytes())
            lost = self.file.stat().st_mtime - kept["time"]
        except (OSError, ValueError) as error:
            self.log.warn(f"what an earlier run left half-done cannot be used ({error}); beginning anew")
            self.file.unlink(missing_ok=True)
            return None
        if curves:
            self.log.path(METRICS).write_text(kept["curves"])
        self.log.started = time.monotonic() - kept["seconds"]
        self.log.info(f"resuming {kept['where']}, {max(lost, 0):.0f} s before it was last seen at work")
        return kept["state"]

    def save(self, state: Any, where: str) -> None:
        """Write it as a whole or not at all, if it is time to. `state` is made of numbers, text, None, tensors, arrays,
        artifacts, and lists, tuples and tables of these; `where`, e.g. "at step 3 of 9", is said at `load`."""
        now = time.monotonic()
        if self.file is None:
            return
        if now - self.written < self.wait:
            if now - self.marked > ALIVE:
                self.marked = now
                with suppress(OSError):
                    os.utime(self.file)
            return
        unfinished = self.file.with_name(f"{CHECKPOINT}.unfinished")
        try:
            metrics = self.log.path(METRICS)
            curves = metrics.read_text() if metrics.is_file() else ""
            seconds = now - self.log.started
            data = _packed(dict(state=state, where=where, curves=curves, seconds=seconds, time=time.time()))
            for path in self.file.parent.rglob("*.png"):  # previews, which are not made again
                _flush(path)
            with unfinished.open("wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            unfinished.replace(self.file)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)
            if not self.failed:
                self.failed = True
                with suppress(OSError):
                    self.log.warn(f"no checkpoint could be written, and a stop would lose more ({error})")
        self.written = time.monotonic()
        self.wait = min(LONGEST, max(SHORTEST, (self.written - now) / SHARE))


def _packed(value: Any) -> bytes:
    tree, tensors = encode(value)
    tensors["tree"] = torch.frombuffer(bytearray(json.dumps(tree).encode()), dtype=torch.uint8)
    data = save(tensors)
    return hashlib.sha256(data).digest() + data


def _unpacked(data: bytes) -> Any:
    """Raises ValueError if that is not what `_packed` made."""
    if hashlib.sha256(data[DIGEST:]).digest() != data[:DIGEST]:
        raise ValueError("the checkpoint is damaged")
    try:
        # copies, which lie in memory as torch lays tensors out: some libraries round by the alignment
        tensors = {name: tensor.clone() for name, tensor in load(data[DIGEST:]).items()}
        return decode(json.loads(bytes(tensors.pop("tree").numpy())), tensors)
    except (KeyError, SafetensorError, ArtifactError) as error:
        raise ValueError(f"the checkpoint is none of ours: {error}") from error


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
