"""A test machine without a grid: the same constitutive functions under prescribed histories of deformation.

One row of the table is one step of the model, F_next = (I + dt L) F exactly. Stresses are Kirchhoff, tau = J sigma
[Pa]; the nominal stress of a tension test is tau_11 / stretch. Many samples are run at once where the table has a
column for each, or the parameters are one number per sample. Everything is differentiable with respect to the
parameters, at a cost that grows with the rows of the table.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.materials.material_points import advance
from physics3d.materials.parameters import Values


def prescribed(
    material: AbstractMaterial, values: Values, time: Float[Tensor, " t"], deformation: Float[Tensor, "rows *n 3 3"]
) -> Float[Tensor, "rows *m 3 3"]:
    """Stress [Pa] along a path F(t) that starts at F = I, in the dtype of `deformation`. time [s] increases.

    Raises ValueError if the table does not start at rest, time does not increase, or a parameter is out of range.
    """
    _check_table(time, deformation, torch.eye(3))
    one_sample = deformation.ndim == 3
    # differences in float64: what float32 can hold of a small increment is in L, not in F
    F = (deformation[:, None] if one_sample else deformation).double()
    samples = _Samples(material, values, F.shape[1], deformation.dtype)
    M = torch.linalg.solve(F[:-1], F[1:] - F[:-1], left=False).to(deformation.dtype).expand(-1, samples.count, 3, 3)
    stress = [samples.stress()]
    for dt, M_step in zip(time.diff().tolist(), M, strict=True):
        stress.append(samples.step(dt, M_step))
    return _as_given(torch.stack(stress), one_sample)


def simple_shear(
    material: AbstractMaterial, values: Values, time: Float[Tensor, " t"], shear: Float[Tensor, "rows *n"]
) -> Float[Tensor, "rows *m 3 3"]:
    """Stress [Pa] under x = X + shear(t) Y. Errors as in `prescribed`."""
    F = torch.eye(3, dtype=shear.dtype).expand(*shear.shape, 3, 3).clone()
    F[..., 0, 1] = shear
    return prescribed(material, values, time, F)


def uniaxial(
    material: AbstractMaterial, values: Values, time: Float[Tensor, " t"], stretch: Float[Tensor, "rows *n"]
) -> tuple[Float[Tensor, "rows *m"], Float[Tensor, "rows *m"]]:
    """Tension or compression with traction-free sides: (tau_11 [Pa], lateral stretch) in the dtype of `stretch`.

    Raises ValueError as `prescribed`, and RuntimeError when no lateral stretch frees the sides from traction.
    """
    _check_table(time, stretch, torch.ones(()))
    one_sample = stretch.ndim == 1
    table = (stretch[:, None] if one_sample else stretch).double()
    samples = _Samples(material, values, table.shape[1], stretch.dtype)
    stress, lateral = [samples.stress()[:, 0, 0]], [torch.ones(samples.count, dtype=stretch.dtype)]
    growth = (table.diff(dim=0) / table[:-1]).to(stretch.dtype).expand(-1, samples.count)
    side_growth = torch.zeros(samples.count, dtype=stretch.dtype)
    for dt, axial in zip(time.diff().tolist(), growth, strict=True):
        side_growth, slope = samples.free_sides(dt, axial, side_growth)
        # the root does not move, but gets its exact derivative: that of a Newton step
        side = samples.trial(dt, _diagonal(axial, side_growth))[1][:, 1, 1]
        m = side_growth - (side - side.detach()) / slope
        stress.append(samples.step(dt, _diagonal(axial, m))[:, 0, 0])
        lateral.append(lateral[-1] * (1 + m))
    return _as_given(torch.stack(stress), one_sample), _as_given(torch.stack(lateral), one_sample)


class _Samples:
    """Material points and their history."""

    def __init__(self, material: AbstractMaterial, values: Values, columns: int, dtype: torch.dtype) -> None:
        self.material = material
        self.coefficients = material.coefficients({name: torch.as_tensor(v) for name, v in values.items()}).to(dtype)
        self.count = max(columns, self.coefficients.shape[1])
        self.H = torch.zeros((self.count, 3, 3), dtype=dtype)
        self.memory = material.initial_memory(self.count, dtype)

    def trial(self, dt: float, M: Float[Tensor, "n 3 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """(H, tau, memory) after the increment I + M over dt [s]."""
        return self._trial(dt, M, self.H, self.coefficients, self.memory)

    def step(self, dt: float, M: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
        """Go on by the increment; the stress there."""
        self.H, tau, self.memory = self.trial(dt, M)
        return tau

    def stress(self) -> Float[Tensor, "n 3 3"]:
        """Of the present state."""
        return self.trial(0.0, torch.zeros_like(self.H))[1]

    def free_sides(
        self, dt: float, axial: Float[Tensor, " n"], guess: Float[Tensor, " n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """(lateral growth m that leaves no traction on the sides, slope d tau_22/dm), both without a graph: Newton's
        method within a bracket, for all samples at once. Raises RuntimeError where there is none."""
        H, coefficients, memory = self.H.detach(), self.coefficients.detach(), self.memory.detach()
        scale = self.material.wave_modulus(coefficients).expand(self.count)
        rounding, loose = torch.finfo(guess.dtype).eps, 1e-12 if guess.dtype == torch.float64 else 3e-7
        # the traction rises in between
        lower, upper, m = torch.full_like(guess, -0.9), torch.full_like(guess, 2.0), guess.detach()
        for tried in range(100):
            with torch.enable_grad():
                m = m.requires_grad_()
                side = self._trial(dt, _diagonal(axial, m), H, coefficients, memory)[1][:, 1, 1]
                slope = torch.autograd.grad(side.sum(), m)[0]
            m, side = m.detach(), side.detach()
            newton = m - side / slope
            # as near as increments of strain are known, or as rounding of the parts of the stress lets it come
            near = (newton - m).abs() <= rounding * torch.maximum(m.abs(), axial.abs())
            near |= side.abs() <= (loose if tried >= 12 else 1e-12) * scale
            open_ = ~(near & (slope > 0))
            if not bool(open_.any()):
                return m, slope
            lower, upper = torch.where(side < 0, m, lower), torch.where(side < 0, upper, m)
            inside = (slope > 0) & (newton > lower) & (newton < upper)
            m = torch.where(open_, torch.where(inside, newton, (lower + upper) / 2), m)
        worst = int((side.abs() / scale).argmax())
        raise RuntimeError(
            f"at a stretch of {axial[worst].item() + 1:g} in one step the sides still carry {side[worst].item():g} Pa; "
            "take smaller steps, or a material with a bulk stiffness"
        )

    def _trial(self, dt: float, M: Tensor, H: Tensor, coefficients: Tensor, memory: Tensor) -> tuple[Tensor, ...]:
        return advance(self.material, dt, M / dt if dt > 0 else M, H, coefficients, memory)


def _diagonal(axial: Float[Tensor, " n"], side: Float[Tensor, " n"]) -> Float[Tensor, "n 3 3"]:
    return torch.diag_embed(torch.stack([axial, side, side], 1))


def _as_given(rows: Tensor, one_sample: bool) -> Tensor:
    """[t, n, ...] -> [t, ...] if the table had no column per sample, and the parameters had none either."""
    return rows[:, 0] if one_sample and rows.shape[1] == 1 else rows


def _check_table(time: Tensor, table: Tensor, rest: Tensor) -> None:
    if len(time) != len(table):
        raise ValueError(f"time has {len(time)} rows, the deformation table {len(table)}; they must agree")
    if not bool((time.diff() > 0).all()):
        raise ValueError("time does not increase from row to row; sort the table and drop repeated rows")
    if not bool(torch.isfinite(table).all()) or not bool((table[0] == rest.to(table.dtype)).all()):
        raise ValueError(f"the table starts at {table[0].tolist()}; it must be finite and start undeformed")
