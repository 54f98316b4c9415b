"""A test machine without a grid: the same constitutive functions under a prescribed history of deformation.

One row of the table is one step of the model, F_next = (I + dt L) F exactly. Stresses are Kirchhoff, tau = J sigma
[Pa]; the nominal stress of a tension test is tau_11 / stretch. Everything is differentiable with respect to the
parameters.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.material_points import advance
from physics3d.materials.parameters import Values


def prescribed(
    material: AbstractMaterial, values: Values, time: Float[Tensor, " t"], deformation: Float[Tensor, "t 3 3"]
) -> Float[Tensor, "t 3 3"]:
    """Stress [Pa] along a path F(t) that starts at F = I, in the dtype of `deformation`. time [s] increases.

    Raises ValueError if the table does not start at rest, time does not increase, or a parameter is out of range.
    """
    _check_table(time, deformation, torch.eye(3))
    sample = _Sample(material, values, deformation.dtype)
    stress = [sample.stress()]
    # differences in float64: what float32 can hold of a small increment is in L, not in F
    F = deformation.double()
    M = torch.linalg.solve(F[:-1], F[1:] - F[:-1], left=False)
    for dt, M_step in zip(time.diff().tolist(), M.to(deformation.dtype), strict=True):
        stress.append(sample.step(dt, M_step))
    return torch.stack(stress)


def simple_shear(
    material: AbstractMaterial, values: Values, time: Float[Tensor, " t"], shear: Float[Tensor, " t"]
) -> Float[Tensor, "t 3 3"]:
    """Stress [Pa] under x = X + shear(t) Y. Errors as in `prescribed`."""
    F = torch.eye(3, dtype=shear.dtype).repeat(len(shear), 1, 1)
    F[:, 0, 1] = shear
    return prescribed(material, values, time, F)


def uniaxial(
    material: AbstractMaterial, values: Values, time: Float[Tensor, " t"], stretch: Float[Tensor, " t"]
) -> tuple[Float[Tensor, " t"], Float[Tensor, " t"]]:
    """Tension or compression with traction-free sides: (tau_11 [Pa], lateral stretch) in the dtype of `stretch`.

    Raises ValueError as `prescribed`, and RuntimeError when no lateral stretch frees the sides from traction.
    """
    _check_table(time, stretch, torch.ones(()))
    sample = _Sample(material, values, stretch.dtype)
    stress, lateral = [sample.stress()[0, 0]], [torch.ones((), dtype=stretch.dtype)]
    scale = float(material.wave_modulus(sample.coefficients).max().detach())
    tolerance = 1e-12 if stretch.dtype == torch.float64 else 3e-7
    growth = (stretch.double().diff() / stretch[:-1].double()).to(stretch.dtype)
    guess = torch.zeros((), dtype=stretch.dtype)
    for dt, axial in zip(time.diff().tolist(), growth, strict=True):
        lower, upper = -0.9, 2.0  # of the lateral growth; the traction rises in between
        for _ in range(100):
            m = guess.detach().requires_grad_()
            with torch.enable_grad():
                side = sample.trial(dt, _diagonal(axial, m))[1][0, 1, 1]
                slope = torch.autograd.grad(side, m)[0]
            if abs(side.item()) <= tolerance * scale and slope.item() > 0:
                break
            if side.item() < 0:
                lower = m.item()
            else:
                upper = m.item()
            newton = m.item() - side.item() / slope.item() if slope.item() > 0 else math.inf
            guess = guess.new_tensor(newton if lower < newton < upper else (lower + upper) / 2)
        else:
            raise RuntimeError(
                f"at stretch {axial.item() + 1:g} of one step the sides still carry {side.item():g} Pa; "
                "take smaller steps, or a material with a bulk stiffness"
            )
        # the root does not move, but gets its exact derivative: that of a Newton step
        guess = guess.detach()
        side = sample.trial(dt, _diagonal(axial, guess))[1][0, 1, 1]
        m = guess - (side - side.detach()) / slope.detach()
        stress.append(sample.step(dt, _diagonal(axial, m))[0, 0])
        lateral.append(lateral[-1] * (1 + m))
    return torch.stack(stress), torch.stack(lateral)


class _Sample:
    """One material point and its history."""

    def __init__(self, material: AbstractMaterial, values: Values, dtype: torch.dtype) -> None:
        self.material = material
        self.coefficients = material.coefficients({name: torch.as_tensor(v) for name, v in values.items()}).to(dtype)
        self.H = torch.zeros((1, 3, 3), dtype=dtype)
        self.memory = material.initial_memory(1, dtype)

    def trial(self, dt: float, M: Float[Tensor, "3 3"]) -> tuple[Tensor, Tensor, Tensor]:
        L = M[None] / dt if dt > 0 else M[None]
        return advance(self.material, dt, L, self.H, self.coefficients, self.memory)

    def step(self, dt: float, M: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
        self.H, tau, self.memory = self.trial(dt, M)
        return tau[0]

    def stress(self) -> Float[Tensor, "3 3"]:
        return self.trial(0.0, torch.zeros_like(self.H[0]))[1][0]


def _diagonal(axial: Tensor, side: Tensor) -> Float[Tensor, "3 3"]:
    return torch.diag(torch.stack([axial, side, side]))


def _check_table(time: Tensor, table: Tensor, rest: Tensor) -> None:
    if len(time) != len(table):
        raise ValueError(f"time has {len(time)} rows, the deformation table {len(table)}; they must agree")
    if not bool((time.diff() > 0).all()):
        raise ValueError("time does not increase from row to row; sort the table and drop repeated rows")
    if not bool(torch.isfinite(table).all()) or not torch.equal(table[0], rest.to(table.dtype)):
        raise ValueError(f"the table starts at {table[0].tolist()}; it must be finite and start undeformed")
