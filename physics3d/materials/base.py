"""What a constitutive model is to the solver: data, a parameter map and one Warp function.

A model receives the velocity gradient L [1/s] of one particle over one substep and answers with the new elastic
deformation and the Kirchhoff stress tau = J sigma [Pa]. Deformation is stored as its deviation from the identity,
H = F - I, so that float32 keeps small strains. The solver never asks which model it has.
"""

import abc
import functools
import math
import re
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.checks import PoissonsRatio, Positive, complaint
from physics3d.materials import spectral

ELASTIC = {"youngs_modulus": Positive, "poissons_ratio": PoissonsRatio}
Values = dict[str, Tensor]  # physical name -> scalar or one number per particle, SI


@dataclass(frozen=True, kw_only=True)
class AbstractMaterial(abc.ABC):
    """A constitutive model. Its fields choose the model; its parameters are the numbers that one learns."""

    RANGES: ClassVar[dict[str, Any]] = {}  # parameter -> what it may be, SI; of further branches (_2, _3) likewise

    @property
    @abc.abstractmethod
    def parameters(self) -> tuple[str, ...]:
        """Names of the physical parameters, SI."""

    @property
    @abc.abstractmethod
    def example(self) -> dict[str, float]:
        """Parameters of an everyday sample: where one may start, and what the tests check the laws on."""

    @property
    def memory_rows(self) -> int:
        """Internal variables per particle."""
        return 0

    def per_part(self, values: Values, part: Int[Tensor, " n"], parts: tuple[str, ...]) -> Values:
        """`values` with what the material has to know of the body: nothing, if all parts have the same.

        `part` [n] are indices of the names `parts`. Raises ValueError if a part has no material, or no part a name.
        """
        return values

    def check_parameters(self, values: Values) -> None:
        """Raise ValueError naming the parameter, its value and the remedy."""
        check_names(values, self.parameters)
        for name in self.parameters:
            check_range(values[name], self.RANGES[re.sub(r"_[23]$", "", name)], name)

    @abc.abstractmethod
    def coefficients(self, values: Values) -> Float[Tensor, "k n"]:
        """Checked physical parameters -> rows the Warp function reads; differentiable. n = 1 if all are scalars."""

    @abc.abstractmethod
    def wave_modulus(self, coefficients: Float[Tensor, "k n"]) -> Float[Tensor, " n"]:
        """lam + 2 mu at rest, all branches stiff [Pa]: rho c^2 of the fastest wave."""

    def stiffening(self, coefficients: Float[Tensor, "k n"], memory: Float[Tensor, "m n"]) -> Float[Tensor, " n"]:
        """What `wave_modulus` has to be multiplied by in the present state, where flow hardens the springs."""
        return torch.ones_like(coefficients[0])

    def viscosity(self, coefficients: Float[Tensor, "k n"], L: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
        """Shear viscosity [Pa s] acting on the velocity gradient L [1/s] without a spring in series: an explicit step
        needs dt < rho dx^2 / (6 eta). None by default: a dash-pot behind a spring sets no limit of its own."""
        return torch.zeros_like(L[:, 0, 0])

    @abc.abstractmethod
    def energy(
        self, coefficients: Float[Tensor, "k n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "m n"]
    ) -> Float[Tensor, " n"]:
        """Stored elastic energy per volume of the rest state [J/m^3]; its derivative d psi/dF F^T is the stress."""

    def initial_memory(self, n: int, dtype: torch.dtype) -> Float[Tensor, "m n"]:
        """Internal variables of the undeformed state (deviations from it, hence zeros)."""
        return torch.zeros((self.memory_rows, n), dtype=dtype)

    @abc.abstractmethod
    def advance(self, real: type) -> wp.Function:
        """The Warp function for `real` = wp.float32 or wp.float64, the same object at every call:

            advance(p: int, dt: real, L: mat33, H: mat33, coefficients: array2d[k, n], memory: array2d[m, n],
                    memory_next: array2d[m, n]) -> (H_next: mat33, tau: mat33)

        It reads column p of coefficients and memory, writes all rows of column p of memory_next, and has an exact
        adjoint. dt = 0 and L = 0 give the rate-independent stress of the present state. The adjoint of a kernel does
        not evaluate it again (`spectral.without_replay`), so a kernel does nothing with the two results but store them.
        """


@functools.cache
def carried_strain(real: type) -> wp.Function:
    """carried(p, row, M, memory) -> X_trial: the elastic strain X = b - I stored in six rows of column p, carried by
    the increment I + M: b_trial = (I + M) b (I + M)^T."""
    mat33 = spectral.matrix_type(real)

    @wp.func(name=f"carried_strain_{real.__name__}")
    def carried(p: int, row: int, M: mat33, memory: wp.array2d(dtype=real)):
        xx, xy, xz = memory[row, p], memory[row + 1, p], memory[row + 2, p]
        yy, yz, zz = memory[row + 3, p], memory[row + 4, p], memory[row + 5, p]
        X = mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)
        N = M + M * X
        return X + N + wp.transpose(N) + N * wp.transpose(M)

    return carried


@functools.cache
def store_strain(real: type) -> wp.Function:
    """store(p, row, X, memory_next): the upper triangle of X, row by row, into six rows of column p."""
    mat33 = spectral.matrix_type(real)

    @wp.func(name=f"store_strain_{real.__name__}")
    def store(p: int, row: int, X: mat33, memory_next: wp.array2d(dtype=real)):
        memory_next[row, p] = X[0, 0]
        memory_next[row + 1, p] = X[0, 1]
        memory_next[row + 2, p] = X[0, 2]
        memory_next[row + 3, p] = X[1, 1]
        memory_next[row + 4, p] = X[1, 2]
        memory_next[row + 5, p] = X[2, 2]

    return spectral.without_replay(store)


def log_strain(memory: Float[Tensor, "6 n"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Stored strain -> (principal values of dev ln V, ln J)."""
    X = memory[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3)
    x = torch.stack(spectral.principal_values(X), 1)
    # below the floor of the stress along the tangent, as there: finite where round-off makes b < 0
    floor = spectral._FLOOR
    log_stretch = torch.where(1 + x > floor, torch.log1p(x.clamp(min=floor - 1)), math.log(floor) + (1 + x) / floor - 1)
    log_stretch = log_stretch / 2
    return log_stretch - log_stretch.mean(1, keepdim=True), log_stretch.sum(1)


def hencky_energy(mu: Tensor, K: Tensor, memory: Float[Tensor, "6 n"]) -> Float[Tensor, " n"]:
    """mu |dev eps|^2 + K/2 (tr eps)^2 [J/m^3] of the stored strain."""
    dev, log_J = log_strain(memory)
    return mu * (dev**2).sum(1) + K / 2 * log_J**2


def check_names(values: Values, parameters: tuple[str, ...]) -> None:
    """Raise ValueError unless `values` has exactly the names in `parameters`."""
    missing, unknown = set(parameters) - set(values), set(values) - set(parameters)
    if missing or unknown:
        need = ", ".join(parameters)
        raise ValueError(f"material parameters: missing {sorted(missing)}, unknown {sorted(unknown)}; needed: {need}")


def check_range(value: Tensor, allowed: Any, name: str) -> None:
    """Raise ValueError unless every number in `value` is what the hint `allowed` says; NaN never is."""
    value = torch.as_tensor(value).detach()
    for extreme in (value.amin(), value.amax()) if value.numel() else ():
        wrong = complaint(allowed, float(extreme), name)
        if wrong:
            raise ValueError(wrong)


def lame(youngs_modulus: Tensor, poissons_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """(mu, lam) [Pa] of Young's modulus [Pa] and Poisson's ratio."""
    mu = youngs_modulus / (2 * (1 + poissons_ratio))
    lam = youngs_modulus * poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))
    return mu, lam


def rows(*values: Tensor) -> Float[Tensor, "k n"]:
    """Stack scalars and per-particle values as rows of one matrix."""
    return torch.stack(torch.broadcast_tensors(*(torch.atleast_1d(torch.as_tensor(value)) for value in values)))


def coefficient_rows(material: AbstractMaterial) -> int:
    """The number of rows of its coefficients."""
    return len(material.coefficients({name: torch.tensor(value) for name, value in material.example.items()}))
