"""What lies on the shelf: how large it is, what may go, and what must stay.

    python -m pipeline.shelf clean <paths ...>        make clean: shows sizes, then removes; pinned results stay
    python -m pipeline.shelf collect [folder]         make collect: removes the results that no run refers to
    python -m pipeline.shelf pin <stage/fingerprint>  make pin, make unpin: neither of the two removes a pinned result
    python -m pipeline.shelf unpin <stage/fingerprint>

MLflow is the record of runs: a result is referred to by the runs that computed or reused it, until they are deleted
there. So one deletes runs on MLflow's page, then collects. Whoever runs holds a lock on the shelf, shared with others
who run; collecting and cleaning need it for themselves. Only the standard library is used, so this works without .venv.
Exit codes: 0 done, 1 it cannot be done, 2 the command line is wrong, 130 Ctrl-C.
"""

import fcntl
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path

from pipeline.stage import StageError, read_manifest

USAGE = "python -m pipeline.shelf clean|collect|pin|unpin"
REFERENCES = """
    select artifact.value from runs join tags as artifact using (run_uuid) left join tags as link
        on link.run_uuid = runs.run_uuid and link.key = 'mlflow.parentRunId'
    where artifact.key = 'artifact' and runs.lifecycle_stage = 'active' and not exists
        (select 1 from runs as parent where parent.run_uuid = link.value and parent.lifecycle_stage = 'deleted')
"""


def main(words: list[str]) -> int:
    try:
        match words:
            case ["clean", *paths]:
                clean([Path(path) for path in paths], Path("artifacts"))
            case ["collect", *folder] if len(folder) < 2:
                collect(Path(*folder))
            case ["pin", result]:
                pin(Path("artifacts"), result)
            case ["unpin", result]:
                unpin(Path("artifacts"), result)
            case _:
                print(f"error: {USAGE}", file=sys.stderr)
                return 2
    except (StageError, OSError, sqlite3.Error) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from there", file=sys.stderr)
        return 130
    return 0


@contextmanager
def using(shelf: Path, alone: bool = False) -> Iterator[None]:
    """Hold the shelf, together with others who run, or `alone`. Raises StageError if that cannot be."""
    path = shelf / ".locks" / "shelf"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        opened = path.open("w")
    except OSError as error:
        reason = f"results cannot be kept in {shelf} ({error.strerror}: {error.filename})"
        raise StageError(f"{reason}; say output=<a folder that can be written>") from error
    with opened as handle:
        try:
            fcntl.flock(handle, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            who = "a run is under way" if alone else "results are being collected"
            raise StageError(f"{who} in {shelf}; wait for its end") from error
        yield


def clean(paths: list[Path], shelf: Path) -> None:
    """Say how large each of the paths is, then remove them, but for pinned results below `shelf`."""
    there = [path for path in paths if os.path.lexists(path)]
    if not there:
        print("nothing to remove")
        return
    with using(shelf, alone=True) if shelf.is_dir() else nullcontext():
        kept = [shelf / name for name in pinned(shelf)]
        total = 0
        for path in there:
            total += (size := _size(path) - sum(map(_size, (k for k in kept if path in k.parents))))
            print(f"{_words(size):>10}  {path}")
        for path in kept:
            print(f"{'stays':>10}  {path}, {_words(_size(path))}: pinned")
        for path in there:
            _remove(path, {*kept, shelf / ".pins"} if kept else set())
    print(f"{_words(total):>10}  removed")


def collect(output: Path) -> None:
    """Remove the results that no run in MLflow's record refers to, saying how large each is; pinned ones stay.

    Raises StageError without a record, or while somebody runs.
    """
    shelf, record = output / "artifacts", output / "mlflow.db"
    if not record.is_file():
        raise StageError(f"no record of runs in {record}, so nobody knows what is referred to; make clean removes all")
    with using(shelf, alone=True):
        keep = referred(record) | pinned(shelf)
        gone, total = 0, 0
        for path in sorted(shelf.glob("[!.]*/*")):  # also what a run left unfinished: nobody is at work
            if path.relative_to(shelf).as_posix() not in keep:
                size = _size(path)
                print(f"{_words(size):>10}  {path}")
                _remove(path, set())
                gone, total = gone + 1, total + size
    print(
        f"{_words(total):>10}  removed: {gone} results, whole or half-done, that no run refers to; {len(keep)} are kept"
    )


def referred(record: Path) -> set[str]:
    """stage/fingerprint of the results that runs refer to which are not deleted, neither they nor their parents."""
    with closing(sqlite3.connect(f"{record.resolve().as_uri()}?mode=ro", uri=True)) as opened:
        return {"/".join(Path(value).parts[-2:]) for (value,) in opened.execute(REFERENCES)}


def pin(shelf: Path, result: str) -> None:
    """Keep a result until it is unpinned. Raises StageError if there is none of that name."""
    folder = _one(shelf, result, {p.parent.relative_to(shelf).as_posix() for p in shelf.glob("[!.]*/*/manifest.json")})
    try:
        told = read_manifest(shelf / folder)
    except ValueError as error:
        raise StageError(f"RESULT={result} cannot be pinned: {error}; take one of another run") from error
    stage, fingerprint = told["stage"], told["fingerprint"]
    (shelf / ".pins").mkdir(exist_ok=True)
    (shelf / ".pins" / f"{stage}-{fingerprint}").touch()
    print(
        f"pinned    {shelf / folder}, {_words(_size(shelf / folder))}   (a run takes it with use.{stage}={fingerprint})"
    )


def unpin(shelf: Path, result: str) -> None:
    """Raises StageError if there is no pin of that name."""
    name = _one(shelf, result, pinned(shelf))
    (shelf / ".pins" / name.replace("/", "-")).unlink()
    print(f"unpinned  {shelf / name}")


def pinned(shelf: Path) -> set[str]:
    """stage/fingerprint of the results that are pinned."""
    return {path.name.replace("-", "/") for path in (shelf / ".pins").glob("*")}


def _one(shelf: Path, result: str, there: set[str]) -> str:
    """The one name that begins like `result`, which may be a path, too."""
    asked = "/".join(Path(result).parts[-2:])
    found = sorted(name for name in there if name.startswith(asked)) if asked else []
    if len(found) == 1:
        return found[0]
    reason = f"fits {len(found)} of" if found else "is none of"
    listed = ", ".join((found or sorted(there))[:12]) or "nothing"
    raise StageError(f"RESULT={result} {reason} those in {shelf}; take RESULT=<stage/fingerprint> of: {listed}")


def _size(path: Path) -> int:
    """Bytes that a file or everything below a folder takes; links are not followed."""
    if path.is_symlink() or not path.is_dir():
        return path.lstat().st_size
    return sum(Path(place, name).lstat().st_size for place, _, names in os.walk(path) for name in names)


def _words(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def _remove(path: Path, kept: set[Path]) -> None:
    """Remove a file, a link or a folder, but for the paths in `kept` and what leads to them."""
    if path in kept:
        return
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    elif any(path in k.parents for k in kept):
        for inside in path.iterdir():
            _remove(inside, kept)
    else:
        shutil.rmtree(path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
