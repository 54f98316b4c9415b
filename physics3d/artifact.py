"""An artifact is a frozen dataclass that saves, loads and checks itself.

Tensors and arrays go to `arrays.safetensors`, everything else to `fields.json`; nothing is pickled, so that loading
runs no foreign code and a person can read what was stored. Dataclasses of this project may be nested to any depth in
tuples, lists and dicts. Whoever calls `save` may file the folder atomically; here nothing knows about caching.
"""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

FIELDS, ARRAYS = "fields.json", "arrays.safetensors"


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
        tensors: dict[str, torch.Tensor] = {}
        tree = _encode(self, "", tensors)
        try:
            save_file(tensors, folder / ARRAYS)
        except SafetensorError as error:
            raise OSError(f"cannot write {folder / ARRAYS}: {error}") from error
        (folder / FIELDS).write_text(json.dumps(tree, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the artifact back and check it. Raises ArtifactError with the folder and the reason."""
        try:
            tree = json.loads((folder / FIELDS).read_text())
            with safe_open(folder / ARRAYS, framework="pt") as stored:
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        except (OSError, json.JSONDecodeError, SafetensorError) as error:
            raise ArtifactError(f"{folder} does not hold a readable {cls.__name__}: {error}") from error
        try:
            artifact = _decode(tree, tensors)
            if not isinstance(artifact, cls):
                raise ArtifactError(f"it holds a {type(artifact).__name__}")
            artifact.check()
        except (ValueError, KeyError, TypeError, AttributeError, ImportError) as error:
            raise ArtifactError(f"{folder} does not hold a valid {cls.__name__}: {error}") from error
        return artifact


def require_finite(name: str, value: torch.Tensor) -> None:
    """Raise ValueError if `value` holds NaN or infinity; the message counts them."""
    bad = int((~torch.isfinite(value)).sum())
    if bad:
        raise ValueError(f"{name} holds {bad} non-finite numbers of {value.numel()}; repair or drop those entries")


def _encode(value: Any, path: str, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, np.ndarray):
        tensors[path] = torch.from_numpy(np.ascontiguousarray(value)).clone()
        return {"__array__": path}
    if isinstance(value, torch.Tensor):
        tensors[path] = value.detach().cpu().contiguous().clone()
        return {"__tensor__": path}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = f"{type(value).__module__}:{type(value).__qualname__}"
        fields = {
            f.name: _encode(getattr(value, f.name), f"{path}.{f.name}".lstrip("."), tensors)
            for f in dataclasses.fields(value)
            if f.init
        }
        return {"__class__": kind, "fields": fields}
    if isinstance(value, tuple):
        return {"__tuple__": [_encode(v, f"{path}.{i}", tensors) for i, v in enumerate(value)]}
    if isinstance(value, list):
        return [_encode(v, f"{path}.{i}", tensors) for i, v in enumerate(value)]
    if isinstance(value, dict):
        if not all(isinstance(k, str) for k in value):
            raise TypeError(f"artifact field {path}: dict keys must be strings, got {list(value)}")
        return {"__dict__": {k: _encode(v, f"{path}.{k}", tensors) for k, v in value.items()}}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"artifact field {path}: cannot store a {type(value).__name__}")


def _decode(tree: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(tree, list):
        return [_decode(v, tensors) for v in tree]
    if not isinstance(tree, dict):
        return tree
    if "__tensor__" in tree:
        return tensors[tree["__tensor__"]]
    if "__array__" in tree:
        return tensors[tree["__array__"]].numpy()
    if "__tuple__" in tree:
        return tuple(_decode(v, tensors) for v in tree["__tuple__"])
    if "__dict__" in tree:
        return {k: _decode(v, tensors) for k, v in tree["__dict__"].items()}
    module, _, name = tree["__class__"].partition(":")
    if module.split(".")[0] not in ("physics3d", "stages"):
        raise ArtifactError(f"refusing to load class {tree['__class__']}: not part of this project")
    kind = getattr(importlib.import_module(module), name)
    return kind(**{k: _decode(v, tensors) for k, v in tree["fields"].items()})
