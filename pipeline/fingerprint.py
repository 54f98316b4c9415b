"""The fingerprint of a stage: a hash of everything that its result depends on. Computed without importing any of it.

    fingerprint = sha256( configuration,  code it reaches,  fingerprints of its inputs,  content of the files it names )

- Configuration: without `device`, which must not change the result beyond round-off, and without where the data lies.
- Code: the syntax trees (no comments, no docstrings, no line numbers) of the modules named by `_target_` anywhere in
  the configuration, and of every module of this project that they import, at any depth, also from inside functions.
  `physics3d.log` is left out: it decides how progress looks.
- Files: an entry `path` (or `..._path`) of the configuration is replaced by the names and sha256 of all files under it
  that are not hidden, which is what `AbstractSource.files()` lists and at most a little more; the source itself could
  only be asked by importing torch. Digests are remembered by size and modification time: the second look is fast.
"""

import ast
import hashlib
import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("physics3d", "stages")
PRESENTATION = ("physics3d.log",)


def fingerprint(config: dict[str, Any], inputs: list[str], digests: Path | None = None) -> str:
    """Sixteen hexadecimal digits for a stage with this `config` and inputs of these fingerprints.

    `digests` is the file in which digests of data files are remembered. Raises ValueError if a path does not exist.
    """
    parts = [_essential(config, digests), code_digest(tuple(sorted(targets(config)))), inputs]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:16]


def targets(config: Any) -> set[str]:
    """Every `_target_` in a configuration."""
    if isinstance(config, dict):
        own = {config["_target_"]} if "_target_" in config else set()
        return own.union(*map(targets, config.values()))
    return set().union(*map(targets, config)) if isinstance(config, list | tuple) else set()


@cache
def code_digest(names: tuple[str, ...], root: Path = ROOT) -> str:
    """Hash of the syntax trees of these modules (or classes in them) and of all project modules they import."""
    reached: set[str] = set()
    waiting = [module for name in names for module in _modules(name, root)]
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting.extend(m for name in _imports(module, root) for m in _modules(name, root))
    trees = [(m, _tree_digest(_file(m, root))) for m in sorted(reached - set(PRESENTATION))]
    return hashlib.sha256(json.dumps(trees).encode()).hexdigest()[:16]


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


def _essential(config: Any, digests: Path | None) -> Any:
    if isinstance(config, list | tuple):
        return [_essential(v, digests) for v in config]
    if not isinstance(config, dict):
        return config
    essential = {k: _essential(v, digests) for k, v in config.items() if k != "device"}
    for key in essential:
        if key.split("_")[-1] == "path" and isinstance(essential[key], str):
            essential[key] = content_digest(Path(essential[key]), digests)
    return essential


def content_digest(path: Path, digests: Path | None = None) -> str:
    """Hash of a file, or of the names and contents of all files under a folder that are not hidden."""
    path = path.expanduser()
    if not path.exists():
        raise ValueError(f"no such file or folder: {path}; say where the data lies with DATA=<folder> (data=<folder>)")
    if path.suffix == ".json":  # it names images beside it
        path = path.parent
    known: dict[str, list] = {}
    if digests is not None and digests.is_file():
        try:
            known = json.loads(digests.read_text())
        except ValueError:
            known = {}
    fresh = {}
    lines = []
    for file in _files(path):
        stat = file.stat()
        key, state = str(file.resolve()), [stat.st_size, stat.st_mtime_ns]
        if known.get(key, [])[:2] != state:
            fresh[key] = [*state, file_digest(file)]
        relative = file.relative_to(path).as_posix() if path.is_dir() else file.suffix
        lines.append((relative, (fresh.get(key) or known[key])[2]))
    if digests is not None and fresh:
        _remember(digests, known | fresh)
    return hashlib.sha256(json.dumps(lines).encode()).hexdigest()


def file_digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
        return
    for folder, folders, names in os.walk(path, followlinks=True):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        yield from (Path(folder, name) for name in sorted(names) if not name.startswith("."))


def _remember(digests: Path, known: dict[str, list]) -> None:
    temporary = digests.with_suffix(f".{os.getpid()}")
    try:
        digests.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(known))
        temporary.replace(digests)
    except OSError:  # only costs time: the files are read again next time
        temporary.unlink(missing_ok=True)
