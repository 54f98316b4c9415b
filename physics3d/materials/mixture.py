"""Several materials in one scene: every part of the body has its own.

The parameters of a part are named part.parameter, e.g. stem.youngs_modulus. Which particle is of which part is one more
value per particle, "part", the 0-based index in the order of the materials; it comes with the body (`per_part`) and is
never learned. Equal models share one kernel branch; coefficients and memory are padded to the longest, and the last row
of the coefficients says which model a particle has.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.materials.base import AbstractMaterial, coefficient_rows
from physics3d.materials.parameters import Values, check_names
from physics3d.materials.tensors.replay import without_replay
from physics3d.warp_types import matrix

PART = "part"


@dataclass(frozen=True, kw_only=True)
class Mixture(AbstractMaterial):
    """Parameters: those of every material, each behind the name of its part and a dot.

    Raises ValueError if there is no material, a name holds a dot, or a mixture is in the mixture.
    """

    materials: Mapping[str, AbstractMaterial]  # name of the part -> its material

    def __post_init__(self) -> None:
        if not self.materials:
            raise ValueError("mixture.materials is empty; name at least one part and its material")
        for name, material in self.materials.items():
            if "." in name or isinstance(material, Mixture):
                raise ValueError(
                    f"mixture.materials has {name!r}: {material}; take a name without a dot, and no mixture"
                )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"{part}.{name}" for part, m in self.materials.items() for name in m.parameters)

    @property
    def example(self) -> dict[str, float]:
        return {f"{part}.{name}": x for part, m in self.materials.items() for name, x in m.example.items()}

    @property
    def recovers(self) -> bool:
        return all(m.recovers for m in self.materials.values())

    @property
    def memory_rows(self) -> int:
        return max(m.memory_rows for m in self.materials.values())

    @property
    def _kinds(self) -> tuple[AbstractMaterial, ...]:
        """The different models."""
        return tuple(dict.fromkeys(self.materials.values()))

    def per_part(self, values: Values, part: Int[Tensor, " n"], parts: tuple[str, ...]) -> Values:
        if set(parts) != set(self.materials):
            raise ValueError(
                f"the parts of the body are {sorted(parts)}, materials are given for {sorted(self.materials)}; give "
                "every part its material (the parts are those of segment.prompts)"
            )
        order = list(self.materials)
        index = torch.tensor([order.index(name) for name in parts], device=part.device)
        return values | {PART: index[part.long()]}

    def check_parameters(self, values: Values) -> None:
        """The part need not be there yet."""
        check_names({name: x for name, x in values.items() if name != PART}, self.parameters)
        for part, material in self.materials.items():
            try:
                material.check_parameters(self._of(part, values))
            except ValueError as error:
                raise ValueError(f"{part}.{error}") from error

    def _of(self, part: str, values: Values) -> Values:
        return {name: values[f"{part}.{name}"] for name in self.materials[part].parameters}

    def coefficients(self, values: Values) -> Float[Tensor, "k n"]:
        """Raises ValueError also if values[part] is missing or no index of a material."""
        self.check_parameters(values)
        if PART not in values:
            raise ValueError(
                "which particle is of which part is missing; give parameters['part'], one index a particle"
            )
        part = torch.atleast_1d(values[PART])
        wrong = ~torch.isin(part, torch.arange(len(self.materials), device=part.device).to(part))
        if bool(wrong.any()):
            raise ValueError(
                f"part is {part[wrong][0]:g}; it is an index of a material, 0..{len(self.materials) - 1}: "
                f"{', '.join(self.materials)}"
            )
        each = [m.coefficients(self._of(name, values)) for name, m in self.materials.items()]
        most = max(map(len, each))
        found = torch.zeros(())
        for i, (rows, material) in enumerate(zip(each, self.materials.values(), strict=True)):
            last = torch.full_like(rows[:1], self._kinds.index(material))
            padding = torch.zeros_like(rows[:1]).expand(most - len(rows), -1)
            found = torch.where(part == i, torch.cat([rows, padding, last]), found)
        return found

    def wave_modulus(self, coefficients: Float[Tensor, "k n"]) -> Float[Tensor, " n"]:
        return self._each(lambda m, c: m.wave_modulus(c), coefficients)

    def stiffening(self, coefficients: Float[Tensor, "k n"], memory: Float[Tensor, "m n"]) -> Float[Tensor, " n"]:
        return self._each(lambda m, c, q: m.stiffening(c, q[: m.memory_rows]), coefficients, memory)

    def viscosity(self, coefficients: Float[Tensor, "k n"], L: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
        return self._each(lambda m, c, l: m.viscosity(c, l.movedim(-1, 0)), coefficients, L.movedim(0, -1))

    def energy(
        self, coefficients: Float[Tensor, "k n"], H: Float[Tensor, "n 3 3"], memory: Float[Tensor, "m n"]
    ) -> Float[Tensor, " n"]:
        return self._each(
            lambda m, c, h, q: m.energy(c, h.movedim(-1, 0), q[: m.memory_rows]), coefficients, H.movedim(0, -1), memory
        )

    def _each(self, function: Callable[..., Tensor], coefficients: Tensor, *others: Tensor) -> Float[Tensor, " n"]:
        """function(material, its coefficients, ...) of the particles of every model; the last axis is the particle."""
        found = torch.zeros_like(coefficients[-1])
        for i, material in enumerate(self._kinds):
            at = torch.nonzero(coefficients[-1] == i)[:, 0]
            if len(at):
                own = coefficients[: coefficient_rows(material), at]
                found = found.index_put((at,), function(material, own, *(x[..., at] for x in others)))
        return found

    def advance(self, real: type) -> wp.Function:
        kinds, most = self._kinds, self.memory_rows
        function = kinds[-1].advance(real)
        rows = kinds[-1].memory_rows
        for number in range(len(kinds) - 2, -1, -1):
            kind = kinds[number]
            function = _either(number, kind.advance(real), kind.memory_rows, function, rows, most, real)
            rows = most
        return function


@functools.cache
def _either(
    number: int, own: wp.Function, own_rows: int, other: wp.Function, other_rows: int, most: int, real: type
) -> wp.Function:
    """`own` for particles of this number, `other` for the rest; memory beyond that of the model is left as it is.

    Models are chained, not listed: Warp's cache of kernels does not see a function behind a static index."""
    mat33 = matrix(real)

    @wp.func(name=f"{own.key}_or_{other.key}")
    def advance(
        p: int,
        dt: real,  # [s]
        L: mat33,  # velocity gradient [1/s]
        H: mat33,  # F - I
        coefficients: wp.array2d(dtype=real),  # of the particle's model, then its number
        memory: wp.array2d(dtype=real),
        memory_next: wp.array2d(dtype=real),
    ):
        if int(coefficients[coefficients.shape[0] - 1, p] + real(0.5)) == number:
            for row in range(own_rows, most):
                memory_next[row, p] = memory[row, p]
            H_own, tau_own = own(p, dt, L, H, coefficients, memory, memory_next)
            return H_own, tau_own
        for row in range(other_rows, most):
            memory_next[row, p] = memory[row, p]
        H_next, tau = other(p, dt, L, H, coefficients, memory, memory_next)
        return H_next, tau

    return without_replay(advance)
