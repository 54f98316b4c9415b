"""Where published weights come from: a local folder, else the hub's cache, else the hub, else one clear message."""

from pathlib import Path
from typing import Any, Literal

import torch

Precision = Literal["float16", "bfloat16", "float32"]


def load_pipeline(kind: Any, name: str, *, key: str, dtype: torch.dtype, variant: str | None) -> Any:
    """A diffusers pipeline of class `kind` from `name`, a folder or a hub repository.

    Raises ValueError naming the configuration key and what was tried, after at most one short look at the network.
    """
    folder = pipeline_folder(kind, name, key=key, variant=variant)
    try:
        return kind.from_pretrained(folder, local_files_only=True, dtype=dtype, variant=variant)
    except (OSError, ValueError, AttributeError) as error:
        raise ValueError(f"{key}={name}: no {kind.__name__} can be read from {folder}: {error}") from error


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
