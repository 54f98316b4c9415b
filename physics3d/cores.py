"""Work spread over the cores by threads: for what computes outside Python's lock, as OpenCV and NumPy do."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def spread(work: Callable[..., Any], *given: Iterable[Any]) -> list[Any]:
    """`work` of every element of `given`, as by map, in their order. An exception in one is raised here."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, *given))
