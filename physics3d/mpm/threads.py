"""Work divided over Python threads: a Warp kernel runs on one thread of a CPU, and a launch releases the GIL."""

import threading
from collections.abc import Callable
from itertools import pairwise

import numpy as np

Wait = Callable[[], object]  # returns when all workers have called it


def shares(count: int, workers: int) -> list[tuple[int, int]]:
    """(first, how many) of `count` things for each worker."""
    edges = np.linspace(0, count, workers + 1).astype(int)
    return [(int(a), int(b - a)) for a, b in pairwise(edges)]


def on_all(workers: int, work: Callable[[int, Wait], None]) -> None:
    """work(w, wait) on a thread for each worker; an exception in one ends all and is raised here."""
    if workers == 1:
        work(0, lambda: None)
        return
    barrier = threading.Barrier(workers)
    errors: list[BaseException] = []

    def guarded(w: int) -> None:
        try:
            work(w, barrier.wait)
        except threading.BrokenBarrierError:
            pass
        except BaseException as error:
            errors.append(error)
            barrier.abort()

    others = [threading.Thread(target=guarded, args=(w,)) for w in range(1, workers)]
    for thread in others:
        thread.start()
    guarded(0)
    for thread in others:
        thread.join()
    if errors:
        raise errors[0]
