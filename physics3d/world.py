"""What a scene says of its physics, and what learning found out about it."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.boundaries.base import AbstractBoundary, Vector
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.parameters import check_old_names

SOLVERS = ("auto", "grid", "modes")
SCHEMES = ("auto", "explicit", "implicit")
PRECISIONS = {"float32": torch.float32, "float64": torch.float64}


@dataclass(frozen=True, kw_only=True)
class Estimate(AbstractArtifact):
    """Material and initial velocity, as given or as learned."""

    parameters: dict[str, Tensor]  # physical name -> scalar or one number per particle [p], SI
    velocity: Float[Tensor, "3"]  # of the body at the start [m/s]
    history: dict[str, list[float]] = field(default_factory=dict)  # curves of the learning

    def check(self) -> None:
        check_old_names(self.parameters)
        for name, value in self.parameters.items():
            require_finite(f"parameter {name}", value)
        require_finite("velocity", self.velocity)


@dataclass(frozen=True, kw_only=True)
class World:
    """The physics of a scene: material, ground, gravity, and how finely they are resolved."""

    material: AbstractMaterial
    density: float  # at rest [kg/m^3]
    start: dict[str, float]  # where the material's parameters start, SI
    dx: float  # grid spacing [m]
    gravity: Vector = (0.0, 0.0, -9.81)  # [m/s^2]
    velocity: Vector = (0.0, 0.0, 0.0)  # of the body at the start [m/s]; learning may refine it
    boundaries: tuple[AbstractBoundary, ...] = ()
    damping: float = 0.0  # rate at which all velocities decay [1/s]
    solver: str = "auto"  # grid, modes (held or free bodies that touch nothing), or auto: modes where they serve
    cfl: float = 0.5  # cells a wave crosses in one automatic substep
    dt: float | None = None  # substep [s]; None: from the speed of sound and of the particles
    scheme: str = "auto"  # explicit: follows every wave; implicit: damps those faster than dt; auto: the cheaper one
    max_substeps: int = 200_000  # in one frame
    precision: str = "float32"
    checkpoint_bytes: int | None = None  # for the states that a gradient keeps; less costs time. None: all of them
    lower: Vector | None = None  # corners of the simulated region [m]; None: around the body, with room to move
    upper: Vector | None = None

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        for name in ("density", "dx"):
            _require(0 < getattr(self, name) < math.inf, name, getattr(self, name), "a number above 0")
        _require(0 < self.cfl <= 1, "cfl", self.cfl, "0 < cfl <= 1")
        _require(0 <= self.damping < math.inf, "damping", self.damping, "a rate >= 0 1/s")
        _require(self.dt is None or self.dt > 0, "dt", self.dt, "a time above 0 s, or None")
        _require(self.solver in SOLVERS, "solver", self.solver, f"one of {SOLVERS}")
        _require(self.scheme in SCHEMES, "scheme", self.scheme, f"one of {SCHEMES}")
        _require(self.max_substeps >= 1, "max_substeps", self.max_substeps, "at least 1")
        enough = self.checkpoint_bytes is None or self.checkpoint_bytes >= 0
        _require(enough, "checkpoint_bytes", self.checkpoint_bytes, "bytes >= 0, or None")
        _require(self.precision in PRECISIONS, "precision", self.precision, f"one of {tuple(PRECISIONS)}")
        finite = len(self.gravity) == 3 and all(math.isfinite(g) for g in self.gravity)
        _require(finite, "gravity", self.gravity, "three finite numbers [m/s^2]")
        _require((self.lower is None) == (self.upper is None), "lower", self.lower, "lower and upper, or neither")
        if self.lower is not None and self.upper is not None:
            ordered = all(b - a >= self.dx for a, b in zip(self.lower, self.upper))
            _require(ordered, "lower", self.lower, f"a corner at least one cell below upper = {self.upper}")
        self.material.check_parameters({name: torch.tensor(value) for name, value in self.start.items()})
        for boundary in self.boundaries:
            boundary.check()

    @property
    def dtype(self) -> torch.dtype:
        return PRECISIONS[self.precision]

    def estimate(self) -> Estimate:
        """The initial guess: the start values and velocity. Raises ValueError as `check` does."""
        self.check()
        parameters = {name: torch.tensor(float(value), dtype=torch.float64) for name, value in self.start.items()}
        return Estimate(parameters=parameters, velocity=torch.tensor(self.velocity, dtype=torch.float32))


def _require(condition: bool, name: str, value: object, remedy: str) -> None:
    if not condition:
        raise ValueError(f"world.{name} is {value}; take {remedy}")
