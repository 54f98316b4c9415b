"""What the time step and the grid must know of the particles, in one look at all of them."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import warp as wp
from torch import Tensor

from physics3d.mpm.state import State
from physics3d.warp_types import matrix, vector

_FARTHEST = 2**29  # cells; beyond it a place is that far away


@dataclass(frozen=True)
class Survey:
    """Extremes over the particles that are finite."""

    stiffness: float  # max of M + 2 max |principal Kirchhoff stress| [Pa]
    speed: float  # [m/s]
    rate: float  # of the velocity gradient, its norm [1/s]
    lowest: tuple[int, ...]  # cell
    highest: tuple[int, ...]
    infinite: int  # particles whose place, velocity or stress is infinite or NaN
    outside: int  # particles out of the region


@cache
def _survey(real) -> wp.Kernel:
    vec3, mat33 = vector(real), matrix(real)
    farthest = real(_FARTHEST)

    @wp.kernel(module="unique", enable_backward=False)
    def survey_kernel(
        # in
        dx: real,  # [m]
        lower: vec3,  # of the region [m]
        upper: vec3,  # [m]
        modulus: wp.array(dtype=real),  # [p] M [Pa]
        rest: wp.array(dtype=vec3),  # [p] [m]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        v: wp.array(dtype=vec3),  # [p] [m/s]
        L: wp.array(dtype=mat33),  # [p] [1/s]
        tau: wp.array(dtype=mat33),  # [p] Kirchhoff stress [Pa]
        # out
        greatest: wp.array(dtype=real),  # [3] stiffness, squares of speed and rate
        counts: wp.array(dtype=int),  # [8] lowest cell, highest cell, infinite, outside
    ):
        p = wp.tid()
        S = tau[p]
        move, speed = u[p], wp.dot(v[p], v[p])
        mean = (S[0, 0] + S[1, 1] + S[2, 2]) / real(3.0)
        a, b, c = S[0, 0] - mean, S[1, 1] - mean, S[2, 2] - mean
        f, g, h = S[1, 2], S[0, 2], S[0, 1]
        size = wp.sqrt((a * a + b * b + c * c + real(2.0) * (f * f + g * g + h * h)) / real(6.0))
        if not wp.isfinite(move[0] + move[1] + move[2] + speed + mean + size):
            wp.atomic_add(counts, 6, 1)
            return
        if speed > greatest[1]:
            wp.atomic_max(greatest, 1, speed)
        rate = wp.ddot(L[p], L[p])
        if rate > greatest[2]:
            wp.atomic_max(greatest, 2, rate)
        # the eigenvalues are mean + 2 size cos(...): looked at only where they may matter
        if modulus[p] + real(2.0) * (wp.abs(mean) + real(2.0) * size) > greatest[0]:
            most = wp.abs(mean)
            if size > real(0.0):
                a, b, c, f, g, h = a / size, b / size, c / size, f / size, g / size, h / size
                det = a * (b * c - f * f) + h * (g * f - h * c) + g * (h * f - g * b)
                angle = wp.acos(wp.clamp(real(0.5) * det, real(-1.0), real(1.0))) / real(3.0)
                high = mean + real(2.0) * size * wp.cos(angle)
                low = mean + real(2.0) * size * wp.cos(angle + real(2.0943951023931953))
                most = wp.max(high, -low)
            wp.atomic_max(greatest, 0, modulus[p] + real(2.0) * most)
        d = offset[p] + move / dx
        x = rest[p] + move
        for axis in range(3):
            at = cell[p][axis] + int(wp.clamp(wp.floor(d[axis]), -farthest, farthest))
            if at < counts[axis]:
                wp.atomic_min(counts, axis, at)
            if at > counts[3 + axis]:
                wp.atomic_max(counts, 3 + axis, at)
        below, above = wp.min(x - lower), wp.min(upper - x)
        if below < real(0.0) or above < real(0.0):
            wp.atomic_add(counts, 7, 1)

    return survey_kernel


def survey(
    state: State, constant: dict[str, wp.array], modulus: Tensor, dx: float, lower: Tensor, upper: Tensor
) -> Survey:
    """`constant` as `Substeps` holds it, `modulus` M [p] or [1] in Pa, `lower`, `upper` corners of the region [m]."""
    real = wp.float32 if state.u.dtype == torch.float32 else wp.float64
    device = str(state.u.device)
    modulus = modulus.to(state.u).expand(len(state.u)).contiguous()
    greatest = wp.zeros(3, dtype=real, device=device)
    counts = wp.array(np.array([2**30] * 3 + [-(2**30)] * 3 + [0, 0], np.int32), dtype=wp.int32, device=device)
    vec3 = vector(real)
    inputs = [dx, vec3(*lower.tolist()), vec3(*upper.tolist()), wp.from_torch(modulus)]
    inputs += [constant[name] for name in ("rest", "cell", "offset")]
    inputs += [state.warp[name] for name in ("u", "v", "L", "tau")]
    wp.launch(_survey(real), len(state.u), inputs=inputs, outputs=[greatest, counts], device=device)
    stiffness, *squared = greatest.numpy().tolist()
    found = counts.numpy().tolist()
    speed, rate = (x**0.5 for x in squared)
    return Survey(stiffness, speed, rate, tuple(found[:3]), tuple(found[3:6]), found[6], found[7])
