"""Write docs/handbook.md: conf/handbook.yaml as a table, with what its numbers mean.

make handbook
"""

import math
from pathlib import Path

from physics3d.handbook import FIELDS, Thing, read

ROOT = Path(__file__).resolve().parent.parent
TITLES = ("thing", "E [Pa]", "nu", "density [kg/m^3]", "loss factor")
TOP = """# Handbook: what things are made of

Made by `make handbook` from [conf/handbook.yaml](../conf/handbook.yaml).

A scene says `thing: foam`, or on the command line `scene.thing=foam`; of a scene whose material has parts, one for
each: `thing: {stem: stem, petals: petal}`. Then

- the material starts from E and nu of the thing, and a Maxwell branch from the ratio r = 2 eta (eta + sqrt(1 + eta^2))
  whose largest loss is eta, unless the scene or the command line gives another start; relaxation times keep theirs;
- the widths become those of what is thought likely before the clip (`learn.guess_widths`), so that an interval says
  what the clip has added; without a thing a parameter is guessed to a factor 10 (`learn.guess_width`);
- where `scene.density` is null, the density is that of the thing, and its width that of the interval's
  (`learn.beyond`). **A density that a scene gives wins**: for scenes that assume one, set `scene.density` to null.

Numbers are `value x/ factor`, the factor of one standard deviation of the logarithm; two of three things of that name
are thought to lie between value/factor and value times factor. For nu the factor is of K/mu, and its range is given.
They are typical ranges of textbooks and papers, as cited, or assumed where the source says so; they were written down
from memory of these sources and **have not yet been checked against them**: a start for learning and
a reminder of what is usual, not data of any one thing. Stiffness is that of the substance as an isotropic solid; a
thing that is hollow, thin, layered or woven may be far from it in bending.
"""


def cell(thing: Thing, field: str) -> str:
    """`value x/ factor` of a figure; of nu its range."""
    figure = getattr(thing, field)
    if field != "poissons_ratio":
        return f"{figure.value:.4g} x/ {math.exp(figure.width):.3g}"
    ratio = 2 * (1 + figure.value) / (3 * (1 - 2 * figure.value))
    low, high = (ratio * math.exp(side * figure.width) for side in (-1, 1))
    return f"{figure.value:.4g} ({_nu(low):.3g} to {_nu(high):.3g})"


def _nu(ratio: float) -> float:
    """Poisson's ratio of K/mu."""
    return (3 * ratio - 2) / (2 * (3 * ratio + 1))


def page(things: dict[str, Thing]) -> str:
    """The whole page."""
    lines = [TOP, f"| {' | '.join(TITLES)} |", "|" + "---|" * len(TITLES)]
    lines += [f"| {name} | {' | '.join(cell(thing, field) for field in FIELDS)} |" for name, thing in things.items()]
    lines += ["", "## Sources", ""]
    words = dict(zip(FIELDS, ("E", "nu", "density", "loss factor"), strict=True))
    for name, thing in things.items():
        lines.append(f"- **{name}**: " + "; ".join(f"{w}: {getattr(thing, f).source}" for f, w in words.items()) + ".")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    (ROOT / "docs" / "handbook.md").write_text(page(read(ROOT / "conf" / "handbook.yaml")), encoding="utf-8")
