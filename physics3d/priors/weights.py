"""Where published weights come from: a local folder, else the hub's cache, else the hub, else one clear message."""

from pathlib import Path
from typing import Any, Literal

import torch

Precision = Literal["float16", "bfloat16", "float32"]


def load_pipeline(kind: Any, name: str, *, key: str, dtype: torch.dtype, variant: str | None) -> Any:
    """A diffusers pipeline of class `kind` from `name`, a folder or a hub repository.

    Raises ValueError naming the configuration key and what was tried, after at most one short look at the network.
    """
    folder = Path(name).expanduser()
    options: dict[str, Any] = {"dtype": dtype, "variant": variant}
    if folder.is_dir():
        try:
            return kind.from_pretrained(folder, local_files_only=True, **options)
        except (OSError, ValueError, AttributeError) as error:
            raise ValueError(f"{key}={name} is a folder but no {kind.__name__} can be read from it: {error}") from error
    if folder.is_absolute() or name.startswith((".", "~")):
        raise ValueError(
            f"{key}={name} is not a folder; give the folder of a downloaded {kind.__name__} or its name on the hub"
        )
    try:
        return kind.from_pretrained(name, local_files_only=True, **options)
    except (OSError, ValueError):
        pass  # not in the cache
    if hub_answers():
        try:
            return kind.from_pretrained(name, **options)
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
