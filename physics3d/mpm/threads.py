"""Work divided over Python threads: a Warp kernel runs on one thread of a CPU, and a launch releases the GIL.

Workers wait for each other twice per substep, which of a small body lasts some hundred microseconds. A lock of Python
takes fifty of them to wake a thread; so who waits looks for a while, in a kernel and without the GIL, whether all have
come, and only then sleeps between two looks.
"""

import threading
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import warp as wp

Wait = Callable[[], object]  # returns when all workers have called it

_NAP = 5e-5  # [s] between two looks of who has waited for long: the others may need this core


def shares(count: int, workers: int) -> list[tuple[int, int]]:
    """(first, how many) of `count` things for each worker."""
    edges = np.linspace(0, count, workers + 1).astype(int)
    return [(int(a), int(b - a)) for a, b in pairwise(edges)]


class Team:
    """Workers that do the same on a thread each, over and over."""

    def __init__(self, workers: int):
        self.workers = workers
        if workers > 1:
            # of each worker, how often it has come; a line of the cache for each
            self._came = wp.zeros((workers, 16), dtype=wp.int32, device="cpu")
            self._met = [wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(workers)]
            self._all_here = [met.numpy() for met in self._met]  # the same memory
            self._looks = [[self._look(w, come) for come in (1, 0)] for w in range(workers)]

    def run(self, work: Callable[[int, Wait], None]) -> None:
        """work(w, wait) on a thread for each worker; an exception in one ends all and is raised here."""
        if self.workers == 1:
            work(0, lambda: None)
            return
        errors: list[BaseException] = []

        def guarded(w: int) -> None:
            def wait() -> None:
                come, look = self._looks[w]
                come.launch()
                while not self._all_here[w][0]:
                    if errors:
                        raise threading.BrokenBarrierError
                    time.sleep(_NAP)
                    look.launch()

            try:
                work(w, wait)
            except threading.BrokenBarrierError:
                pass
            except BaseException as error:
                errors.append(error)

        others = [threading.Thread(target=guarded, args=(w,)) for w in range(1, self.workers)]
        for thread in others:
            thread.start()
        guarded(0)
        for thread in others:
            thread.join()
        if errors:
            self._came.zero_()  # some have come more often than others
            raise errors[0]

    def _look(self, w: int, come: int) -> wp.Launch:
        inputs = [w, self.workers, come, self._came]
        return wp.launch(_meet, 1, inputs=inputs, outputs=[self._met[w]], device="cpu", record_cmd=True)


@wp.func_native(
    """
    int* all = (int*)came.data;
    const int mine = all[16 * w] + come;
    if (come)
        __atomic_store_n(all + 16 * w, mine, __ATOMIC_RELEASE);
    for (int look = 0; look < 2000; ++look) {
        bool here = true;
        for (int i = 0; i < workers; ++i)
            here = here && __atomic_load_n(all + 16 * i, __ATOMIC_ACQUIRE) - mine >= 0;
        if (here)
            return 1;
    #if defined(__x86_64__)
        __builtin_ia32_pause();
    #endif
    }
    return 0;
    """
)
def _have_all_come(w: int, workers: int, come: int, came: wp.array2d(dtype=int)) -> int:
    """Has each worker come as often as this one? For a while it is looked again; `come` is 1 if it comes now."""
    ...


@wp.kernel(module="unique", enable_backward=False)
def _meet(
    # in
    w: int,  # worker
    workers: int,  # how many
    come: int,  # 1: it comes; 0: it only looks again
    came: wp.array2d(dtype=int),  # [worker, 16] how often
    # out
    met: wp.array(dtype=int),  # [1] are all here?
):
    met[0] = _have_all_come(w, workers, come, came)
