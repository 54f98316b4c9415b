"""The fingerprint of a stage: a hash of everything that its result depends on. Computed without importing any of it.

    fingerprint = sha256( configuration,  code it reaches,  libraries,  fingerprints of its inputs,  files it reads )

What is hashed, `made_of`, is filed with the result, so that `make why` can tell what has changed since.

- Configuration: without `device`, which must not change the result beyond round-off, and without where the data lies.
- Code: the syntax trees (no comments, no docstrings, no line numbers) of the modules named by `_target_` anywhere in
  the configuration, and of every module of this project that they import, at any depth, also from inside functions.
  `physics3d.log` is left out: it decides how progress looks.
- Libraries: major and minor version of those that compute and that this code imports.
- Files: an entry `path` (or `..._path`), and weights (`model`, `weights`) that lie on this machine, are replaced by the
  names and sha256 of all files under it that are not hidden; weights of the hub by their commit in its cache. Beside
  these, the files that a source itself says it reads, wherever they lie: `AbstractSource.files()`, which the caller
  asks. Digests are remembered by size and modification time: the second look is fast.
"""

import ast
import hashlib
import importlib.metadata
import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("physics3d", "stages")
PRESENTATION = ("physics3d.log",)
# what computes: name in an import statement -> the packages that may bring it
LIBRARIES = {
    "torch": ("torch",),
    "torchvision": ("torchvision",),
    "warp": ("warp-lang",),
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "cv2": ("opencv-python-headless", "opencv-python"),
    "PIL": ("pillow",),
    "open3d": ("open3d-cpu", "open3d"),
    "pycolmap": ("pycolmap",),
    "diffusers": ("diffusers",),
    "transformers": ("transformers",),
    "sam2": ("sam2",),
    "gsplat": ("gsplat",),
    "imageio_ffmpeg": ("imageio-ffmpeg",),
}


def made_of(
    config: dict[str, Any], inputs: list[Any], digests: Path | None = None, files: Iterable[tuple[str, Path]] = ()
) -> dict[str, Any]:
    """Everything that the result of a stage with this `config` and inputs of these fingerprints depends on:

        config     without what does not matter, data and local weights replaced by "data"
        code       module -> digest
        libraries  name -> major.minor
        inputs     as given
        data       entry, or entry/file below it, or what a source says it reads -> digest

    `files` are what its sources say they read, by a name that does not change when all of it is moved; `digests` is the
    file in which digests of data files are remembered. Raises ValueError if a path does not exist.
    """
    targeted = tuple(sorted(targets(config)))
    known = Digests(digests)
    data = {name: known.of(path) if path.is_file() else "missing" for name, path in sorted(files)}
    essential = _essential(config, "", data, known)
    known.keep()
    parts = {"config": essential, "code": code(targeted), "libraries": libraries(targeted)}
    return parts | {"inputs": inputs, "data": data}


def hashed(parts: dict[str, Any]) -> str:
    """Sixteen hexadecimal digits for what a result is made of."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:16]


def fingerprint(
    config: dict[str, Any], inputs: list[Any], digests: Path | None = None, files: Iterable[tuple[str, Path]] = ()
) -> str:
    """As `made_of`, hashed."""
    return hashed(made_of(config, inputs, digests, files))


def targets(config: Any) -> set[str]:
    """Every `_target_` in a configuration."""
    if isinstance(config, dict):
        own = {config["_target_"]} if "_target_" in config else set()
        return own.union(*map(targets, config.values()))
    return set().union(*map(targets, config)) if isinstance(config, list | tuple) else set()


@cache
def code(names: tuple[str, ...], root: Path = ROOT) -> dict[str, str]:
    """Module -> digest of its syntax tree: these modules (or classes in them), and project modules they import."""
    return {module: _tree_digest(_file(module, root))[:16] for module in _reached(names, root)}


@cache
def libraries(names: tuple[str, ...], root: Path = ROOT) -> dict[str, str]:
    """Library -> major.minor, of those that compute and that the code reached from `names` imports."""
    imported = {name.split(".")[0] for module in _reached(names, root) for name in _imports(module, root)}
    found = {name: installed(name) for name in LIBRARIES if name in imported}
    return {name: ".".join(version.split(".")[:2]) for name, version in found.items() if version}


@cache
def installed(library: str) -> str | None:
    """Version of one of `LIBRARIES`; None where it is missing."""
    for package in LIBRARIES[library]:
        with suppress(importlib.metadata.PackageNotFoundError):
            return importlib.metadata.version(package)
    return None


@cache
def _reached(names: tuple[str, ...], root: Path) -> tuple[str, ...]:
    """The project modules that importing `names` runs, at any depth, but for those that only decide how things look."""
    reached: set[str] = set()
    waiting = [module for name in names for module in _modules(name, root)]
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting.extend(m for name in _imports(module, root) for m in _modules(name, root))
    return tuple(sorted(reached - set(PRESENTATION)))


def _file(module: str, root: Path) -> Path:
    """Source file of a dotted name; it need not exist."""
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _modules(name: str, root: Path) -> list[str]:
    """The project modules that importing `name` (a module, or a class or function in one) runs: it and its packages."""
    parts = name.split(".")
    prefixes = [".".join(parts[: i + 1]) for i in range(len(parts))]
    return [p for p in prefixes if parts[0] in PACKAGES and _file(p, root).is_file()]


@cache
def _imports(module: str, root: Path) -> tuple[str, ...]:
    """Dotted names that a module imports anywhere in its text."""
    path = _file(module, root)
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    names = []
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            names += [f"{start}.{alias.name}" for alias in node.names]
    return tuple(names)


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


@cache
def _tree_digest(path: Path) -> str:
    tree = ast.parse(path.read_text(), filename=str(path))  # its own copy: docstrings are cut out of it
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and body:
            first = body[0]
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                node.body = body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _essential(config: Any, where: str, data: dict[str, str], known: "Digests") -> Any:
    """The configuration without what does not matter; digests of the data it names are added to `data`."""

    def below(key: Any) -> str:
        return f"{where}.{key}".lstrip(".")

    if isinstance(config, list | tuple):
        return [_essential(v, below(i), data, known) for i, v in enumerate(config)]
    if not isinstance(config, dict):
        return config
    essential = {k: _essential(v, below(k), data, known) for k, v in config.items() if k != "device"}
    for key, value in essential.items():
        if not isinstance(value, str):
            continue
        if key.split("_")[-1] == "path":
            data |= contents(below(key), Path(value), known)
            essential[key] = "data"
        elif "_target_" in config and key in ("model", "weights"):
            here = Path(value).expanduser()
            if here.exists():
                data |= contents(below(key), here, known)
                essential[key] = "data"
            elif commit := _commit(value):
                data[below(key)] = commit
    return essential


def _commit(name: str) -> str | None:
    """The commit of a repository of the hub that its cache on this machine holds."""
    home = Path(os.environ.get("HF_HOME") or "~/.cache/huggingface")
    cache = Path(os.environ.get("HF_HUB_CACHE") or home / "hub").expanduser()
    if re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        with suppress(OSError, ValueError):
            return (cache / f"models--{name.replace('/', '--')}" / "refs" / "main").read_text().strip()
    return None


def contents(name: str, path: Path, known: "Digests") -> dict[str, str]:
    """Digest of a file under `name` and its suffix, or of all files below a folder that are not hidden."""
    path = path.expanduser()
    if not path.exists():
        raise ValueError(f"no such file or folder: {path}; say where the data lies with DATA=<folder> (data=<folder>)")
    if not path.is_dir():
        return {f"{name}{path.suffix}": known.of(path)}
    return {name: "folder"} | {f"{name}/{f.relative_to(path).as_posix()}": known.of(f) for f in _files(path)}


def file_digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    seen = set()  # links may lead back
    for place, folders, names in os.walk(folder, followlinks=True):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        if (here := os.path.realpath(place)) in seen:
            folders.clear()
            continue
        seen.add(here)
        files = (Path(place, name) for name in sorted(names) if not name.startswith("."))
        yield from (file for file in files if file.is_file())


class Digests:
    """Digests of files, remembered by size and time of change in a file on the shelf."""

    def __init__(self, memory: Path | None):
        self.memory = memory
        self.known = recall(memory) if memory else {}
        self.fresh: dict[str, list] = {}

    def of(self, path: Path) -> str:
        """sha256 of a file. Raises ValueError if it cannot be read."""
        try:
            if not path.is_file():
                raise OSError(None, "it is neither a file nor a folder")
            stat = path.stat()
            key, state = str(path.resolve()), [stat.st_size, stat.st_mtime_ns]
            match self.fresh.get(key) or self.known.get(key):
                case [size, changed, str(digest)] if [size, changed] == state:
                    return digest
            self.fresh[key] = [*state, file_digest(path)]
        except OSError as error:
            raise ValueError(f"cannot read {path}: {error.strerror}") from error
        return self.fresh[key][2]

    def keep(self) -> None:
        if self.memory and self.fresh:
            remember(self.memory, self.known | self.fresh)


def recall(memory: Path) -> dict[str, Any]:
    """What `remember` wrote; nothing if that is missing or damaged."""
    with suppress(OSError, ValueError, RecursionError):
        stored = json.loads(memory.read_text())
        return stored if isinstance(stored, dict) else {}
    return {}


def remember(memory: Path, known: dict[str, Any]) -> None:
    """Write a table as a whole or not at all; without it, things only take longer."""
    temporary = memory.with_name(f"{memory.name}.{os.getpid()}")
    with suppress(OSError):
        try:
            memory.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_text(json.dumps(known))
            temporary.replace(memory)
        finally:
            temporary.unlink(missing_ok=True)
