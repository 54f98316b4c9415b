"""What things are made of: values and widths of `conf/handbook.yaml`, and where learning starts by them.

A thing has E, nu, rho and the largest loss factor eta, each with a width: the standard deviation of its logarithm, of
nu that of ln K/mu. A Maxwell branch of r times the stiffness of the springs that never relax loses at most

    eta = r/(2 sqrt(1 + r))      so      r = 2 eta (eta + sqrt(1 + eta^2)),      mu_N = r mu_E,  K_N = r K_E

(Zener's solid, Ferry 1980, ch. 3), shared equally among branches; a Maxwell body alone starts as stiff as the thing.
Relaxation times go with the motion as much as with what it is made of: the material's own start is kept.
"""

import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from physics3d.checks import PoissonsRatio, Text, require_fields

Width = Annotated[float, Gt(0), Le(3)]
FIELDS = ("youngs_modulus", "poissons_ratio", "density", "loss_factor")


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One number of a thing."""

    value: float  # SI
    width: Width  # standard deviation of the logarithm, of ln K/mu for nu
    source: Text


@dataclass(frozen=True, kw_only=True)
class Thing:
    """What a thing of this name is made of."""

    name: Text
    youngs_modulus: Figure  # [Pa]
    poissons_ratio: Figure
    density: Figure  # [kg/m^3]
    loss_factor: Figure


@dataclass(frozen=True, kw_only=True)
class _Values:
    youngs_modulus: Annotated[float, Gt(0), Le(1e13)]
    poissons_ratio: Annotated[PoissonsRatio, Ge(-1)]
    density: Annotated[float, Gt(0), Le(30_000)]
    loss_factor: Annotated[float, Gt(0), Le(3)]


def read(file: Path) -> dict[str, Thing]:
    """All things of a handbook. Raises ValueError naming the file, the entry and the remedy."""
    import yaml

    things = {}
    for name, figures in yaml.safe_load(file.read_text(encoding="utf-8")).items():
        if not isinstance(figures, dict) or set(figures) != set(FIELDS):
            raise ValueError(f"{file}: {name} has {sorted(figures or ())}; it needs {', '.join(FIELDS)}")
        made = {}
        for field, of in figures.items():
            where = f"{file}: {name}.{field}"
            if not isinstance(of, dict) or set(of) != {"value", "width", "source"}:
                raise ValueError(f"{where} is {of!r}; it needs value, width and source")
            made[field] = Figure(**of)
            require_fields(made[field], where)
        require_fields(_Values(**{field: figure.value for field, figure in made.items()}), f"{file}: {name}")
        things[name] = Thing(name=name, **made)
    return things


def find(things: Mapping[str, Thing], name: str) -> Thing:
    """Raises ValueError with the nearest names."""
    if name not in things:
        close = difflib.get_close_matches(name, things, 3, 0.5) or sorted(things)
        raise ValueError(f"scene.thing is {name!r}, which the handbook does not have; take {', '.join(close)}")
    return things[name]


def begin(thing: Thing, names: list[str], part: str = "") -> tuple[dict[str, float], dict[str, float]]:
    """(start, width) by the handbook of those of a material's parameters that it knows; `part.`names of a part.

    Raises ValueError if it knows none of them."""
    own = [name.removeprefix(part) for name in names if name.startswith(part) and "." not in name.removeprefix(part)]
    E, nu, eta = thing.youngs_modulus, thing.poissons_ratio, thing.loss_factor
    mu, K = E.value / (2 * (1 + nu.value)), E.value / (3 * (1 - 2 * nu.value))
    branches = sum(re.sub(r"_[23]$", "", name) == "branch_shear_modulus" for name in own)
    ratio, spread = 2 * eta.value * (eta.value + math.sqrt(1 + eta.value**2)) / max(branches, 1), eta.width
    if "youngs_modulus" not in own:  # nothing else holds the shape
        ratio, spread = 1.0 / max(branches, 1), 0.0
    known = {
        "youngs_modulus": (E.value, E.width),
        "poissons_ratio": (nu.value, nu.width),
        "branch_shear_modulus": (ratio * mu, math.hypot(E.width, spread)),
        "branch_bulk_modulus": (ratio * K, math.hypot(E.width, spread)),
    }
    found = {name: known[bare] for name in own if (bare := re.sub(r"_[23]$", "", name)) in known}
    if not found:
        raise ValueError(
            f"scene.thing is {thing.name!r}, but the material has none of {', '.join(known)}; take scene.thing=null, "
            "or material=viscoelastic"
        )
    return {part + name: v for name, (v, _) in found.items()}, {part + name: w for name, (_, w) in found.items()}


def fill_in(config: dict[str, Any], usual: Mapping[str, Any], things: Mapping[str, Thing]) -> None:
    """Put what `scene.thing` says into a composed configuration: start and width of the material, and the density with
    its width, each where nobody has said something else. `usual`: start values of the material's own file.

    Raises ValueError with one line."""
    scene, start = config["scene"], config["material"]["start"]
    told = scene["thing"]
    parts = {f"{part}.": name for part, name in told.items()} if isinstance(told, dict) else {"": told}
    widths: dict[str, float] = {}
    for part, name in parts.items():
        if not isinstance(name, str):
            raise ValueError(f"scene.thing is {told!r}; take a name of conf/handbook.yaml, or one for each part")
        values, spread = begin(find(things, name), list(start), part)
        for parameter, value in values.items():
            if start[parameter] == usual.get(parameter):
                start[parameter] = value
        widths |= spread
    learn = config["learn"]
    if learn:
        learn["guess_widths"] = widths | learn["guess_widths"]
    if scene.get("density") is None:
        if isinstance(told, dict):
            raise ValueError(f"scene.density is null, and scene.thing names {len(told)} things; give scene.density")
        density = find(things, told).density
        scene["density"] = density.value
        if learn:
            learn["beyond"]["density"] = density.width
