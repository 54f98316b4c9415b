"""Where published weights come from: a local folder, else the hub's cache, else the hub, else one clear message."""

import importlib
import inspect
import json
from pathlib import Path
from typing import Any, Literal

import torch

Precision = Literal["float16", "bfloat16", "float32"]
Dtypes = torch.dtype | dict[str, torch.dtype]  # of all networks, or of each by name and of the "default"


def load_pipeline(
    kind: Any, name: str, *, key: str, dtype: Dtypes, variant: str | None, without: tuple[str, ...] = ()
) -> Any:
    """A diffusers pipeline of class `kind` from `name`, a folder or a hub repository; parts named in `without` are
    not loaded.

    Raises ValueError naming the configuration key and what was tried, after at most one short look at the network.
    """
    folder = pipeline_folder(kind, name, key=key, variant=variant)
    absent: dict[str, Any] = dict.fromkeys(without)
    try:
        return kind.from_pretrained(folder, local_files_only=True, dtype=dtype, variant=variant, **absent)
    except (OSError, ValueError, AttributeError) as error:
        raise ValueError(f"{key}={name}: no {kind.__name__} can be read from {folder}: {error}") from error


def hollow_pipeline(
    kind: Any, name: str, *, key: str, dtype: Dtypes, variant: str | None, without: tuple[str, ...] = ()
) -> Any:
    """The same pipeline with all its networks on torch's meta device: shapes, and no weights. Raises ValueError as
    `load_pipeline`."""
    folder = pipeline_folder(kind, name, key=key, variant=variant)
    dtypes = dtype if isinstance(dtype, dict) else {"default": dtype}
    try:
        index, known = json.loads((folder / "model_index.json").read_text()), inspect.signature(kind).parameters
        parts = {part: None if part in without else made for part, made in index.items() if part in known}
        for part, named in parts.items():
            if isinstance(named, list):
                parts[part] = hollow(named, folder / part, dtypes.get(part, dtypes["default"]))
        return kind(**parts)
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ValueError(f"{key}={name}: no {kind.__name__} can be read from {folder}: {error}") from error


def hollow(named: list[str | None], folder: Path, dtype: torch.dtype) -> Any:
    """One part of a pipeline, [library, class] in its index: a network without weights, or the whole of what has
    none."""
    library, name = named
    if library is None or name is None:
        return None
    kind = getattr(importlib.import_module(library), name)
    if not issubclass(kind, torch.nn.Module):
        return kind.from_pretrained(folder)
    with torch.device("meta"):
        if hasattr(kind, "load_config"):  # of diffusers
            network = kind.from_config(kind.load_config(folder, local_files_only=True))
        else:  # of transformers
            network = kind(kind.config_class.from_pretrained(folder, local_files_only=True))
    # some make a tensor wherever they are; not by its own `to`, which warns of what loading would keep precise
    return torch.nn.Module.to(network.requires_grad_(False).eval(), "meta", dtype)


def pipeline_files(kind: Any, name: str, *, key: str, variant: str | None) -> tuple[str, ...]:
    """The files of such a pipeline, on this machine after the call. Raises ValueError as `load_pipeline`."""
    folder = pipeline_folder(kind, name, key=key, variant=variant)
    return tuple(sorted(str(p) for p in folder.rglob("*") if p.is_file()))


def pipeline_folder(kind: Any, name: str, *, key: str, variant: str | None) -> Path:
    """The folder itself, or the one in the hub's cache, fetched if it is not there."""
    folder = Path(name).expanduser()
    if folder.is_dir():
        return folder
    if folder.is_absolute() or name.startswith((".", "~")):
        raise ValueError(
            f"{key}={name} is not a folder; give the folder of a downloaded {kind.__name__} or its name on the hub"
        )
    try:
        return Path(kind.download(name, variant=variant, local_files_only=True))
    except (OSError, ValueError):
        pass  # not in the cache
    if hub_answers():
        try:
            return Path(kind.download(name, variant=variant))
        except (OSError, ValueError) as error:
            raise ValueError(f"{key}={name} could not be fetched from the hub: {error}") from error
    raise ValueError(
        f"the weights of {key}={name} are neither a local folder nor in the hub's cache, and the hub cannot be "
        f"reached; set {key} to a folder that holds them, or choose the exemplar prior, which needs none"
    )


def hub_answers(timeout: float = 3.0) -> bool:
    """True if the model hub answers within `timeout` [s] (its own client would retry for half a minute)."""
    import httpx
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return False
    try:
        httpx.head(constants.ENDPOINT, timeout=timeout)
    except httpx.HTTPError:
        return False
    return True
