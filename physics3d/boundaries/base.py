"""What a boundary condition is to the solver: numbers, and up to six Warp functions, each at its place in a substep.

    acceleration   added to selected particles before they are scattered           (forces from outside)
    touch          does a particle reach the boundary? `node` then acts only on the nodes of those that do
    node           velocity of a grid node -> velocity of that node                 (walls, colliders)
    grip           how much of a selected particle is gripped now: it moves as imposed, whatever acts on it
    ahead          how far a place is before the face of what is gripped and stays at rest
    steer          the velocity that is imposed there, and its gradient             (zero: it is held)

The solver calls whatever is there, in the order of the list, and never asks which one it has. A boundary's numbers are
of two kinds: `parameters` are constant during a rollout, differentiable, and travel in one vector; `signals` depend on
time and are computed on the host in float64 for every substep, so that a window in time is exact whatever dt is.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import require_fields

Vector = tuple[float, float, float]
NEAREST = 0.499  # [cells] how far in front of a surface nodes of touching particles still obey it


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What a boundary may know of the body and the region, at rest."""

    position: Float[Tensor, "p 3"]  # rest positions [m], float64
    mass: Float[Tensor, " p"]  # [kg], float64
    volume: Float[Tensor, " p"]  # [m^3], float64
    lower: Vector  # corner of the simulated region [m]
    upper: Vector
    dx: float  # [m]


@dataclass(frozen=True, kw_only=True)
class Wall:
    """A resting plane across an axis of the grid, without friction; it may mirror (`mirror_nodes`)."""

    axis: int  # 0, 1, 2
    side: int  # +1: the material is above the plane, -1: below
    place: float  # of the plane along the axis [m]
    sticky: bool  # else it slips


@dataclass(frozen=True, kw_only=True)
class AbstractBoundary(abc.ABC):
    """A boundary condition; its fields are SI numbers.

    The Warp functions of a boundary (memoised by their arguments, so that equal boundaries share one) are
        node(x: vec3, v: vec3, q: array[real], a: int, clock: array2d[real], row: int, b: int) -> vec3
        touch(x: vec3, radius: real, q, a, clock, row, b) -> bool
        acceleration(weight: real, x: vec3, q, a, clock, row, b) -> vec3
        grip(weight: real, q, a, clock, row, b) -> real, from 0 to 1
        ahead(x: vec3, q, a) -> real [m]: of what is gripped and stays at rest, how far x is before its face
        steer(x: vec3, q, a, clock, row, b) -> (vec3, mat33)
    where q[a + i] is its i-th parameter, clock[row, b + i] its i-th signal in this substep, clock[row, 0] is dt, x is
    in metres, weight what `selection` gave for the particle (never 0 in a call), and radius half the edge of the cube
    that the particle is at rest [m].
    """

    def check(self) -> None:
        """Raise ValueError naming the field, its value and the remedy."""
        require_fields(self, type(self).__name__)

    @abc.abstractmethod
    def parameters(self, setting: Setting) -> Float[Tensor, " k"]:
        """Constant numbers the Warp functions read, float64; differentiable where fields are tensors."""

    def signals(self, t: float, dt: float) -> tuple[float, ...]:
        """Numbers of the substep from t to t + dt [s]; always the same count."""
        return ()

    def selection(self, setting: Setting) -> Float[Tensor, " p"]:
        """Weight per particle for `acceleration` and `grip`; 0 leaves it alone. Differentiable in the place."""
        return torch.zeros(len(setting.position), dtype=torch.float64)

    def behind(self, setting: Setting) -> Float[Tensor, " p"]:
        """How deep each particle starts behind a surface of this boundary [m], where nothing should be; else <= 0."""
        return torch.zeros(len(setting.position), dtype=torch.float64)

    def holds(self, setting: Setting) -> Float[Tensor, " p"]:
        """1 for particles whose place, at rest, this boundary holds still from the start; else 0."""
        return torch.zeros(len(setting.position), dtype=torch.float64)

    def walls(self, setting: Setting) -> tuple[Wall, ...]:
        """Planes the solver may mirror at; `node` must hold on and behind them all the same."""
        return ()

    def node(self, real: type) -> wp.Function | None:
        return None

    def touch(self, real: type) -> wp.Function | None:
        return None

    def acceleration(self, real: type) -> wp.Function | None:
        return None

    def grip(self, real: type) -> wp.Function | None:
        return None

    def ahead(self, real: type) -> wp.Function | None:
        return None

    def steer(self, real: type) -> wp.Function | None:
        return None


def mirror_nodes(boundaries: Sequence[AbstractBoundary], setting: Setting) -> list[int] | None:
    """Where the grid is mirrored: per axis the node of the lower wall, then of the upper one, then 1 for each that is
    sticky (12 numbers); None if there is no such wall.

    Velocities zeroed on and behind a wall leave half a cell of material before it too stiff: an error of first order.
    A wall that mirrors folds momentum and mass of the layer of nodes behind it onto the layer before it, the momentum
    across it (all of it, if sticky) reversed, and the velocities back: the trial functions then vanish on the plane
    itself, an error of second order. It asks for a plane on nodes (to 1e-3 dx) with no particle behind it at rest, and
    for one cell between two walls; another wall keeps the rule of its `node`, as all but the innermost of several do.
    """
    far = 2**28
    nodes, sticky = [-far] * 3 + [far] * 3, [0] * 6
    for wall in (wall for boundary in boundaries for wall in boundary.walls(setting)):
        place = (wall.place - setting.lower[wall.axis]) / setting.dx
        behind = wall.side * (setting.position[:, wall.axis] - wall.place) < 0
        if abs(place - round(place)) > 1e-3 or bool(behind.any()):
            continue
        at, node = wall.axis + (0 if wall.side > 0 else 3), round(place)
        if node == nodes[at]:
            sticky[at] |= int(wall.sticky)
        elif wall.side * (node - nodes[at]) > 0:
            nodes[at], sticky[at] = node, int(wall.sticky)
    for axis in range(3):
        if nodes[axis] >= nodes[axis + 3]:
            nodes[axis], nodes[axis + 3] = -far, far
    return nodes + sticky if any(abs(node) != far for node in nodes) else None


def require(condition: bool, boundary: AbstractBoundary, field: str, remedy: str) -> None:
    """Raise ValueError 'HalfSpace.normal is ...; take ...' unless the condition holds."""
    if not condition:
        raise ValueError(f"{type(boundary).__name__}.{field} is {getattr(boundary, field)}; take {remedy}")


def overlap(start: float, duration: float, t: float, dt: float) -> float:
    """Share of the substep [t, t + dt] inside the window [start, start + duration], 0..1."""
    if dt <= 0:
        return 0.0
    return max(0.0, min(start + duration, t + dt) - max(start, t)) / dt


def inside_box(position: Float[Tensor, "p 3"], lower: Vector, upper: Vector) -> Float[Tensor, " p"]:
    """1 for particles in the closed box, else 0."""
    low, high = position.new_tensor(lower), position.new_tensor(upper)
    return ((position >= low) & (position <= high)).all(1).to(torch.float64)


def require_selected(boundary: AbstractBoundary, selected: Float[Tensor, " p"]) -> None:
    """Raise ValueError if the region of the boundary holds no particle."""
    if not bool((selected != 0).any()):
        raise ValueError(f"{boundary} holds none of the {len(selected)} particles at rest; move or enlarge its region")
