"""What a constitutive model is to the solver: data, a parameter map and one Warp function.

A model receives the velocity gradient L [1/s] of one particle over one substep and answers with the new elastic
deformation and the Kirchhoff stress tau = J sigma [Pa]. Deformation is stored as its deviation from the identity,
H = F - I, so that float32 keeps small strains. The solver never asks which model it has.
"""

import abc
import re
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.materials.parameters import Values, check_names, check_range


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
    def recovers(self) -> bool:
        """Whether a body of it comes back to its shape, whatever was done to it: no plastic strain, no flow."""
        return False

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
        not evaluate it again (`tensors.replay`), so a kernel does nothing with the two results but store them.
        """


def coefficient_rows(material: AbstractMaterial) -> int:
    """The number of rows of its coefficients."""
    return len(material.coefficients({name: torch.tensor(value) for name, value in material.example.items()}))
