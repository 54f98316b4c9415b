"""The kernels of `rasterize.py` in one precision, with their adjoints, written by hand."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from physics3d.gaussians.blending import blending
from physics3d.gaussians.projection import projection
from physics3d.gaussians.splat import entry_type, view_type


@dataclass(frozen=True)
class Kernels:
    View: Any  # struct: camera and options
    entry: Any  # vector of a projected Gaussian
    project: wp.Kernel
    project_adjoint: wp.Kernel
    list_tiles: wp.Kernel
    blend: wp.Kernel
    blend_adjoint: wp.Kernel
    middle: wp.Kernel


@cache
def kernels(precision: str, tile: int, side: int) -> Kernels:
    """Kernels for squares of side x side pixels; compiled at their first launch."""
    real = {"float32": wp.float32, "float64": wp.float64}[precision]
    return Kernels(view_type(real), entry_type(real), *projection(real, tile), *blending(real, tile, side))
