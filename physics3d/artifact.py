"""An artifact is a frozen dataclass that saves, loads and checks itself.

Tensors and arrays go to `arrays.safetensors`, everything else to `fields.json`; nothing is pickled, and a person can
read what was stored. Dataclasses may be nested in tuples, lists and dicts, to a depth of `DEEPEST`. Loading calls
nothing but artifacts, and inside of them dataclasses that the annotations of their fields declare, or implementations
of an interface declared there: a forged file cannot name anything else. Whoever calls `save` may file the folder
atomically; here nothing knows about caching.
"""

import ast
import dataclasses
import importlib
import json
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Self, get_args

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

FIELDS, ARRAYS = "fields.json", "arrays.safetensors"
DEEPEST = 32  # levels of nesting in an artifact; those of this project have fewer than ten


class ArtifactError(ValueError):
    """The folder does not hold the artifact it should: missing, damaged, or of another class."""


@dataclasses.dataclass(frozen=True)
class AbstractArtifact:
    """Base of everything a stage returns. Tensors live on the CPU in an artifact."""

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy if the contents cannot be right."""

    def save(self, folder: Path) -> None:
        """Write the artifact into `folder`, made if missing. Raises ValueError from `check`, OSError on a full disk."""
        self.check()
        folder.mkdir(parents=True, exist_ok=True)
        tree, tensors = encode(self)
        try:
            save_file(tensors, folder / ARRAYS)
        except SafetensorError as error:
            raise OSError(f"cannot write {folder / ARRAYS}: {error}") from error
        (folder / FIELDS).write_text(json.dumps(tree, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the artifact back and check it. Raises ArtifactError with the folder and the reason."""
        try:
            tree = json.loads((folder / FIELDS).read_text(encoding="utf-8"))
            with safe_open(folder / ARRAYS, framework="pt") as stored:
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        except (OSError, ValueError, RecursionError, SafetensorError) as error:
            raise ArtifactError(f"{folder} does not hold a readable {cls.__name__}: {error}") from error
        try:
            artifact = decode(tree, tensors)
            if not isinstance(artifact, cls):
                raise ArtifactError(f"it holds a {type(artifact).__name__}")
            artifact.check()
        except Exception as error:  # whatever a class raises over values of wrong kinds, the folder is damaged
            raise ArtifactError(f"{folder} does not hold a valid {cls.__name__}: {error}") from error
        return artifact


def require_finite(name: str, value: torch.Tensor) -> None:
    """Raise ValueError if `value` holds NaN or infinity; the message counts them."""
    bad = int((~torch.isfinite(value)).sum())
    if bad:
        raise ValueError(f"{name} holds {bad} non-finite numbers of {value.numel()}; repair or drop those entries")


def encode(value: Any) -> tuple[Any, dict[str, torch.Tensor]]:
    """(what JSON can hold, the tensors it names) of an artifact, or of numbers, text, None, tensors, arrays, artifacts,
    and lists, tuples and tables of these. Raises TypeError for anything else."""
    tensors: dict[str, torch.Tensor] = {}
    return _encode(value, "", tensors, 0), tensors


def decode(tree: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """The other way about. Raises ArtifactError for a class that is no artifact."""
    return _decode(tree, tensors, (AbstractArtifact,), 0)


def _encode(value: Any, path: str, tensors: dict[str, torch.Tensor], depth: int) -> Any:
    if depth > DEEPEST:
        raise TypeError(f"artifact field {path}: nested deeper than {DEEPEST} levels")

    def inner(value: Any, name: Any) -> Any:
        return _encode(value, f"{path}.{name}".lstrip("."), tensors, depth + 1)

    if isinstance(value, np.ndarray):
        tensors[path] = torch.from_numpy(np.ascontiguousarray(value)).clone()
        return {"__array__": path}
    if isinstance(value, torch.Tensor):
        tensors[path] = value.detach().cpu().contiguous().clone()
        return {"__tensor__": path}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = f"{type(value).__module__}:{type(value).__qualname__}"
        fields = {f.name: inner(getattr(value, f.name), f.name) for f in dataclasses.fields(value) if f.init}
        return {"__class__": kind, "fields": fields}
    if isinstance(value, tuple):
        return {"__tuple__": [inner(v, i) for i, v in enumerate(value)]}
    if isinstance(value, list):
        return [inner(v, i) for i, v in enumerate(value)]
    if isinstance(value, dict):
        if not all(isinstance(k, str) for k in value):
            raise TypeError(f"artifact field {path}: dict keys must be strings, got {list(value)}")
        return {"__dict__": {k: inner(v, k) for k, v in value.items()}}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"artifact field {path}: cannot store a {type(value).__name__}")


def _decode(tree: Any, tensors: dict[str, torch.Tensor], declared: tuple[type, ...], depth: int) -> Any:
    """`declared` are the classes of which an object may stand here."""
    if depth > DEEPEST:
        raise ArtifactError(f"it is nested deeper than {DEEPEST} levels")

    def inner(tree: Any) -> Any:
        return _decode(tree, tensors, declared, depth + 1)

    if isinstance(tree, list):
        return [inner(v) for v in tree]
    if not isinstance(tree, dict):
        return tree
    if "__tensor__" in tree:
        return tensors[tree["__tensor__"]]
    if "__array__" in tree:
        return tensors[tree["__array__"]].numpy()
    if "__tuple__" in tree:
        return tuple(inner(v) for v in tree["__tuple__"])
    if "__dict__" in tree:
        return {k: inner(v) for k, v in tree["__dict__"].items()}
    kind = _class(tree["__class__"], declared)
    return kind(**{k: _decode(v, tensors, _declared(kind), depth + 1) for k, v in tree["fields"].items()})


def _class(name: str, declared: tuple[type, ...]) -> type:
    """The dataclass "module:name" of this project. Raises ArtifactError if it is not one of `declared`."""
    module, _, qualname = name.partition(":")
    if module.split(".")[0] not in ("physics3d", "stages"):
        raise ArtifactError(f"refusing to load class {name}: not part of this project")
    kind = getattr(importlib.import_module(module), qualname)
    mine = isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module
    if not mine or kind is AbstractArtifact or not issubclass(kind, declared):
        wanted = " or ".join(k.__name__ for k in declared) or "no object"
        raise ArtifactError(f"refusing to load class {name}: {wanted} is expected there")
    return kind


@cache
def _declared(kind: type) -> tuple[type, ...]:
    """The classes of this project that annotations of a dataclass's fields name: what its fields may hold."""
    found: dict[type, None] = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        for part in _parts(field.type, vars(sys.modules[kind.__module__])):
            if isinstance(part, type) and part.__module__.split(".")[0] in ("physics3d", "stages"):
                found[part] = None
    return tuple(found)


def _parts(annotation: Any, names: dict[str, Any]) -> Iterator[Any]:
    """An annotation and everything inside of it; text is looked up in `names`, unknown names are passed over."""
    if isinstance(annotation, str):
        for node in ast.walk(ast.parse(annotation, mode="eval")):
            if isinstance(node, ast.Name) and node.id in names:
                yield from _parts(names[node.id], names)
        return
    yield annotation
    for part in get_args(annotation):
        if not isinstance(part, str):  # the shape of a tensor, or a literal
            yield from _parts(part, names)
