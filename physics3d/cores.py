"""Work spread over the cores by threads: for what computes outside Python's lock, as OpenCV and NumPy do."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def usable() -> int:
    """Cores that this process may use: fewer than the machine has under `taskset`, in a container or by a scheduler."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux alone has it
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def spread(work: Callable[..., Any], *given: Iterable[Any]) -> list[Any]:
    """`work` of every element of `given`, as by map, in their order. An exception in one is raised here."""
    with ThreadPoolExecutor(usable()) as pool:
        return list(pool.map(work, *given))
