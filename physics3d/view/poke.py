"""A poke by hand: on which particles, with which force, and as what it is kept.

Whoever drags a point of the body by d [m] pulls at a fingertip's worth of it, a ball of radius r around the point at
rest, with the force

    F = d/c     [N]

c [m/N] being how far this place gives way to a force at rest, before anything relaxes: the body follows the hand where
it is linear, lags where it stiffens, and creeps further where it is viscous (`by_modes.py`; a grid has another hand,
`by_grid.py`). What is kept is the force as it was, in a
few windows of time with the mean of each,

    impulse of a window = int F dt     exactly, in sum as well,

as `Impulse`s of a scene that is otherwise the one it was poked in: `make run SCENE=<name>_poke`.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float

from physics3d.boundaries.impulse import Impulse

WINDOWS = 8  # of time at most: a page that a person can read
FAINT = 1e-3  # of the largest force: windows with less are left out
ALIKE = 0.02  # the same: windows in which the force differs by less become one
DIGITS = 7  # of numbers that are written


@dataclass
class Record:
    """Forces, one step after another, on one place."""

    centre: tuple[float, float, float]  # at rest [m]
    radius: float  # [m]
    dt: float  # of a step [s]
    begin: float = 0.0  # when the hand took hold, after the body was at rest [s]
    forces: list[Float[np.ndarray, "3"]] = field(default_factory=list)  # [N]

    def impulses(self) -> tuple[Impulse, ...]:
        """The forces as boundary conditions, the first at time 0. Raises ValueError if there was none."""
        forces = np.array(self.forces).reshape(-1, 3)
        size = np.linalg.norm(forces, axis=1)
        if not size.any():
            raise ValueError("there is no poke to save yet; drag the body first")
        parts: list[np.ndarray] = []
        for part in np.array_split(forces, min(WINDOWS, len(forces))):
            if parts and np.linalg.norm(parts[-1].mean(0) - part.mean(0)) < ALIKE * size.max():
                parts[-1] = np.concatenate([parts[-1], part])
            else:
                parts.append(part)
        found, begin = [], 0
        for part in parts:
            mean = part.mean(0)
            if np.linalg.norm(mean) > FAINT * size.max():
                x, y, z = (_written(c) for c in mean)
                start, duration = _written(begin * self.dt), _written(len(part) * self.dt)
                push = Impulse(force=(x, y, z), centre=self.centre, radius=self.radius, start=start, duration=duration)
                found.append(push)
            begin += len(part)
        return tuple(found)


def place(position: Float[np.ndarray, "3"], dx: float) -> tuple[tuple[float, float, float], float]:
    """(centre, radius) [m] of a fingertip at a particle: three cells wide, both as they are written."""
    x, y, z = (_written(c) for c in position)
    return (x, y, z), _written(1.5 * dx)


def scene(base: str, name: str, impulses: tuple[Impulse, ...], notes: tuple[str, ...] = ()) -> str:
    """The text of conf/scene/<name>.yaml: the scene `base` with another excitation. `notes` become comments."""
    kind = f"{Impulse.__module__}.{Impulse.__qualname__}"
    pushes = [
        {"_target_": kind, **{k: list(v) if isinstance(v, tuple) else v for k, v in _given(push)}} for push in impulses
    ]
    body = {
        "defaults": [base, "_self_"],
        "scene": {"name": name, "excitation": pushes},
        "simulate": {"force": None},  # that of the impulses is to stay
    }
    head = [
        "# @package _global_",
        f"# {base}, poked by hand in the page of make view",
        *(f"# {note}" for note in notes),
    ]
    return "\n".join(head) + "\n" + yaml.safe_dump(body, sort_keys=False, default_flow_style=None, width=120)


def keep(folder: Path, base: str, impulses: tuple[Impulse, ...], notes: tuple[str, ...] = ()) -> str:
    """Write it under the first free name, <base>_poke or <base>_poke_2, ..., and return the name. Raises OSError."""
    number = 1
    while True:
        name = f"{base}_poke" + (f"_{number}" if number > 1 else "")
        try:
            with (folder / f"{name}.yaml").open("x") as out:
                out.write(scene(base, name, impulses, notes))
            return name
        except FileExistsError:
            number += 1


def _given(push: Impulse) -> list[tuple[str, object]]:
    return [(name, getattr(push, name)) for name in ("force", "centre", "radius", "start", "duration")]


def _written(value: float) -> float:
    return float(f"{float(value):.{DIGITS}g}")
