"""States kept on the way forward so that the way back can start again from them, as many as memory allows.

Run i leads from state i to state i + 1. Forwards every `spacing`-th state is kept, and the spacing doubles whenever
there are too many. Backwards a state that was not kept is computed again from the last one before it; the places that
the way back has set free take states in between, evenly spaced. With room for m >= sqrt(n) of n states that costs about
one more forward pass. After Griewank and Walther (2000), who give the optimal schedule for a known n; n is not known
here before the end.
"""

from collections.abc import Callable

from torch import Tensor


class Checkpoints:
    """Copies of states; `most` of them at a time (None: no bound), not counting those that were `needed`."""

    def __init__(self, most: int | None):
        self.most = most
        self.spacing = 1
        self.kept: dict[int, Tensor] = {}
        self.needed: set[int] = set()

    def offer(self, i: int, state: Tensor, *, needed: bool = False) -> None:
        """State i, on the way forward; `needed` ones are kept in any case."""
        if needed:
            self.needed.add(i)
        if needed or i % self.spacing == 0:
            self.kept[i] = state.clone()
        while self.most is not None and self._counted() > self.most:
            self.spacing *= 2
            for k in [k for k in self.kept if k % self.spacing and k not in self.needed]:
                del self.kept[k]

    def forget(self, first: int) -> None:
        """Drop state `first` and all that follow."""
        for k in [k for k in self.kept if k >= first]:
            del self.kept[k]
        self.needed = {k for k in self.needed if k < first}

    def recall(self, i: int, state: Tensor, replay: Callable[[int], None]) -> None:
        """Write state i into `state`; replay(k) must carry `state` from k to k + 1. States after i are forgotten, but
        for those that were needed: a second way back needs them again."""
        for k in [k for k in self.kept if k > i and k not in self.needed]:
            del self.kept[k]
        if i in self.kept:
            state.copy_(self.kept[i])
            return
        start = max(k for k in self.kept if k < i)
        state.copy_(self.kept[start])
        free = max(0, (self.most or 0) - self._counted())
        stride = -(-(i - start) // (free + 1))
        for k in range(start, i):
            replay(k)
            if k + 1 < i and (k + 1 - start) % stride == 0:
                self.kept[k + 1] = state.clone()

    def _counted(self) -> int:
        return len(self.kept) - len(self.needed)
