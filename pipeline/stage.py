"""A step of the pipeline: one stage with its configuration and its inputs, reused by fingerprint or computed and filed.

The result is a folder artifacts/<stage>/<fingerprint>/ with the artifact, what the stage logged, and manifest.json
(size and sha256 of every file, configuration, time, memory, versions). It is written under a hidden name beside its
place, flushed to the disk and renamed: whatever kills the run, nothing half-done looks finished. A lock per artifact
(released by the system when its holder dies) makes a second run wait and then reuse; whoever holds the lock sweeps what
dead runs left behind, but for stages that keep checkpoints (`physics3d/checkpoint.py`): these go on from the last one.
"""

import difflib
import errno
import fcntl
import hashlib
import importlib
import json
import os
import platform
import resource
import shutil
import statistics
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

from pipeline.fingerprint import (
    LIBRARIES,
    code,
    file_digest,
    fingerprint,
    hashed,
    installed,
    libraries,
    made_of,
    recall,
    remember,
    targets,
)
from pipeline.hired import end_with_hirer

MANIFEST = "manifest.json"
SMALL = 1 << 20  # files up to this size are always checked by content, larger ones by size unless asked [byte]
PLAIN = "fields.json"  # what `peek` reads of an artifact, always checked by content


class StageError(Exception):
    """A stage failed; the text is one line, `folder` keeps the log and the traceback."""


class Unknown(Exception):
    """Which files a stage reads has not been asked yet, so nothing can have been filed."""


@dataclass(frozen=True, eq=False)
class Step:
    """One stage to run. `inputs` are steps, parts of steps, None, or dicts of steps, in the order of its `__call__`."""

    name: str  # of this step, e.g. simulate_initial
    stage: str  # folder under artifacts/, e.g. simulate
    config: dict[str, Any]
    inputs: tuple[Any, ...]
    shelf: Path  # the folder artifacts/
    fingerprint: str
    made_of: dict[str, Any] = field(default_factory=dict)  # what the fingerprint is the hash of
    taken: bool = False  # `use` says so: this result in place of the stage, which is not run

    @classmethod
    def of(
        cls, name: str, stage: str, config: dict[str, Any], inputs: tuple[Any, ...], shelf: Path, ask: bool = True
    ) -> "Step":
        """`ask` its sources which files they read, which imports them; else take what was remembered.

        Raises StageError if the configuration names data that does not exist, Unknown if nothing was remembered.
        """
        try:
            digests, keys = shelf / ".digests.json", [_key(i) for i in inputs]
            files = _reads(config, fingerprint(config, keys, digests), shelf / ".reads.json", name, ask)
            parts = made_of(config, keys, digests, files)
        except (ValueError, OSError) as error:
            raise StageError(f"{name}: {_one_line(error)}") from error
        return cls(name, stage, config, inputs, shelf, hashed(parts), parts)

    @classmethod
    def take(cls, name: str, stage: str, key: str, shelf: Path) -> "Step":
        """The filed result whose fingerprint begins with `key`, in place of a stage, whatever it was made of.

        Raises StageError if there is none, or more than one.
        """
        filed = {path.name for path in (shelf / stage).glob("[!.]*")}
        found = sorted(name for name in filed if name.startswith(key))
        if len(found) != 1:
            there = ", ".join(found or sorted(filed)) or "none"
            reason = f"{'fits several results' if found else 'is no result'} in {shelf / stage}"
            raise StageError(f"use.{name} is {key}, which {reason}; take one of: {there}; or use.{name}=null")
        return cls(name=name, stage=stage, config={}, inputs=(), shelf=shelf, fingerprint=found[0], taken=True)

    @property
    def folder(self) -> Path:
        return self.shelf / self.stage / self.fingerprint

    @property
    def unfinished(self) -> Path:
        """Where the artifact is written until it is whole."""
        return self.folder.with_name(f".{self.fingerprint}")

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


def run(step: Step, device: str, verify: bool = False, said: set[str] | None = None) -> Filed:
    """Reuse the step's artifact, or compute and file it; `said` as in Log. Raises StageError with one line naming the
    step."""
    reason = damage(step, verify)
    if reason and step.taken:
        raise spoilt(step, reason)
    if reason:
        with _lock(step, wait=True):  # another run may file it while this one waits
            reason = damage(step, verify)
            if reason:
                if os.path.lexists(step.folder):
                    _say(step, f"the stored result is damaged ({reason}); computing it again")
                _sweep(step)
                return Filed(step, False, _compute(step, device, verify, said))
    return Filed(step, True, manifest(step))


def damage(step: Step, verify: bool = False) -> str | None:
    """Why the step's artifact cannot be used: absent, incomplete, altered, or not ours. None if it is whole."""
    try:
        told = manifest(step)
        if (told["stage"], told["fingerprint"]) != (step.stage, step.fingerprint):
            return f"it is {told['stage']} {told['fingerprint']}"
        for name, (size, digest) in told["files"].items():
            path = step.folder / name
            if path.is_symlink() or not path.is_file():
                return f"{name} is no file"
            if path.stat().st_size != size:
                return f"{name} has {path.stat().st_size} bytes, was filed with {size}"
            if (verify or size <= SMALL or name == PLAIN) and file_digest(path) != digest:
                return f"{name} is not what was filed"
    except (OSError, ValueError) as error:
        return str(error) or "unreadable"
    return None


def half_done(step: Step) -> bool:
    """Whether a run would go on from a checkpoint of this step."""
    return _left(step.unfinished)


def spoilt(step: Step, reason: str) -> StageError:
    """What to say of a taken result that cannot be used."""
    key = f"use.{step.name}"
    return StageError(f"{key} is {step.fingerprint}, which is damaged ({reason}); take another result, or {key}=null")


def manifest(step: Step) -> dict[str, Any]:
    """Raises ValueError if there is none, or none that `run` could have written."""
    return read_manifest(step.folder)


def read_manifest(folder: Path) -> dict[str, Any]:
    """As `manifest`, of any folder on the shelf."""
    path = folder / MANIFEST
    if folder.is_symlink() or path.is_symlink() or not path.is_file():
        raise ValueError(f"no {MANIFEST}" if folder.is_dir() and not folder.is_symlink() else "it is no folder")
    try:
        told = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{MANIFEST} is not JSON") from error
    match told:
        case {
            "stage": str(),
            "fingerprint": str(),
            "seconds": float() | int(),
            "peak_rss_bytes": int(),
            "files": dict(files),
        } if PLAIN in files and all(_is_entry(name, entry) for name, entry in files.items()):
            return told
    raise ValueError(f"{MANIFEST} is not one of ours")


def _is_entry(name: str, entry: Any) -> bool:
    """Whether this is a file inside of its folder, with its size and digest."""
    match entry:
        case [int(size), str()] if size >= 0:
            parts = Path(name).parts
            return bool(parts) and not Path(name).is_absolute() and ".." not in parts and "\0" not in name
    return False


def usual_seconds(shelf: Path, stage: str) -> float | None:
    """Median time of the results of a stage that are filed on this shelf [s]; None if there is none."""
    times = []
    for path in (shelf / stage).glob(f"*/{MANIFEST}"):
        with suppress(OSError, ValueError):
            times.append(read_manifest(path.parent)["seconds"])
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
    except ArtifactError as error:
        if source.taken:
            raise spoilt(source, str(error)) from error
        with _lock(source, wait=True):
            _say(source, f"the stored result is damaged ({error}); computing it again")
            _remove(source.folder)
        run(source, device, verify)
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


def as_task(step: Step, device: str, verify: bool, said: set[str] | None = None) -> Any:
    """The step as a Prefect task; call it with the results of the steps before it, so that Prefect draws the graph.

    It may run in another process, or on another machine, with the same code and the same shelf. `device` is `auto`
    where that machine is to choose; `said` are the lines that the steps of a run share (`Log`), in one process.
    """
    from prefect import task
    from prefect.cache_policies import NO_CACHE

    @task(name=step.name, cache_policy=NO_CACHE, persist_result=False)
    def stage(after: list[Filed]) -> Filed:
        end_with_hirer()
        if reason := strange(step):
            raise StageError(f"{step.name}: {reason}")
        return run(step, here(device), verify, said)

    return stage


def here(device: str) -> str:
    """auto -> cuda if this machine has one, else cpu."""
    import torch

    return ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device


def strange(step: Step) -> str | None:
    """Why this machine would not compute what the step's fingerprint says, with the remedy; None if it would."""
    if not step.shelf.is_dir():
        return f"{platform.node()} sees no folder {step.shelf}; share it under that path, or output=<a shared folder>"
    names = tuple(sorted(targets(step.config)))
    for kind, mine in (("code", code(names)), ("libraries", libraries(names))):
        asked = mine if step.taken else step.made_of[kind]
        if other := sorted(k for k in mine.keys() | asked.keys() if mine.get(k) != asked.get(k)):
            return f"{platform.node()} has other {kind} ({other[0]}); install there what is installed here"
    return None


def _compute(step: Step, device: str, verify: bool, said: set[str] | None) -> dict[str, Any]:
    from physics3d.log import CHECKPOINT, LINES, PREVIEWS, Log

    temporary = step.unfinished
    try:
        temporary.mkdir(parents=True, exist_ok=True)
        for path in temporary.iterdir():  # a checkpoint has the curves; what else was left is written anew
            if path.name not in (CHECKPOINT, LINES, PREVIEWS):
                _remove(path)
        log = Log(temporary, name=step.name, said=said)
        stage = build(step.config, device, step.name)
        inputs = [load(source, device, verify) for source in step.inputs]
        _reset_peak()
        log.started = time.monotonic()
        artifact = stage(*inputs, log=log)
        seconds = time.monotonic() - log.started  # with those before a checkpoint
        artifact.save(temporary)
        manifest = _describe(step, device) | {"seconds": seconds, "peak_rss_bytes": _peak(), "files": _list(temporary)}
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1, default=str))
        _flush(temporary)
        _remove(step.folder)  # damaged
        for path in temporary.glob(f"{CHECKPOINT}*"):
            path.unlink()
        temporary.rename(step.folder)
        _flush_entry(step.folder.parent)
        return manifest
    except StageError:
        _drop(temporary)
        raise
    except Exception as error:
        kept = _keep(step, temporary)
        raise StageError(f"{step.name}: {_one_line(error)}{f' (traceback: {kept})' if kept else ''}") from error
    except BaseException:  # Ctrl-C
        _drop(temporary)
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
        _drop(temporary)
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
    """Remove unfinished folders of this stage whose writers are gone, but for those with a checkpoint to go on from."""
    for folder in (step.shelf / step.stage).glob(".*"):
        key = folder.name[1:]
        if _left(folder):
            continue
        if key == step.fingerprint:  # we hold its lock
            _remove(folder)
            continue
        other = Step(step.name, step.stage, {}, (), step.shelf, key)
        with _lock(other, wait=False) as mine:
            if mine:
                with suppress(OSError):
                    _remove(folder)


def _left(folder: Path) -> bool:
    """Whether a stage that was stopped left a checkpoint in its unfinished folder."""
    from physics3d.log import CHECKPOINT

    return not folder.is_symlink() and (folder / CHECKPOINT).is_file()


def _drop(temporary: Path) -> None:
    """Remove what a stage has written so far, unless it can go on from there."""
    if not _left(temporary):
        shutil.rmtree(temporary, ignore_errors=True)


def _remove(path: Path) -> None:
    """Remove a folder, or the file or link in its place."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _reads(config: Any, key: str, memory: Path, name: str, ask: bool) -> list[tuple[str, Path]]:
    """What the objects of a configuration say they read: (name from the data's folder on, file).

    Asking imports them, so the answer is remembered under the configuration and its `key`, which changes with the
    content of what it names. Raises ValueError from the sources, Unknown if they may not be asked.
    """
    essence = json.dumps([key, config, os.getcwd()], sort_keys=True, default=str)
    question = hashlib.sha256(essence.encode()).hexdigest()[:16]
    known = recall(memory)
    if ask:
        answer = [[label, str(path)] for label, path in _told(build(config, "cpu", name))]
        if known.get(question) != answer:
            remember(memory, known | {question: answer})
        known[question] = answer
    match known.get(question):
        case [*pairs] if all(isinstance(p, list) and [*map(type, p)] == [str, str] for p in pairs):
            return [(label, Path(path)) for label, path in pairs]
    raise Unknown


def _told(made: Any) -> Iterator[tuple[str, Path]]:
    """The answers of `files()`, for an object and everything in its fields."""
    if isinstance(made, dict | tuple):
        for value in made.values() if isinstance(made, dict) else made:
            yield from _told(value)
    elif is_dataclass(made):
        if hasattr(made, "files"):
            place = getattr(made, "path", None)
            base = Path(place).absolute() if isinstance(place, str) else None
            folder = base if base is None or base.is_dir() else base.parent
            for file in map(Path, made.files()):
                yield os.path.relpath(file.absolute(), folder) if folder else file.name, file.absolute()
        for part in fields(made):
            yield from _told(getattr(made, part.name))


def _key(source: Any) -> Any:
    if source is None:
        return "none"
    if isinstance(source, dict):
        return {name: _key(step) for name, step in source.items()}
    return f"{source.step.fingerprint}.{source.field}" if isinstance(source, Part) else source.fingerprint


def _describe(step: Step, device: str) -> dict[str, Any]:
    versions = {name: version for name in LIBRARIES if (version := installed(name))}
    return {
        "stage": step.stage,
        "fingerprint": step.fingerprint,
        "config": step.config,
        "made_of": step.made_of,
        "device": device,
        "versions": {"python": platform.python_version()} | versions,
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _list(folder: Path) -> dict[str, tuple[int, str]]:
    """Name -> size [byte] and sha256 of every file in a folder that is not hidden."""
    paths = sorted(p for p in folder.rglob("[!.]*") if p.is_file())
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
