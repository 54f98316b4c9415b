"""How far learned numbers can be trusted: what the clip says, what no clip can say, what was thought before it.

    theta_hat - theta ~ N(0, V + d d^T + W)      V of the residuals (`sandwich.py`); d = A^-1 sum_i s_i is what the
                                                 descent left undone, by the pull to the start among others
    theta - start ~ N(0, S)                      before the clip: widths in the logarithm, on the diagonal
    H = S^-1 + (V + d d^T + W)^-1,   theta - start ~ N(H^-1 (V + d d^T + W)^-1 (theta_hat - start), H^-1)

W is what residuals do not show, for a wrong number there is made good by another theta that draws the same pictures: a
sum of sigma^2 e e^T, with sigma a relative width (`Beyond`) and e the change of theta_hat that it brings. All stiffness
(moduli, stresses at yield, viscosities) scales alike, 1_m; with phi = A^-1 J^T dz/d(ln force) for forces that are known
in newtons (0 where what drives the motion is a known motion, an acceleration, or unknown)

    surface, grid    e = 1_m; the surface is that of a mass as well, so the density's e besides, with half of the width:
                     what is thicker by x bends 4 x harder and weighs 2 x more; or with both widths as the body's own
                     surface leaves them open in the motion that was filmed (`filling/doubt.py`)
    density          e = 1_m + 1_rho + phi: E goes with rho exactly, except for a known force. One that holds a thing
                     bent says E whatever it weighs (phi = -1); one that makes it swing says both, so that the density
                     is learned besides: then phi = -1_m - 1_rho, nothing is left here, and the width is that of S
    length           e = 2 1_m + 4 phi: E goes with rho L^2; and velocities with L
    force            e = phi: a thing that was pushed harder than is said seems softer
    branches         e = 1/share of a branch's modulus in the stiffness of fast motion: half of surface and grid
                     together, which need not be the same in slow and fast modes. A branch is known by the difference.
                     Its time changes by so much that the swing is damped as it was (`mirror.time_by_modulus`); 0 else

What cells do to numbers that are not stiff is measured (`linear.shown`): e of cells as large as they are, against none,
besides the table's width of the stiffness, for a single coarser grid says little of a stem that is a cell thick.

phi is exact where all that is stiff is learned. theta is ln of a number, of Poisson's ratio ln K/mu, or a velocity in
its own unit (`fields.py`), so a 90 % interval of the number follows from that of theta.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import require_fields
from physics3d.filling.body import Body
from physics3d.filling.doubt import widths
from physics3d.filling.section import Section
from physics3d.learning.fields import AXES, DENSITY, AbstractField, is_poissons_ratio, physical
from physics3d.learning.mirror import time_by_modulus
from physics3d.learning.sandwich import NORMAL, Evidence, spread
from physics3d.log import Log
from physics3d.world import Interval

Width = Annotated[float, Ge(0), Le(10)]  # relative: a standard deviation in the logarithm


@dataclass(frozen=True, kw_only=True)
class Beyond:
    """Relative widths of what residuals do not show.

    surface: of the stiffness of a reconstructed part, that is of the second moment of its section. The reconstructed
    stem of `docs/results/filling.md`: 2 % wrong in the mean, 25 % in the worst section. Learning takes more where the
    surface leaves more open in this motion: what is thin, or what no photograph shows.
    grid: of the stiffness, by the resolution of the grid. A cantilever two cells thick is 4.9 % wrong in frequency,
    10 % in E (`docs/results/simulation.md`); the carnation, its stem as thick, 18 % in E against tetrahedra. Learning
    takes more where the thinnest held section (`filling/section.py`) has fewer cells: 28 % for one.
    modes: the same where a body is moved without a grid (`docs/results/swaying.md`). The twin's poke is within 1 % of
    that by finite elements, beams and forks within 1 to 2.5 % in frequency, twice that in E. Learning takes more where
    splines further apart say so (`Model.too_stiff`): 6 % for the brim of the hat.
    """

    surface: Width = 0.1
    mass: Width | None = None  # of the mass, by where that surface is, at least; None: half of `surface`
    grid: Width = 0.15
    modes: Width = 0.05
    density: Width = 0.1  # of the density, as given
    length: Width = 0.05  # of the size, as given
    force: Width = 0.1  # of the forces that are known, as given

    def __post_init__(self):
        require_fields(self, "learn.beyond")

    def of(self, section: Section | None, dx: float, too_stiff: float | None) -> "Beyond":
        """For what moved the body: `grid` is that of cells of `dx` [m] at the thinnest held section, or `modes`, which
        are `too_stiff` by so much; None: it was the grid."""
        if too_stiff is not None:
            return replace(self, grid=max(self.modes, too_stiff) if self.modes > 0 else 0.0)
        return self if section is None else replace(self, grid=max(self.grid, 2 * section.grid_error(dx)))

    def shaped(
        self, body: Body, deformation: Float[Tensor, "t p 3 3"], velocity: Float[Tensor, "t p 3"], log: Log
    ) -> "Beyond":
        """For a body that moves like this: F and velocity [m/s] of its particles, or either of a mode in any unit."""
        if body.doubt is None or self.surface == 0:
            return self
        left = widths(body.doubt, body.position, body.volume, deformation, velocity)
        log.metric("surface_width", left.stiffness)
        unshown = ", most of it where no photograph shows it" if left.unshown > 0.5 else ""
        log.info(
            f"where the surface is leaves {100 * left.stiffness:.0f} % of the stiffness open in this motion{unshown}, "
            f"and {100 * left.mass:.0f} % of the mass"
        )
        return replace(
            self,
            surface=max(self.surface, left.stiffness),
            mass=max(self.surface / 2 if self.mass is None else self.mass, left.mass),
        )

    def covariance(
        self,
        stiff: Float[np.ndarray, " k"],
        speed: Float[np.ndarray, " k"],
        push: Float[np.ndarray, " k"],
        branch: Float[np.ndarray, " k"] | float = 0.0,
        cells: Float[np.ndarray, " k"] | float = 0.0,
        mass: Float[np.ndarray, " k"] | float = 0.0,
    ) -> Float[np.ndarray, "k k"]:
        """W. `stiff`: 1_m; `speed`: theta of what is a velocity, its start included, else 0; `push`: phi; `branch`: of
        branches, `of_branches`; `cells`: what a grid's are taken for, `Shown.grid`; `mass`: 1 of the density where it
        is learned."""
        changes = (
            (self.surface, stiff),
            (self.surface / 2 if self.mass is None else self.mass, stiff + push),
            (self.grid, stiff),
            (self.density, stiff + mass + push),
            (self.length, 2 * stiff + speed + 4 * push),
            (self.force, push),
            (math.hypot(self.surface, self.grid) / 2, branch * np.ones(len(stiff))),
            (1.0, cells * np.ones(len(stiff))),
        )
        return sum((width**2 * np.outer(e, e) for width, e in changes), np.zeros((len(stiff),) * 2))


@dataclass(frozen=True, kw_only=True)
class Told:
    """What a clip says of theta around theta_hat, in m directions that are independent of each other.

    Distances are in units of what was thought beforehand: 1 along axis i changes theta by before * axes[:, i].
    """

    axes: Float[np.ndarray, "k m"]  # orthonormal; what no picture shows is in none of them
    middle: Float[np.ndarray, " m"]  # of what the clip says, from theta_hat
    deviation: Float[np.ndarray, " m"]


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """theta - start after the clip, and before it."""

    mean: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    before: Float[np.ndarray, " k"]  # standard deviations


def told(evidence: Evidence, *, before: Float[np.ndarray, " k"], log: Log) -> Told:
    """V + d d^T by its own directions; `before`: widths of what was thought beforehand."""
    found = spread(evidence)
    log.info(
        f"residuals hang together over {found.frames} frame(s) at a time; as good as {found.places:.1f} independent "
        f"places and {found.times:.1f} independent times"
    )
    # in units of the prior; what the pictures do not show at all says nothing
    A = before[:, None] * evidence.JJ * before
    values, vectors = np.linalg.eigh(A)
    shown = values > 1e-9 * max(values[-1], 1e-300)
    values, U = values[shown], vectors[:, shown]
    gain = U / values  # A^-1 U
    V = gain.T @ (before[:, None] * found.B * before) @ gain
    fat = U.T @ (found.student[:, None] * U)
    undone = gain.T @ (before * evidence.score.sum((0, 1)))
    V = fat @ V @ fat.T + np.outer(undone, undone)
    variance, turn = np.linalg.eigh((V + V.T) / 2)
    return Told(axes=U @ turn, middle=np.zeros(len(variance)), deviation=np.sqrt(np.maximum(variance, 1e-12)))


def posterior(
    theta: Float[np.ndarray, " k"],
    said: Told,
    *,
    before: Float[np.ndarray, " k"],
    beyond: Float[np.ndarray, "k k"],
) -> Posterior:
    """`theta`: found, from the middle of what was thought before; `before`: widths of that; `beyond`: W."""
    U = said.axes
    V = np.diag(said.deviation**2) + U.T @ (beyond / before[:, None] / before) @ U
    precision = U @ np.linalg.solve(V, U.T)
    covariance = np.linalg.inv(np.eye(len(before)) + precision)
    mean = covariance @ precision @ (theta / before + U @ said.middle)
    return Posterior(mean=before * mean, covariance=before[:, None] * covariance * before, before=before)


def intervals(field: AbstractField, found: Posterior, theta: Float[np.ndarray, " k"]) -> dict[str, Interval]:
    """Of every learned number, by its name; they hold what was learned, `theta`."""
    told: dict[str, Interval] = {}
    rows = [(name, i) for i, group in enumerate(field.groups) for name in group]
    rows += [(name, i) for i, name in enumerate(field.names) if name in (DENSITY, *AXES)]
    for name, i in rows:

        def value(x: float, name=name, i=i) -> float:
            theta = torch.from_numpy(found.mean.copy())
            theta[i] = x
            return physical(field, theta)[name]

        centre, deviation = float(found.mean[i]), float(math.sqrt(found.covariance[i, i]))
        unit = field.velocity_scale or 1.0 if name in AXES else 1.0
        told[name] = Interval(
            mean=_coordinate(name, value(centre)),
            deviation=unit * deviation,
            before=unit * float(found.before[i]),
            low=value(centre - NORMAL * deviation),
            high=value(centre + NORMAL * deviation),
            determined=deviation <= 0.5 * float(found.before[i]),
        ).holding(value(float(theta[i])))
    return told


def log_normal(*, middle: float, deviation: float, before: float) -> Interval:
    """Of a positive number whose logarithm is normal around ln `middle`."""
    low, high = (middle * math.exp(side * NORMAL * deviation) for side in (-1, 1))
    determined = deviation <= 0.5 * before
    return Interval(
        mean=math.log(middle), deviation=deviation, before=before, low=low, high=high, determined=determined
    )


def _coordinate(name: str, value: float) -> float:
    """What is normal: ln of a number, of Poisson's ratio ln K/mu, a velocity itself."""
    if name in AXES:
        return value
    return math.log(2 * (1 + value) / (3 * (1 - 2 * value)) if is_poissons_ratio(name) else value)


def of_branches(names: Sequence[str], values: Mapping[str, float], omega: float) -> Float[np.ndarray, " k"]:
    """1/share of each component of theta that is a branch's shear modulus, in that of fast motion; of the relaxation
    time of a single branch what then keeps the damping of a swing of `omega` [1/s]; 0 of the others.

    `names` of the components (`a+b` where tied), `values` [SI] of all parameters."""
    branch = {name: value for name, value in values.items() if name.startswith("branch_shear_modulus")}
    if "youngs_modulus" in values:
        slow = values["youngs_modulus"] / (2 * (1 + values.get("poissons_ratio", 0.3)))
    else:
        slow = values.get("shear_modulus", 0.0)
    fast = slow + sum(branch.values())
    own = [sum(branch.get(part, 0.0) for part in name.split("+")) for name in names]
    change = np.array([fast / value if value > 0 else 0.0 for value in own])
    if len(branch) == 1 and omega > 0:
        time = np.array(["shear_relaxation_time" in name.split("+") for name in names])
        change = change + time * change.sum() * time_by_modulus(omega * values["shear_relaxation_time"])
    return change


def words(found: Interval) -> str:
    """An interval for a person."""
    between = f"between {found.low:.4g} and {found.high:.4g}"
    return f"{between} (90 %)" if found.determined else f"not determined by this clip; {between}"
