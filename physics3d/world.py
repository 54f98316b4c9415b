"""What a scene says of its physics, and what learning found out about it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.boundaries.base import AbstractBoundary, Vector
from physics3d.checks import Corners, Count, Factor, Length, MayBeInfinite, NotNegative, Positive, require_fields
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import check_old_names

Bytes = Annotated[int, Ge(0)]
Parameter = Annotated[float, MayBeInfinite()]  # its range is that of the material
PRECISIONS = {"float32": torch.float32, "float64": torch.float64}


@dataclass(frozen=True, kw_only=True)
class Interval:
    """What is thought of one learned number after the clip: x is normal, where x is the logarithm of the number in its
    SI unit; of Poisson's ratio that of K/mu; of a velocity the velocity itself [m/s]."""

    mean: float  # of x
    deviation: float  # standard deviation of x
    before: float  # the same before the clip
    low: float  # the number is below with a probability of 5 % [its SI unit]
    high: float  # and above likewise
    determined: bool  # whether the clip has at least halved the deviation

    def holding(self, learned: float) -> "Interval":
        """Wide enough for what was learned: what a clip hardly tells is pulled to what was thought before, in the mean
        farther than the fit of least loss, which moves the body and must not be said to be improbable."""
        return replace(self, low=min(self.low, learned), high=max(self.high, learned))


@dataclass(frozen=True, kw_only=True)
class Estimate(AbstractArtifact):
    """Material and initial velocity, as given or as learned."""

    parameters: dict[str, Tensor]  # physical name -> scalar or one number per particle [p], SI
    velocity: Float[Tensor, "3"]  # of the body at the start [m/s]
    density: float | None = None  # at rest [kg/m^3]; None: as given
    history: dict[str, list[float]] = field(default_factory=dict)  # curves of the learning
    intervals: dict[str, Interval] = field(default_factory=dict)  # of what was learned, by name; velocity_x, ... too
    models: dict[str, float] = field(default_factory=dict)  # simpler ones -> ln of the odds for this one against them
    film_next: dict[str, float] = field(default_factory=dict)  # recordings -> ln of the odds that they should add

    @property
    def numbers(self) -> dict[str, float]:
        """One per parameter, of a field the mean over particles, and the density [kg/m^3] where it was learned."""
        values = {name: float(torch.as_tensor(value).double().mean()) for name, value in self.parameters.items()}
        return values if self.density is None else values | {"density": self.density}

    def check(self) -> None:
        check_old_names(self.parameters)
        for name, value in self.parameters.items():
            require_finite(f"parameter {name}", value)
        require_finite("velocity", self.velocity)
        if self.density is not None and not (math.isfinite(self.density) and self.density > 0):
            raise ValueError(f"density is {self.density} kg/m^3; it must be above 0, or None where it is as given")
        for name, found in self.intervals.items():
            if not (math.isfinite(found.mean) and found.deviation >= 0 and found.low <= found.high):
                raise ValueError(f"interval of {name} is {found}; it needs a mean, and low <= high")


@dataclass(frozen=True, kw_only=True)
class World:
    """The physics of a scene: material, ground, gravity, and how finely they are resolved."""

    material: AbstractMaterial
    density: Positive  # at rest [kg/m^3]
    start: dict[str, Parameter]  # where the material's parameters start, SI
    dx: Length  # grid spacing [m]
    gravity: Vector = (0.0, 0.0, -9.81)  # [m/s^2]
    velocity: Vector = (0.0, 0.0, 0.0)  # of the body at the start [m/s]; learning may refine it
    boundaries: tuple[AbstractBoundary, ...] = ()
    damping: NotNegative = 0.0  # rate at which all velocities decay [1/s]
    # modes: held or free bodies that touch nothing; auto: modes where they serve, else the grid
    solver: Literal["grid", "modes", "auto"] = "grid"
    cfl: Factor = 0.5  # cells a wave crosses in one automatic substep
    dt: Positive | None = None  # substep [s]; None: from the speed of sound and of the particles
    # explicit: follows every wave; implicit: damps those faster than dt; auto: the cheaper one
    scheme: Literal["auto", "explicit", "implicit"] = "auto"
    max_substeps: Count = 200_000  # in one frame
    precision: Literal["float32", "float64"] = "float32"
    checkpoint_bytes: Bytes | None = None  # for the states that a gradient keeps; less costs time. None: all of them
    lower: Vector | None = None  # corners of the simulated region [m]; None: around the body, with room to move
    upper: Vector | None = None

    RULES = (Corners("lower", "upper", apart="dx"),)

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "world")
        self.material.check_parameters({name: torch.tensor(value) for name, value in self.start.items()})
        for boundary in self.boundaries:
            boundary.check()

    @property
    def dtype(self) -> torch.dtype:
        return PRECISIONS[self.precision]

    def starting_at(self, parameters: Mapping[str, Tensor]) -> "World":
        """With these for a start, those that vary over the body by their means: what is made for a material, as modes
        and what holds them are, is then made for this one."""
        start = {name: float(torch.as_tensor(parameters[name]).double().mean()) for name in self.start}
        return replace(self, start=start)

    def weighed(self, found: Estimate) -> "World":
        """With the density that was learned, where one was."""
        return self if found.density is None else replace(self, density=found.density)

    def estimate(self) -> Estimate:
        """The initial guess: the start values and velocity. Raises ValueError as `check` does."""
        self.check()
        parameters = {name: torch.tensor(float(value), dtype=torch.float64) for name, value in self.start.items()}
        return Estimate(parameters=parameters, velocity=torch.tensor(self.velocity, dtype=torch.float32))
