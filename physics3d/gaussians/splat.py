"""A projected Gaussian as the kernels see it, their view of a camera, and what a picture's error depends on.

A projected Gaussian is ten numbers: centre u, v [px] and depth z [m]; A, s, p of its quadratic form

    e(dx, dy) = 1/2 (A (dx - s dy)^2 + p dy^2),    A = S_vv / det S,   s = S_uv / S_vv,   p = 1 / S_vv

(S is its covariance in the picture; a sum of squares, so that needles lose no digits to cancellation, and the rows and
columns it touches follow at once); its opacity; its colour.
"""

# To a type checker, Warp structs are another language.
# mypy: ignore-errors

from dataclasses import dataclass
from functools import cache

import warp as wp

NEAR = 0.01  # nothing closer to the camera is drawn [m]
LOW_PASS = 0.3  # variance added to every splat, about one pixel wide [px^2]
ALPHA_MAX = 0.999
MARGIN = 0.15  # of the image's size, outside of which the Jacobian is held constant, as 3DGS does
VISIBLE = 1 / 255  # opacity below which a Gaussian is never drawn
ENTRIES = 10  # u, v, z, A, s, p, opacity, r, g, b


@dataclass(frozen=True, kw_only=True)
class Numerics:
    """What a picture's error depends on, besides the Gaussians."""

    precision: str = "float32"  # or float64
    cutoff: float = VISIBLE  # alpha below which a Gaussian is not drawn
    stop: float = 1e-4  # transmittance below which nothing behind is drawn
    tile: int = 16  # side of a tile [px]; changes the speed, not the picture


@cache
def entry_type(real):
    return wp.types.vector(ENTRIES, real)


@cache
def view_type(real):
    mat33, vec3 = wp.types.matrix((3, 3), real), wp.types.vector(3, real)

    @wp.struct
    class View:
        R: mat33  # world to camera
        t: vec3  # [m]
        fx: real  # [px]
        fy: real
        cx: real
        cy: real
        width: int  # [px]
        height: int
        first_row: int  # of the tiles that are drawn, and one past the last
        end_row: int
        first_column: int
        end_column: int
        antialiased: int  # 1: opacity times sqrt(det / det with the low pass)
        cutoff: real
        stop: real

    return View
