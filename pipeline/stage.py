"""A step of the pipeline: one stage with its configuration and its inputs, reused by fingerprint or computed and filed.

The result is a folder artifacts/<stage>/<fingerprint>/ with the artifact, what the stage logged, and manifest.json
(size and sha256 of every file, configuration, time, memory, versions). It is written under a hidden name beside its
place, flushed to the disk and renamed: whatever kills the run, nothing half-done looks finished. A lock per artifact
(released by the system when its holder dies) makes a second run wait and then reuse; whoever holds the lock sweeps what
dead runs left behind.
"""

import difflib
import errno
import fcntl
import importlib
import importlib.metadata
import json
import os
import platform
import resource
import shutil
import statistics
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from pipeline.fingerprint import code_digest, file_digest, fingerprint, targets

MANIFEST = "manifest.json"
SMALL = 1 << 20  # files up to this size are always checked by content, larger ones by size unless asked [byte]
PACKAGES = ("torch", "warp-lang", "numpy", "scipy", "open3d-cpu", "opencv-python-headless")


class StageError(Exception):
    """A stage failed; the text is one line, `folder` keeps the log and the traceback."""


@dataclass(frozen=True, eq=False)
class Step:
    """One stage to run. `inputs` are steps, parts of steps, None, or dicts of steps, in the order of its `__call__`."""

    name: str  # of this step, e.g. simulate_initial
    stage: str  # folder under artifacts/, e.g. simulate
    config: dict[str, Any]
    inputs: tuple[Any, ...]
    shelf: Path  # the folder artifacts/
    fingerprint: str

    @classmethod
    def of(cls, name: str, stage: str, config: dict[str, Any], inputs: tuple[Any, ...], shelf: Path) -> "Step":
        """Raises ValueError if the configuration names a path that does not exist."""
        try:
            key = fingerprint(config, [_key(i) for i in inputs], shelf / ".digests.json")
        except ValueError as error:
            raise StageError(f"{name}: {error}") from error
        return cls(name=name, stage=stage, config=config, inputs=inputs, shelf=shelf, fingerprint=key)

    @property
    def folder(self) -> Path:
        return self.shelf / self.stage / self.fingerprint

    def part(self, field: str) -> "Part":
        return Part(self, field)


@dataclass(frozen=True, eq=False)
class Part:
    """One field of a step's artifact, as the input of another step."""

    step: Step
    field: str


@dataclass(frozen=True, eq=False)
class Filed:
    """A step whose artifact lies in `step.folder`."""

    step: Step
    hit: bool  # found, not computed
    manifest: dict[str, Any]


def run(step: Step, device: str, verify: bool = False) -> Filed:
    """Reuse the step's artifact, or compute and file it. Raises StageError with one line naming the step."""
    if damage(step, verify):
        with _lock(step, wait=True):  # another run may file it while this one waits
            reason = damage(step, verify)
            if reason:
                if step.folder.exists():
                    _say(step, f"the stored result is damaged ({reason}); computing it again")
                _sweep(step)
                return Filed(step, False, _compute(step, device, verify))
    return Filed(step, True, manifest(step))


def damage(step: Step, verify: bool = False) -> str | None:
    """Why the step's artifact cannot be used: absent, incomplete or altered. None if it is whole."""
    try:
        for name, (size, digest) in manifest(step)["files"].items():
            path = step.folder / name
            if path.stat().st_size != size:
                return f"{name} has {path.stat().st_size} bytes, was filed with {size}"
            if (verify or size <= SMALL) and file_digest(path) != digest:
                return f"{name} is not what was filed"
    except (OSError, ValueError, KeyError) as error:
        return str(error) or "unreadable"
    return None


def manifest(step: Step) -> dict[str, Any]:
    return json.loads((step.folder / MANIFEST).read_text())


def usual_seconds(shelf: Path, stage: str) -> float | None:
    """Median time of the results of a stage that are filed on this shelf [s]; None if there is none."""
    times = []
    for path in (shelf / stage).glob(f"*/{MANIFEST}"):
        with suppress(OSError, ValueError, KeyError):
            times.append(json.loads(path.read_text())["seconds"])
    return statistics.median(times) if times else None


def load(source: Any, device: str, verify: bool = False) -> Any:
    """The artifact of an input; a step whose artifact turns out to be unreadable is computed again."""
    if source is None:
        return None
    if isinstance(source, dict):
        return {name: load(step, device, verify) for name, step in source.items()}
    if isinstance(source, Part):
        return getattr(load(source.step, device, verify), source.field)
    from physics3d.artifact import AbstractArtifact, ArtifactError

    run(source, device, verify)
    try:
        return AbstractArtifact.load(source.folder)
    except ArtifactError:
        run(source, device, verify=True)  # the sizes are right, so look at the contents
        return AbstractArtifact.load(source.folder)


def peek(folder: Path, arrays: bool = False) -> Any:
    """What `AbstractArtifact.save` wrote, as plain dicts and lists, without importing torch.

    Tensors become numpy arrays, or None unless `arrays`.
    """
    stored: dict[str, Any] = {}
    if arrays:
        from safetensors.numpy import load_file

        stored = load_file(folder / "arrays.safetensors")

    def plain(tree: Any) -> Any:
        if isinstance(tree, list):
            return [plain(v) for v in tree]
        if not isinstance(tree, dict):
            return tree
        kind = next(k for k in tree if k != "fields")
        if kind in ("__tensor__", "__array__"):
            return stored.get(tree[kind])
        if kind == "__tuple__":
            return [plain(v) for v in tree[kind]]
        return {k: plain(v) for k, v in tree["fields" if kind == "__class__" else kind].items()}

    return plain(json.loads((folder / "fields.json").read_text()))


def build(config: Any, device: str, where: str = "") -> Any:
    """Configuration -> objects: a mapping with `_target_` becomes that class, a list a tuple, `device: auto` `device`.

    Raises ValueError naming the entry, with the close match if a name is misspelt.
    """
    if isinstance(config, list | tuple):
        return tuple(build(v, device, f"{where}.{i}") for i, v in enumerate(config))
    if not isinstance(config, dict):
        return config
    values = {k: build(v, device, f"{where}.{k}".lstrip(".")) for k, v in config.items() if k != "_target_"}
    if values.get("device") == "auto":
        values["device"] = device
    if "_target_" not in config:
        return values
    module, _, name = config["_target_"].rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{where}._target_ is {config['_target_']}: {error}") from error
    if is_dataclass(kind):
        known = [f.name for f in fields(kind) if f.init]
        for key in values.keys() - set(known):
            close = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(known)}"
            raise ValueError(f"{where}.{key}: {name} has no such field; {hint}")
    try:
        made = kind(**values)
        if hasattr(made, "check"):
            made.check()
        return made
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def as_task(step: Step, device: str, verify: bool) -> Callable[..., Filed]:
    """The step as a Prefect task; call it with the results of the steps before it, so that Prefect draws the graph."""
    from prefect import task
    from prefect.cache_policies import NO_CACHE

    @task(name=step.name, cache_policy=NO_CACHE, persist_result=False)
    def stage(after: list[Filed]) -> Filed:
        return run(step, device, verify)

    return stage


def _compute(step: Step, device: str, verify: bool) -> dict[str, Any]:
    from physics3d.log import Log

    temporary = step.folder.with_name(f".{step.fingerprint}")
    try:
        temporary.mkdir(parents=True)
        log = Log(temporary, name=step.name)
        stage = build(step.config, device, step.name)
        inputs = [load(source, device, verify) for source in step.inputs]
        _reset_peak()
        started = time.monotonic()
        artifact = stage(*inputs, log=log)
        seconds = time.monotonic() - started
        artifact.save(temporary)
        manifest = _describe(step, device) | {"seconds": seconds, "peak_rss_bytes": _peak(), "files": _list(temporary)}
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1, default=str))
        _flush(temporary)
        if step.folder.exists():  # damaged
            shutil.rmtree(step.folder)
        temporary.rename(step.folder)
        _flush_entry(step.folder.parent)
        return manifest
    except StageError:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    except Exception as error:
        kept = _keep(step, temporary)
        raise StageError(f"{step.name}: {_one_line(error)}{f' (traceback: {kept})' if kept else ''}") from error
    except BaseException:  # Ctrl-C
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _say(step: Step, text: str) -> None:
    print(f"{step.name:>16} | {text}", flush=True)


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    if full or "No space left" in text or "File too large" in text:
        return f"the disk is full ({text}); free some space or write elsewhere with output=<folder>"
    return text if isinstance(error, ValueError | RuntimeError | OSError) else f"{type(error).__name__}: {text}"


def _keep(step: Step, temporary: Path) -> Path | None:
    """Keep the log and the traceback of a failure, drop the rest."""
    kept = step.shelf / ".failed" / f"{step.stage}-{step.fingerprint}.txt"
    try:
        lines = temporary / "log.txt"
        text = (lines.read_text() if lines.is_file() else "") + traceback.format_exc()
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(text)
    except OSError:
        return None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return kept


@contextmanager
def _lock(step: Step, wait: bool) -> Iterator[bool]:
    """Hold the right to write this step's artifact; the system takes it back from a dead process.

    Yields False if not `wait` and another process holds it.
    """
    path = step.shelf / ".locks" / f"{step.stage}-{step.fingerprint}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = path.open("w")
    except OSError as error:
        raise StageError(f"{step.name}: {_one_line(error)}") from error
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                yield False
                return
            _say(step, "another run is computing this; waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield True


def _sweep(step: Step) -> None:
    """Remove unfinished folders of this stage whose writers are gone."""
    for folder in (step.shelf / step.stage).glob(".*"):
        key = folder.name[1:]
        if key == step.fingerprint:  # we hold its lock
            shutil.rmtree(folder)
            continue
        other = Step(step.name, step.stage, {}, (), step.shelf, key)
        with _lock(other, wait=False) as mine:
            if mine:
                shutil.rmtree(folder, ignore_errors=True)


def _key(source: Any) -> str:
    if source is None:
        return "none"
    if isinstance(source, dict):
        return json.dumps({name: _key(step) for name, step in source.items()}, sort_keys=True)
    return f"{source.step.fingerprint}.{source.field}" if isinstance(source, Part) else source.fingerprint


def _describe(step: Step, device: str) -> dict[str, Any]:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "stage": step.stage,
        "fingerprint": step.fingerprint,
        "code": code_digest(tuple(sorted(targets(step.config)))),
        "config": step.config,
        "inputs": [_key(i) for i in step.inputs],
        "device": device,
        "versions": versions,
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _list(folder: Path) -> dict[str, tuple[int, str]]:
    """Name -> size [byte] and sha256 of every file in a folder."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): (p.stat().st_size, file_digest(p)) for p in paths}


def _flush(folder: Path) -> None:
    """Have the system write the files to the disk before they get their final name."""
    for path in folder.rglob("*"):
        _flush_entry(path)
    _flush_entry(folder)


def _flush_entry(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _reset_peak() -> None:
    with suppress(OSError):  # Linux; elsewhere the peak is that of the whole process so far
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    """Largest resident memory since `_reset_peak` [byte]."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
