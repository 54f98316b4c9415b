"""Sequences of launches that are recorded once and then repeated by one launch: a CUDA graph.

A substep is about nine launches, and a launch costs a GPU's host more time than a small body costs the GPU. What a
sequence reads and writes stays where it was when it was recorded; whoever moves an array forgets the graphs. On a CPU
Warp keeps such a sequence too and repeats it without Python, which is how it is tested where there is no GPU.
"""

from collections.abc import Callable, Hashable

import torch
import warp as wp

MOST = 32  # graphs that are kept: a body that spreads out needs others, and leaves the old ones behind


class Graphs:
    """Of one rollout on one device."""

    def __init__(self, device: torch.device):
        self.device = str(device)
        self._graphs: dict[Hashable, wp.Graph] = {}

    def forget(self) -> None:
        """Before arrays move."""
        self._graphs.clear()

    def run(self, key: Hashable, work: Callable[[], None]) -> None:
        """What `work` launches. It is asked only where nothing was recorded under this key, and computes nothing
        itself: launches, fills and copies on this device, and no look at a result."""
        if key not in self._graphs:
            if len(self._graphs) == MOST:
                self._graphs.clear()
            with wp.ScopedCapture(device=self.device) as capture:
                work()
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])
