"""The files that a camera file names: written on another system, with other endings, and some of them lost.

A name is looked for as it stands, then with slashes for backslashes, with any picture's ending in place of none, and in
other letters' case; of an absolute path of another machine, the longest end that exists below the folder counts.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path

from physics3d.scenes.pictures import PHOTOGRAPHS

LONGEST = 255  # bytes of one part of a name: what file systems allow
MOST_MISSING = 1 / 3  # share of the images that may be lost


def read_text(path: Path) -> str:
    """A text file in UTF-8 or UTF-16, with or without a byte order mark. Raises UnicodeDecodeError."""
    data = path.read_bytes()
    wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    return data.decode("utf-16" if wide else "utf-8-sig")


def find(folder: Path, name: str) -> Path:
    """The file called `name` by a camera file beside or above `folder`'s images; where it should be if it is lost.

    Raises ValueError for what no file can be called."""
    if not isinstance(name, str) or "\0" in name or max(map(len, os.fsencode(name).split(b"/"))) > LONGEST:
        raise ValueError(f"{str(name)[:50]!r}, beside {folder}, cannot be the name of a file; correct the camera file")
    plain = re.sub(r"^[A-Za-z]:", "", name).replace("\\", "/")
    expected = folder / (name if "\\" not in name else plain)
    tried = [Path(name), Path(plain)]
    if plain.startswith("/"):
        parts = [p for p in plain.split("/") if p]
        tried += [Path(*parts[i:]) for i in range(len(parts))]
    for path in tried:
        found = _variant(folder / path)
        if found is not None:
            return found
    return expected


def present(paths: Iterable[Path], folder: Path, camera_file: Path, log=None) -> set[Path]:
    """Those that exist. The lost ones are all named: in a warning, or in a ValueError where they are too many.

    Without a `log` the warning is left out: the files are only listed.
    """
    wanted = list(dict.fromkeys(paths))
    lost = [p for p in wanted if not p.is_file()]
    if lost:
        names = ", ".join(str(p.relative_to(folder) if p.is_relative_to(folder) else p) for p in lost)
        said = f"{len(lost)} of the {len(wanted)} images that {camera_file} names are missing in {folder}: {names}"
        if len(lost) > MOST_MISSING * len(wanted):
            raise ValueError(f"{said}; restore them (up to a third may be missing)")
        if log is not None:
            log.warn(f"{said}; they are left out")
    return set(wanted) - set(lost)


def require_unique(names: list[str], camera_file: Path) -> None:
    """Raises ValueError naming the images that a camera file lists more than once."""
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"{camera_file} lists {', '.join(twice)} more than once; keep one camera for each image")


def _variant(path: Path) -> Path | None:
    """`path`, or the file beside it whose name differs by a picture's ending it did not give, or by its case."""
    for ending in ("", ".png", *PHOTOGRAPHS):
        file = path.with_name(path.name + ending) if path.name else path
        if file.is_file():
            return file
    if not path.parent.is_dir():
        return None
    names = {f.name.lower(): f for f in sorted(path.parent.iterdir(), reverse=True) if f.is_file()}
    return next((names[n] for e in ("", ".png", *PHOTOGRAPHS) if (n := path.name.lower() + e) in names), None)
