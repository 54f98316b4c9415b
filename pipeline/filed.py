"""What runs of a scene have filed, for the commands that show it or take it elsewhere: nothing is computed here.

The words are those of `make run`, so that what is found is what that command made: of the same scene, profile, method
and settings, and of the code as it is now.
"""

import errno
import os
import shlex
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.flow import Plan, first, plan
from pipeline.hired import end_within
from pipeline.settings import SettingsError, compose
from pipeline.stage import StageError, Step, damage
from pipeline.words import literal_paths

USUAL = {"scene": "carnation", "profile": "default", "method": "physics3d", "data": ""}  # in the Makefile


def filed(words: list[str], *needed: str) -> tuple[dict[str, Any], Plan, dict[str, Step]]:
    """Configuration, plan, and steps by name, of which those `needed`, or all, are whole.

    Raises SettingsError for words that mean nothing, StageError naming the command that computes what is missing.
    """
    config, _ = compose(literal_paths(words))
    shelf = Path(config["output"]).expanduser().resolve() / "artifacts"
    capture = first(config, shelf)
    whole = Plan([capture]) if damage(capture) else plan(config, capture)
    steps = {step.name: step for step in whole.steps}
    missing = [name for name, step in steps.items() if (not needed or name in needed) and damage(step)]
    if missing:
        raise StageError(f"not computed yet with these settings and this code: {', '.join(missing)}; {command(words)}")
    return config, whole, steps


def command(words: list[str]) -> str:
    """The `make run` of these words."""
    values, rest = dict(USUAL), []
    for word in words:
        name, _, value = word.partition("=")
        if name in values:
            values[name] = value
        else:
            rest.append(shlex.quote(word))
    said = [f"{name.upper()}={shlex.quote(v)}" for name, v in values.items() if name == "scene" or v != USUAL[name]]
    return " ".join(["make run", *said, *([f"ARGS={shlex.quote(' '.join(rest))}"] if rest else [])])


def one_line(run: Callable[[], None], error: Callable[[str], None], left: str = "nothing was left") -> int:
    """Exit code of a command: 0 done, 1 it could not be, 2 the words mean nothing, 130 Ctrl-C or SIGTERM, of which
    `left` says what there is then; errors in one line."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        run()
    except SettingsError as wrong:
        error(f"error: {wrong}")
        return 2
    except (StageError, ValueError, RuntimeError, OSError) as wrong:
        full = "; free some space, or set OUT or TMPDIR to another disk" * _is_full(wrong)
        error(f"error: {' '.join(str(wrong).split())}{full}")
        return 1
    except KeyboardInterrupt:
        error(f"\ninterrupted; {left}")
        end_within(130)
        return 130
    return 0


def vacant(target: Path) -> None:
    """Raises FileExistsError if something is there already."""
    if os.path.lexists(target):
        raise FileExistsError(f"{target} is there already; remove it, or say OUT=<another place>")


@contextmanager
def beside(target: Path, size: int = 0, over: bool = False) -> Iterator[Path]:
    """A hidden path beside `target` to write a file or a folder at; it gets its name when all of it is there.

    `size` [byte] of what will be written; `over`: a file that is there is replaced. Raises FileExistsError if `target`
    is there already, OSError if the disk has not as much room; whatever goes wrong, nothing half-written is left.
    """
    if not over:
        vacant(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(target.parent).free
    if size > free:
        raise OSError(
            f"the disk is full: {megabytes(size)} are needed, {megabytes(free)} are free in {target.parent}; free some "
            "space, or say OUT=<a place on another disk>"
        )
    hidden = target.with_name(f".{target.stem}.unfinished{target.suffix}")
    _remove(hidden)  # of a command that was killed
    try:
        yield hidden
        hidden.rename(target)
    finally:
        _remove(hidden)


def _is_full(error: Exception) -> bool:
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def megabytes(size: int) -> str:
    return f"{size / 1e6:.3g} MB" if size < 1e9 else f"{size / 1e9:.3g} GB"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
