"""A body put into a world: what can be known before a second of it is simulated.

Refused is what cannot be meant: a body smaller than a cell, particles farther apart than cells, an excitation that
misses the body, a body wholly behind a floor. Said is what holds the body, how well that is resolved, and what starts
behind a floor or a wall, where it hangs.
"""

import math

import numpy as np
import torch

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.filling.body import Body
from physics3d.filling.section import COARSE, Section, thinnest_section
from physics3d.log import Log
from physics3d.world import World

PLACES = ("lower", "upper", "point", "normal", "position", "path", "kind")  # fields by which a person knows a boundary
CELLS = 15  # along the longest side of a body, for it to bend as it should


def look_ahead(body: Body, world: World, excitation: tuple[AbstractBoundary, ...], log: Log) -> Section | None:
    """Say what the world does to the body at rest, and return its thinnest section beside what is held, if any is.

    Raises ValueError naming field, value and remedy if it cannot be."""
    world.check()
    _check_resolution(body, world)
    everywhere = (math.inf,) * 3
    setting = Setting(
        position=body.position.double().cpu(),
        mass=world.density * body.volume.double().cpu(),
        volume=body.volume.double().cpu(),
        lower=tuple(-v for v in everywhere),  # type: ignore[arg-type]
        upper=everywhere,
        dx=world.dx,
    )
    for boundary in (*world.boundaries, *excitation):
        boundary.check()
        try:
            boundary.selection(setting)
        except ValueError as missed:
            raise ValueError(f"{missed}; the body lies in {_extent(setting)}") from None
        _say_behind(boundary, setting, log)
    return _say_held(body, world, setting, log)


def _check_resolution(body: Body, world: World) -> None:
    size = float((body.position.amax(0) - body.position.amin(0)).max()) + body.spacing
    if not world.dx <= size:
        raise ValueError(
            f"world.dx is {world.dx:g} m, and the whole body is {size:.3g} m: it is smaller than a cell; take "
            f"world.dx <= {size / CELLS:.2g} m and fill.spacing half of it"
        )
    if body.spacing > 1.01 * world.dx:
        raise ValueError(
            f"world.dx is {world.dx:g} m, and particles are {body.spacing:g} m apart: each is alone in its cell; take "
            f"world.dx = {2 * body.spacing:g} m, or fill.spacing = {world.dx / 2:g} m"
        )


def _say_behind(boundary: AbstractBoundary, setting: Setting, log: Log) -> None:
    depth = boundary.behind(setting)
    count, deepest = int((depth > 1e-3 * setting.dx).sum()), float(depth.max())
    if not count:
        return
    what = f"{count} of {len(depth)} particles start behind {_named(boundary)}, up to {deepest:.3g} m deep"
    if count == len(depth):
        raise ValueError(f"{what}: the whole body; move it, or the body, to the other side")
    log.warn(f"{what}, and hang there; move it away from the body by {deepest:.2g} m, or the body from it")


def _say_held(body: Body, world: World, setting: Setting, log: Log) -> Section | None:
    held = torch.zeros(len(setting.position), dtype=torch.bool)
    said = []
    attachment = [(b, "where it touches what is static") for b in body.held]
    for boundary, name in (*attachment, *((b, f"by {_named(b)}") for b in world.boundaries)):
        own = boundary.holds(setting) > 0
        held |= own
        if own.any():
            said.append(f"{int(own.sum())} particles {name}")
        elif type(boundary).holds is not AbstractBoundary.holds:
            log.warn(f"{_named(boundary)} holds nothing of the body, which lies in {_extent(setting)}")
    log.metric("held", int(held.sum()))
    log.info(f"held: {', '.join(said)}" if said else "nothing holds the body still")
    position, volume = (a.double().cpu().numpy() for a in (body.position, body.volume))
    section = thinnest_section(position, volume, np.asarray(held), body.spacing)
    if world.solver == "grid":  # modes integrate every section with its second moment, whatever the particles
        say_resolution(section, world.dx, log)
    return section


def say_resolution(section: Section | None, dx: float, log: Log) -> None:
    """How well a grid of cells `dx` [m] resolves the thinnest held section, and the remedy where it does not."""
    if section is None:
        return
    log.metric("held_section_cells", section.cells(dx))
    if section.cells(dx) < 0.99 * COARSE:  # a section of two cells is two, whatever the rounding
        log.warn(f"{section.described(dx)}; take scene.dx <= {section.thickness / COARSE:.2g} m for better")
    else:
        log.info(section.described(dx))


def _named(boundary: AbstractBoundary) -> str:
    """A boundary by its kind and place; arrays are left out."""
    places = ((name, getattr(boundary, name, None)) for name in PLACES)
    short = (f"{name}={value}" for name, value in places if isinstance(value, tuple | str) and len(str(value)) < 100)
    return f"{type(boundary).__name__}({', '.join(short)})"


def _extent(setting: Setting) -> str:
    """Corners of the box around the particles."""
    corners = (setting.position.amin(0).tolist(), setting.position.amax(0).tolist())
    return " .. ".join("(" + ", ".join(f"{x:.3g}" for x in corner) + ")" for corner in corners) + " m"
