"""The CFL limit: how long a substep may be, how many a frame needs, and which scheme is the cheaper one.

Waves cross a cell in dx/(c + |v|), with rho c^2 = M + 2 |tau|, M the wave modulus at rest: a bound for stretched and
compressed bodies, where it is M - tau (Hencky), at most M + |tau| (neo-Hookean) or s^2 M at a stretch s (fixed
corotated). A lone particle, whose stress comes back undiluted, needs dt < dx/(sqrt(3) c): its three axes act together
(Sun, Shinar and Schroeder 2020). A viscosity eta without a spring in series needs dt < b = rho dx^2/(6 eta); beside
waves that need dt < a, damping at the rate 2/b leaves dt < a [(1 + x^2)^(1/2) - x], x = a/(2 b). An automatic substep
is cfl times the first and at most 0.95 times the last.

The implicit scheme knows none of these limits. Its automatic step is the whole frame, unless a particle moves farther
than half a cell in it, or turns or stretches by more than a fifth. It damps whatever swings faster than a few steps, so
it is another answer and not only a cheaper one: scheme="auto" takes it where the explicit substep is below
1/24 s / WORTH = 4e-5 s.
"""

import math
from dataclasses import dataclass

from torch import Tensor

from physics3d.mpm.state import State
from physics3d.mpm.survey import Survey
from physics3d.trajectory import NotMoved
from physics3d.world import World

# Explicit substeps that one implicit step has to replace before the automatic scheme takes it. Measured on one core, in
# float32, 12800 particles of a clamped block at 30 to 3000 explicit substeps per step: the first one costs 80 to 100 of
# them, later ones 22 to 30. That it takes ten times less is not enough: backward Euler damps the vibrations.
WORTH = 1000
LONGEST = 1 / 24  # [s], of an implicit step of the automatic scheme: frames may be further apart than a film's


@dataclass(frozen=True)
class Limit:
    """How long an explicit substep may be in a state."""

    crossing: float  # waves and the fastest particle cross a cell [s]
    alone: float  # a lone particle stays stable, viscosity included [s]
    why: str
    remedy: str

    @property
    def dt(self) -> float:
        """The longest stable substep [s]."""
        return min(self.crossing, self.alone)


def wave_speed(world: World, seen: Survey) -> float:
    """The fastest wave [m/s]."""
    # snow that was torn apart has no stiffness left
    return max((seen.stiffness / world.density) ** 0.5, 1e-30)


def explicit_limit(world: World, coefficients: Tensor, now: State, seen: Survey) -> Limit:
    """How long an explicit substep may be in this state."""
    c, v = wave_speed(world, seen), seen.speed
    dx, density = world.dx, world.density
    eta = float(world.material.viscosity(coefficients, now.L).max())
    waves, viscous = dx / (math.sqrt(3) * c), density * dx**2 / (6 * eta) if eta > 0 else math.inf
    x = waves / (2 * viscous)
    alone = waves / (math.sqrt(1 + x**2) + x)
    if x > 1:
        why = f"a viscosity of {eta:.3g} Pa s lets momentum cross a cell in {viscous:g} s"
        remedy = "a lower viscosity, a larger dx or scheme='implicit'"
    elif v > c:
        why, remedy = f"waves and particles cross a cell in {dx / (c + v):g} s", "a weaker force or a slower start"
    else:
        why = f"waves cross a cell in {dx / (c + v):g} s"
        remedy = "a softer material, a larger dx or scheme='implicit'"
    return Limit(dx / (c + v), alone, why, remedy)


def explicit_need(world: World, limit: Limit, frame_dt: float) -> int:
    """Substeps that a frame needs."""
    return math.ceil(frame_dt / min(world.cfl * limit.crossing, 0.95 * limit.alone))


def implicit_need(world: World, now: State, frame_dt: float) -> int:
    """Implicit steps that a frame needs: no particle moves half a cell, turns or stretches by a fifth in one, and
    unless the user wants them, none is longer than a frame of a film."""
    gain = math.hypot(*world.gravity) * frame_dt
    speed = (float(now.v.norm(dim=1).max()) + gain) / (0.5 * world.dx)
    rate = float(now.L.flatten(1).norm(dim=1).max()) / 0.2
    film = 1 / LONGEST if world.scheme == "auto" else 0.0
    return max(1, math.ceil(frame_dt * max(speed, rate, film) * (1 - 1e-9)))


def substeps_of_frame(
    world: World, now: State, limit: Limit, frame_dt: float, *, implicit: bool, last: int, frame: int
) -> int:
    """Equal substeps of the coming frame, after one that had `last`. Raises NotMoved where the user's dt is above the
    limit, or there are more of them than the world allows."""
    dt, most = world.dt, world.max_substeps
    if dt is not None:
        need = math.ceil(frame_dt / dt * (1 - 1e-9))
        if dt > limit.dt and not implicit:
            raise NotMoved(
                f"substep_dt is {dt:g} s, {limit.why} (frame {frame}); take world.dt < {limit.dt:.3g}, None for an "
                "automatic one, or scheme='implicit'"
            )
    elif implicit:
        # half of the last, so that a frame that had to be halved does not make the next one start from too few
        need = max(implicit_need(world, now, frame_dt), last // 2)
    else:
        need = explicit_need(world, limit, frame_dt)
        # a count that still serves is kept, so that dt does not flicker from frame to frame
        need = last if need <= last <= 1.5 * need else need
    if need > most:
        given = f"world.dt > {frame_dt / most:.3g}" if dt is not None else limit.remedy
        why = limit.why
        if implicit:
            why, given = "particles move, turn or stretch too fast", "a weaker force or a slower start"
        raise NotMoved(
            f"frame {frame} would need {need} substeps of {frame_dt / need:.3g} s, more than "
            f"world.max_substeps = {most}: {why}; take {given}, or a larger max_substeps"
        )
    return need
