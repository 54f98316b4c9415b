"""The other valley of a relaxation time: what damps a swing as much, and gives way differently.

A branch of modulus m and time tau beside a spring E answers a swing of angular frequency w, with x = w tau, by

    storage  S = E + m x^2/(1 + x^2),    loss  D = m x/(1 + x^2)

For every x there are E and m with the same S and D; x and 1/x even share m. So a clip of one frequency tells them
apart only by how the thing gives way to a steady force and by how its decay begins, and a descent stays in the valley
in which it began. It is begun once more: from the other side, at 1/x, or, where the sides are far apart, from between
them, at x = 1, where a branch damps most; where x is about 1, at 3 x or x/3. Of two places the one with the lower loss
is taken, and of two ends the better one (of linear viscoelastic solids: Ferry 1980, Viscoelastic Properties of
Polymers, ch. 3).
"""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.fields import GlobalField
from physics3d.trajectory import Trajectory

NAMES = ("youngs_modulus", "branch_shear_modulus", "shear_relaxation_time")
NEAR = 1.6  # x or 1/x up to which both sides are one, and a factor between times that are
AWAY = 3.0  # then so far to either side; sides of which each is as far from 1 have a middle
LEAST = 0.1  # of E, that is left of it


def angular_frequency(motion: Trajectory) -> float:
    """w [1/s] of a motion, from its mean squares: |v|^2 = w^2 |u - mean u|^2 of what swings harmonically; 0 at rest."""
    x, v = motion.position.double(), motion.velocity.double()
    swing = float((x - x.mean(0)).square().sum())
    return math.sqrt(float(v.square().sum()) / swing) if swing > 0 else 0.0


def slow_and_fast(values: Mapping[str, float]) -> tuple[float, float] | None:
    """(E, m) [Pa], both as Young's moduli, of a solid with one branch; None of others."""
    if any(name not in values for name in NAMES) or any(name.startswith(f"{NAMES[1]}_") for name in values):
        return None
    return values[NAMES[0]], 2 * (1 + values.get("poissons_ratio", 0.3)) * values[NAMES[1]]


def across(field: GlobalField, theta: Float[Tensor, " k"], omega: float) -> list[Float[Tensor, " k"]]:
    """Where another valley may be; nowhere if no time is learned apart from the stiffness."""
    values = {name: float(torch.as_tensor(value).mean()) for name, value in field.parameters(theta).items()}
    moduli = slow_and_fast(values)
    groups = {name: i for i, group in enumerate(field.groups) for name in group}
    spring, branch, time = (groups.get(name) for name in NAMES)
    if moduli is None or None in (spring, branch, time) or spring == branch:
        return []
    x = omega * values["shear_relaxation_time"]
    if not x > 0:
        return []
    found, far = [], max(x, 1 / x)
    for factor in (AWAY, 1 / AWAY) if far < NEAR else (x**-2,) if far < AWAY else (x**-2, 1 / x):
        E, m = of_same_swing(*moduli, x, factor * x)
        there = theta.clone()
        there[spring] += math.log(max(E / moduli[0], LEAST))
        there[branch] += math.log(m / moduli[1])
        for i in {i for name, i in groups.items() if name.endswith("relaxation_time")}:
            there[i] += math.log(factor)
        found.append(field.bound(there))
    return found


def of_same_swing(E: float, m: float, x: float, other: float) -> tuple[float, float]:
    """(E, m) for which S and D are at `other` what they were at x."""
    damped, stored = m * x / (1 + x**2), E + m * x**2 / (1 + x**2)
    return stored - damped * other, damped * (1 + other**2) / other


def time_by_modulus(x: float, most: float = 2.0) -> float:
    """d ln tau/d ln m along which D stays what the clip shows: -(1 + x^2)/(1 - x^2), at most `most` to either side."""
    return -math.copysign(min((1 + x**2) / max(abs(1 - x**2), 1e-9), most), 1 - x**2)
