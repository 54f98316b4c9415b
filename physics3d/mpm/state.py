"""What a particle carries from one substep to the next, all in one flat buffer.

One buffer per state makes a checkpoint one copy and clearing an adjoint one fill. Torch owns the memory, Warp sees the
same bytes.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from torch import Tensor

from physics3d.warp_types import matrix, vector


@dataclass(frozen=True)
class State:
    """The state of n particles, or its adjoint (same shapes, units of one over them)."""

    flat: Tensor  # every number below [size]
    u: Tensor  # displacement from rest [n, 3] m
    v: Tensor  # velocity [n, 3] m/s
    L: Tensor  # velocity gradient and affine velocity [n, 3, 3] 1/s
    tau: Tensor  # Kirchhoff stress [n, 3, 3] Pa
    H: Tensor  # total deformation minus identity [n, 3, 3]
    memory: Tensor  # internal variables [m, n]
    v_gathered: Tensor  # before steering [n, 3]; the same memory as v unless something steers
    L_gathered: Tensor  # [n, 3, 3], likewise
    warp: dict[str, Any] = field(repr=False)  # the same arrays for Warp


def make_state(n: int, memory_rows: int, *, steered: bool, dtype: torch.dtype, device: str | torch.device) -> State:
    """A state of zeros; zero is the body at rest."""
    shapes = {"u": (n, 3), "v": (n, 3), "L": (n, 3, 3), "tau": (n, 3, 3), "H": (n, 3, 3)}
    if memory_rows:
        shapes["memory"] = (memory_rows, n)
    if steered:
        shapes |= {"v_gathered": (n, 3), "L_gathered": (n, 3, 3)}
    counts = {name: torch.Size(shape).numel() for name, shape in shapes.items()}
    flat = torch.zeros(sum(counts.values()), dtype=dtype, device=device)
    parts = dict(zip(shapes, flat.split(list(counts.values()))))
    views = {name: part.view(shapes[name]) for name, part in parts.items()}
    views.setdefault("memory", torch.zeros((0, n), dtype=dtype, device=device))
    for name, other in (("v_gathered", "v"), ("L_gathered", "L")):
        views.setdefault(name, views[other])
    real = wp.float32 if dtype == torch.float32 else wp.float64
    kinds = {(n, 3): vector(real), (n, 3, 3): matrix(real)}
    arrays = {}
    for name, view in views.items():
        if name == "memory":
            arrays[name] = wp.from_torch(view) if memory_rows else wp.zeros((0, n), dtype=real, device=str(device))
        else:
            arrays[name] = wp.from_torch(view, dtype=kinds[tuple(view.shape)])
    return State(flat=flat, warp=arrays, **views)
