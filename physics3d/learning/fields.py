"""What is learned: a short vector theta of dimensionless offsets, zero at the start, from which all physical values
follow.

    p = p_0 exp(theta)              moduli [Pa], times [s], anything positive
    K/mu = (K/mu)_0 exp(theta)      Poisson's ratio, through K/mu = 2 (1 + nu) / (3 (1 - 2 nu)): it stays in (-1, 0.5)
    rho = rho_0 exp(theta)          density, where a force known in newtons tells it
    v = v_0 + c theta               initial velocity, c [m/s] a natural speed of the scene

A step of 0.1 is a change of ten per cent, whatever the unit, and all components are comparable: no scaling of
gradients by hand, and a Gaussian prior on theta is a log-normal one on the material. Tied parameters share one
component of theta.
"""

import math
import re
from dataclasses import dataclass, field
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.parameters import check_old_names

AXES = ("velocity_x", "velocity_y", "velocity_z")
DENSITY = "density"
# how names of what scales with the stiffness end
ELASTIC = ("modulus", "coefficient")
STIFF = (*ELASTIC, "stress", "viscosity", "consistency")


class AbstractField(Protocol):
    """What theta means: one number per parameter (GlobalField), or more (`stiffness_field.py`)."""

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The parameters behind each of the first components of theta."""

    @property
    def names(self) -> tuple[str, ...]:
        """One name per component of theta."""

    @property
    def velocity_scale(self) -> float | None:
        """Unit of the initial velocity [m/s]; None: it is not learned."""

    @property
    def density(self) -> float | None:
        """As given [kg/m^3]; None: it is not learned."""

    def zero(self) -> Float[Tensor, " k"]:
        """theta at the start."""

    def bound(self, theta: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        """The nearest theta that may be."""

    def parameters(self, theta: Float[Tensor, " k"]) -> dict[str, Tensor]:
        """All physical parameters, scalars or one number per particle [p], differentiable in theta."""

    def velocity(self, theta: Float[Tensor, " k"]) -> Float[Tensor, " 3"]:
        """Initial velocity [m/s], differentiable in theta."""

    def heavier(self, theta: Float[Tensor, " k"]) -> float:
        """ln of the density over the one given; no derivative goes through it."""


@dataclass(frozen=True, kw_only=True)
class GlobalField:
    """One number per parameter for the whole body."""

    start: dict[str, Tensor]  # physical name -> scalar or [p], SI; everything the material needs, learned or not
    learn: tuple[str, ...]  # names that may change
    ties: tuple[tuple[str, ...], ...] = ()  # groups that share one factor; their members are then learned too
    span: float = 100.0  # a value stays within start/span .. start*span
    start_velocity: Tensor = field(default_factory=lambda: torch.zeros(3))  # [3] [m/s]
    velocity_scale: float | None = None  # c [m/s]; None: the velocity is not learned
    density: float | None = None  # rho_0 [kg/m^3]; None: it is not learned

    def __post_init__(self):
        known = ", ".join(self.start)
        named = (*self.learn, *(name for tie in self.ties for name in tie))
        check_old_names(named)
        for name in named:
            if name not in self.start:
                raise ValueError(
                    f"learn.learn or learn.ties names {name!r}; the parameters of this material are {known}"
                )
        groups = self.groups
        members = [name for group in groups for name in group]
        if len(set(members)) != len(members):
            raise ValueError(
                f"learn.learn = {self.learn} and learn.ties = {self.ties} name a parameter twice; name each once"
            )
        if not groups and self.velocity_scale is None:
            raise ValueError(f"nothing to learn: set learn.learn to some of {known}, or learn.learn_velocity")
        if not self.span > 1:
            raise ValueError(f"learn.span is {self.span:g}; it must be above 1, e.g. 100")
        for name in members:
            if not is_poissons_ratio(name) and not bool((torch.as_tensor(self.start[name]) > 0).all()):
                raise ValueError(
                    f"{name} starts at {float(torch.as_tensor(self.start[name]).min()):g} and is learned as a "
                    "logarithm; start it above 0 or take it out of learn.learn"
                )
        if any(len(group) > 1 and any(map(is_poissons_ratio, group)) for group in groups):
            raise ValueError("learn.ties holds poissons_ratio; it has no scale to share, learn it by itself")

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """The parameters behind each material component of theta."""
        tied = {name: tie for tie in self.ties for name in tie}
        return tuple(dict.fromkeys([*(tied.get(name, (name,)) for name in self.learn), *self.ties]))

    @property
    def names(self) -> tuple[str, ...]:
        """One name per component of theta: the material's, tied ones joined by +, the density, the velocity."""
        names = tuple("+".join(group) for group in self.groups)
        names += () if self.density is None else (DENSITY,)
        return names + (AXES if self.velocity_scale is not None else ())

    def zero(self) -> Float[Tensor, " k"]:
        """theta at the start."""
        return torch.zeros(len(self.names), dtype=torch.float64)

    def bound(self, theta: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        """The nearest theta within the span; velocities are not bounded."""
        limit, count = math.log(self.span), len(self.groups) + (self.density is not None)
        return torch.cat([theta[:count].clamp(-limit, limit), theta[count:]])

    def parameters(self, theta: Float[Tensor, " k"]) -> dict[str, Tensor]:
        """All physical parameters, differentiable in theta."""
        values = {name: torch.as_tensor(value, dtype=theta.dtype) for name, value in self.start.items()}
        for offset, group in zip(theta, self.groups):
            for name in group:
                values[name] = (
                    poissons_ratio(values[name], offset) if is_poissons_ratio(name) else values[name] * offset.exp()
                )
        return values

    def velocity(self, theta: Float[Tensor, " k"]) -> Float[Tensor, " 3"]:
        """Initial velocity [m/s], differentiable in theta."""
        start = self.start_velocity.to(theta)
        return start if self.velocity_scale is None else start + self.velocity_scale * theta[-3:]

    def heavier(self, theta: Float[Tensor, " k"]) -> float:
        """ln of the density over the one given; no derivative goes through it."""
        return 0.0 if self.density is None else float(theta.detach()[len(self.groups)])


def is_stiff(name: str) -> bool:
    """Whether a parameter scales with the stiffness: it has the unit of a stress, or of a stress times a time."""
    return re.sub(r"_[23]$", "", name.split("+")[0]).endswith(STIFF)


def is_elastic(name: str) -> bool:
    """Whether a parameter is one of those that make a body k times as stiff where all of them are k times as large."""
    return re.sub(r"_[23]$", "", name.split("+")[0]).endswith(ELASTIC)


def is_poissons_ratio(name: str) -> bool:
    """Of the body, or of a part of it (part.poissons_ratio)."""
    return name.rpartition(".")[2] == "poissons_ratio"


def poissons_ratio(start: Tensor, offset: Tensor) -> Tensor:
    """Poisson's ratio whose K/mu is exp(offset) times that of `start`."""
    ratio = 2 * (1 + start) / (3 * (1 - 2 * start)) * offset.exp()
    return (3 * ratio - 2) / (2 * (3 * ratio + 1))


def physical(field: AbstractField, theta: Tensor) -> dict[str, float]:
    """The learned parameters in SI units."""
    values = field.parameters(theta)
    learned = {name: float(values[name].mean()) for group in field.groups for name in group}
    if field.density is not None:
        learned[DENSITY] = field.density * math.exp(field.heavier(theta))
    if field.velocity_scale is not None:
        learned |= dict(zip(("velocity_x", "velocity_y", "velocity_z"), field.velocity(theta).tolist()))
    return learned
