"""Warp's vectors and matrices of a precision: every kernel is made once for float32 and once for float64."""

import warp as wp


def vector(real) -> type:
    """3-vector of `real` (wp.float32 or wp.float64)."""
    return wp.vec3f if real is wp.float32 else wp.vec3d


def vector4(real) -> type:
    """4-vector of `real`: (momentum, mass) of a node."""
    return wp.vec4f if real is wp.float32 else wp.vec4d


def matrix(real) -> type:
    """3x3 matrix of `real`."""
    return wp.mat33f if real is wp.float32 else wp.mat33d
