"""Where commands read and write: REAL, PRED, DATA and OUT of the environment, looked at before anything is computed.

Values reach commands as they were typed, so a ~ at their beginning is that of no shell: it stands for the home folder.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.filed import vacant
from pipeline.settings import SettingsError

LONGEST = 200  # of a name [byte]: file systems allow 255, of which hidden names beside it need some


def place(environment: Mapping[str, str], name: str) -> Path | None:
    """The path that a variable holds; None where it is empty."""
    text = environment.get(name, "")
    return Path(os.path.expanduser(text)) if text else None


def new_place(environment: Mapping[str, str], ending: str = "") -> Path | None:
    """OUT, where nothing is yet: of a folder, or of a file whose name ends in `ending`; None where it is empty.

    Raises SettingsError for a name that ends otherwise, OSError for a place that is taken or cannot be written.
    """
    path = place(environment, "OUT")
    if path is None:
        return None
    if ending and path.suffix.lower() != ending:
        raise SettingsError(f"OUT={environment['OUT']} names no {ending} file; say OUT=<name>{ending}")
    vacant(path)
    _require_room(path, path.absolute().parents)
    return path


def folder_to_fill(environment: Mapping[str, str], usual: str | Path) -> Path:
    """OUT, else the usual place, for a folder that may be there already. Raises OSError where there can be none."""
    path = place(environment, "OUT") or Path(usual)
    _require_room(path, (path.absolute(), *path.absolute().parents))
    return path


def _require_room(path: Path, folders: Sequence[Path]) -> None:
    """Raise OSError in one line where a path cannot be made: below the first of the folders that is there."""
    if len(os.fsencode(path.name)) > LONGEST:
        raise OSError(f"{path.name[:20]}... is too long for the name of a file; say OUT=<a shorter one>")
    above = next(folder for folder in folders if os.path.lexists(folder))
    if not above.is_dir():
        raise NotADirectoryError(f"{path} cannot be made: {above} is no folder; say OUT=<another place>")
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{path} cannot be made: {above} is not yours to write; say OUT=<another place>")
