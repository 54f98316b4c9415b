"""Where boundaries take part in a substep: their Warp functions, and where each finds its numbers.

    push    added to selected particles before they are scattered           (forces from outside)
    touch   does a particle reach the boundary? its `node` then acts only on the nodes of those that do
    node    velocity of a grid node -> velocity of that node                 (walls, colliders)
    grip    how much of a selected particle is gripped now, and has no part in the dynamics (`hold`)
    ahead   how far a place is before the face of what is gripped, where the boundary knows; else shares of mass tell
    steer   the velocity and its gradient imposed on what is gripped

A kernel is made for the hooks of a scene, in the order of its boundaries; scenes with equal hooks share it. Only the
body of a kernel may call them: Warp tells kernels apart by their own `wp.static` values, not by those of functions in
them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import warp as wp

from physics3d.boundaries.base import AbstractBoundary

DECAY, KICK, FIRST_SIGNAL = 1, 2, 3  # columns of the clock; the first one is dt


class Hook(NamedTuple):
    """A function of one boundary."""

    function: wp.Function
    parameter: int  # its first one in q
    signal: int  # column of its first one in the clock
    boundary: int  # row of the selection


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """Those of all boundaries of a scene, by their place in a substep."""

    push: tuple[Hook, ...] = ()
    touch: tuple[Hook, ...] = ()
    node: tuple[Hook, ...] = ()
    grip: tuple[Hook, ...] = ()
    ahead: tuple[Hook, ...] = ()  # for some grips
    steer: tuple[Hook, ...] = ()  # one for each grip
    signals: int = 0  # of all boundaries together


def hooks_of(boundaries: Sequence[AbstractBoundary], widths: Sequence[int], real: type) -> Hooks:
    """`widths`: how many parameters each boundary has in q."""
    push: list[Hook] = []
    touch: list[Hook] = []
    node: list[Hook] = []
    grip: list[Hook] = []
    ahead: list[Hook] = []
    steer: list[Hook] = []
    parameter, signal = 0, FIRST_SIGNAL
    for row, (boundary, width) in enumerate(zip(boundaries, widths, strict=True)):
        for place, function in (
            (push, boundary.acceleration(real)),
            (touch, boundary.touch(real)),
            (node, boundary.node(real)),
            (grip, boundary.grip(real)),
            (ahead, boundary.ahead(real)),
            (steer, boundary.steer(real)),
        ):
            if function is not None:
                place.append(Hook(function, parameter, signal, row))
        parameter, signal = parameter + width, signal + len(boundary.signals(0.0, 0.0))
    return Hooks(
        push=tuple(push),
        touch=tuple(touch),
        node=tuple(node),
        grip=tuple(grip),
        ahead=tuple(ahead),
        steer=tuple(steer),
        signals=signal - FIRST_SIGNAL,
    )


def columns_of(hooks: tuple[Hook, ...]) -> tuple[tuple, ...]:
    """(functions, first parameters, first signals, boundaries), which a kernel takes apart as constants."""
    return tuple(zip(*hooks, strict=True)) if hooks else ((), (), (), ())
