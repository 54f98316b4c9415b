"""Elastic strain in six rows of the memory: X = b - I, upper triangle row by row, carried by the flow.

    b_trial = (I + M) b (I + M)^T,   M = dt L                          of a spring whose dash-pot stands still
    psi     = mu |dev eps|^2 + K/2 (tr eps)^2,   eps = 1/2 ln b        energy of a Hencky spring [J/m^3]

What flows keeps its elastic strain here, so that H stays the total deformation. Simo and Hughes, Computational
Inelasticity (1998), sec. 9.2.
"""

import functools
import math

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.tensors.eigen import principal_values
from physics3d.materials.tensors.log_strain import FLOOR
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix


@functools.cache
def load_strain(real: type) -> wp.Function:
    """load(p, row, memory) -> X, the strain in six rows of column p."""
    mat33 = matrix(real)

    @wp.func(name=f"load_strain_{real.__name__}")
    def load(p: int, row: int, memory: wp.array2d(dtype=real)):
        xx, xy, xz = memory[row, p], memory[row + 1, p], memory[row + 2, p]
        yy, yz, zz = memory[row + 3, p], memory[row + 4, p], memory[row + 5, p]
        return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)

    return load


@functools.cache
def carry_strain(real: type) -> wp.Function:
    """carry(X, M) -> (I + M)(I + X)(I + M)^T - I."""
    mat33 = matrix(real)

    @wp.func(name=f"carry_{real.__name__}")
    def carry(X: mat33, M: mat33):
        N = M + M * X
        return X + N + wp.transpose(N) + N * wp.transpose(M)

    return carry


@functools.cache
def carried_strain(real: type) -> wp.Function:
    """carried(p, row, M, memory) -> X_trial: the strain in six rows of column p, carried by I + M."""
    mat33 = matrix(real)
    load, carry_ = load_strain(real), carry_strain(real)

    @wp.func(name=f"carried_strain_{real.__name__}")
    def carried(p: int, row: int, M: mat33, memory: wp.array2d(dtype=real)):
        return carry_(load(p, row, memory), M)

    return carried


@functools.cache
def store_strain(real: type) -> wp.Function:
    """store(p, row, X, memory_next): the upper triangle of X, row by row, into six rows of column p."""
    mat33 = matrix(real)

    @wp.func(name=f"store_strain_{real.__name__}")
    def store(p: int, row: int, X: mat33, memory_next: wp.array2d(dtype=real)):
        memory_next[row, p] = X[0, 0]
        memory_next[row + 1, p] = X[0, 1]
        memory_next[row + 2, p] = X[0, 2]
        memory_next[row + 3, p] = X[1, 1]
        memory_next[row + 4, p] = X[1, 2]
        memory_next[row + 5, p] = X[2, 2]

    return without_replay(store)


def principal_log_strain(memory: Float[Tensor, "6 n"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Stored strain -> (principal values of dev ln V, ln J)."""
    X = memory[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3)
    x = torch.stack(principal_values(X), 1)
    # below the floor of the stress along the tangent, as there: finite where round-off makes b < 0
    log_stretch = torch.where(1 + x > FLOOR, torch.log1p(x.clamp(min=FLOOR - 1)), math.log(FLOOR) + (1 + x) / FLOOR - 1)
    log_stretch = log_stretch / 2
    return log_stretch - log_stretch.mean(1, keepdim=True), log_stretch.sum(1)


def hencky_energy(mu: Tensor, K: Tensor, memory: Float[Tensor, "6 n"]) -> Float[Tensor, " n"]:
    """mu |dev eps|^2 + K/2 (tr eps)^2 [J/m^3] of the stored strain."""
    dev, log_J = principal_log_strain(memory)
    return mu * (dev**2).sum(1) + K / 2 * log_J**2
