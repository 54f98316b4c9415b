"""A small vocabulary of which a scene's file composes a thing: ball, tube, turned body and sheet, in metres, z up.

    ball     |x/a|^p + |y/b|^p + |z/c|^p <= 1: an ellipsoid (p = 2), a cushion (4), a block with round edges (8)
    tube     round, around a smooth curve through points, or around a coil that winds along it
    turned   a profile (r, z) turned about an axis, fluted, r -> r (1 + e cos n phi), or curled, z -> z + h cos n phi
    sheet    a ribbon along a curve, with a half width at each of its points and a thickness: a leaf, a towel

Each is a closed surface with colours at its vertices. A sheet thinner than two particles is sampled as a layer of them,
each with its area times the thickness, as the filling does with petals and leaves.
"""

import abc
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, MinLen
from jaxtyping import Float

from physics3d.checks import Colour, Count, Direction, Length, NotNegative, Share, require_fields
from physics3d.scenes.studio import Mesh, smooth_noise, surface_grid, to_linear

Place = tuple[float, float, float]  # [m]
Turn = tuple[float, float, float]  # angles about x, y and z, in this order, about fixed axes [deg]
AROUND = 48  # vertices around a tube; around a turned body twice as many
ROWS = 72  # vertices along it, at least


@dataclass(frozen=True, kw_only=True)
class AbstractShape(abc.ABC):
    """A closed surface, and how it is coloured. Colours are sRGB."""

    colour: Colour  # red, green, blue, 0..1
    second: Colour = (1.0, 1.0, 1.0)  # of bands and veins
    bands: tuple[tuple[Share, Share], ...] = ()  # from, to: shares of the length that have the second colour
    mottle: Share = 0.1  # how uneven the colour is
    translucency: Share = 0.0  # share of the light that comes through
    full: bool = True  # of the thing's material; else an ornament without mass, carried by what is near
    carried_at: Place | None = None  # an ornament that is carried as one piece by what is near here [m]
    copies: Count = 1  # about the z axis, at equal angles

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, type(self).__name__.lower())

    @abc.abstractmethod
    def surface(self) -> Float[np.ndarray, "a b 3"]:
        """Rows along the shape of points around it [m]; columns are closed, and so are the ends."""

    def tone(self, along: Float[np.ndarray, " a"], around: int) -> Float[np.ndarray, "a b"]:
        """How much of the second colour is where, 0..1; `along` is the share of the length."""
        inside = [(along >= a) & (along <= b) for a, b in self.bands]
        banded = np.any(inside, 0) if inside else np.zeros(len(along), bool)
        return np.repeat(banded[:, None], around, 1).astype(np.float64)

    def meshes(self, seed: int, *, moves: bool) -> list[Mesh]:
        """One for each copy; the seed is that of the mottling."""
        points = self.surface()
        a, b = points.shape[:2]
        middle = points.mean(1)
        step = np.linalg.norm(np.diff(middle, axis=0), axis=1) + np.abs(np.diff(np.ptp(points, 1).max(1))) / 2
        along = np.concatenate([[0.0], np.cumsum(step)]) / max(step.sum(), 1e-12)
        share = self.tone(along, b)[..., None]
        albedo = to_linear(np.array(self.colour)) * (1 - share) + to_linear(np.array(self.second)) * share
        albedo = albedo * (1 + self.mottle * smooth_noise(np.random.default_rng(seed), a, b)[..., None])
        anchor = None if self.carried_at is None else tuple(self.carried_at)
        one = surface_grid(
            points, albedo, closed_b=True, translucency=self.translucency, moves=moves, anchor=anchor if moves else None
        )
        return [_turned_about_z(one, 2 * np.pi * k / self.copies) for k in range(self.copies)]


@dataclass(frozen=True, kw_only=True)
class Ball(AbstractShape):
    centre: Place  # its middle [m]
    half: tuple[Length, Length, Length]  # half axes a, b, c [m]
    power: Annotated[float, Ge(1), Le(40)] = 2.0  # p
    turn: Turn = (0.0, 0.0, 0.0)  # about x, then y, then z [deg]

    def surface(self) -> Float[np.ndarray, "a b 3"]:
        polar, angle = np.meshgrid(
            np.linspace(0, np.pi, ROWS), np.linspace(0, 2 * np.pi, 2 * AROUND, endpoint=False), indexing="ij"
        )
        # directions of an ellipsoid with these axes, each as far out as the surface is there
        unit = np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)], -1)
        reach = (np.abs(unit) ** self.power).sum(-1, keepdims=True) ** (-1 / self.power)
        return _placed(reach * unit * np.array(self.half), self.turn, self.centre)


@dataclass(frozen=True, kw_only=True)
class Tube(AbstractShape):
    path: Annotated[tuple[Place, ...], MinLen(2)]  # of its middle [m]
    radii: Annotated[tuple[Length, ...], MinLen(1)]  # at these points; one: everywhere [m]
    coil: NotNegative = 0.0  # radius of the coil in which it winds along the path [m]; 0: it is straight
    turns: NotNegative = 0.0  # of the coil

    def check(self) -> None:
        super().check()
        _require_one_or_as_many("tube.radii", self.radii, self.path)
        if (self.coil > 0) != (self.turns > 0):
            raise ValueError(f"tube.coil is {self.coil} and turns {self.turns}; give both, or neither")

    def surface(self) -> Float[np.ndarray, "a b 3"]:
        s = np.linspace(0, 1, max(ROWS, int(28 * self.turns)))
        middle = _curve(self.path, s)
        if self.coil:
            _, side, across = _frames(middle)
            phase = 2 * np.pi * self.turns * s[:, None]
            middle = middle + self.coil * (np.cos(phase) * side + np.sin(phase) * across)
        radius = _along(self.radii, s)
        _, side, across = _frames(middle)
        angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)[:, None]
        ring = np.cos(angle) * side[:, None] + np.sin(angle) * across[:, None]
        out = middle[:, None] + radius[:, None, None] * ring
        ends = np.broadcast_to(middle[[0, -1], None], (2, *out.shape[1:]))
        return np.concatenate([ends[:1], out, ends[1:]])


@dataclass(frozen=True, kw_only=True)
class Turned(AbstractShape):
    """The profile begins and ends on the axis, or ends where it begins."""

    profile: Annotated[tuple[tuple[NotNegative, float], ...], MinLen(3)]  # (r, z) [m]
    smooth: bool = True  # a curve through the points; else straight lines
    flutes: Annotated[int, Ge(0), Le(100)] = 0  # n around the rim
    flute_depth: Annotated[float, Ge(0), Le(0.5)] = 0.0  # e
    curls: Annotated[int, Ge(0), Le(100)] = 0  # n around the rim
    curl_height: float = 0.0  # h at the rim; it grows with the square of r from the axis, or the inner edge [m]
    foot: Place = (0.0, 0.0, 0.0)  # where the profile's (0, 0) stands [m]
    turn: Turn = (0.0, 0.0, 0.0)  # about x, then y, then z [deg]

    def check(self) -> None:
        super().check()
        first, last = self.profile[0], self.profile[-1]
        if tuple(first) != tuple(last) and (first[0] or last[0]):
            raise ValueError(
                f"turned.profile begins at {tuple(first)} and ends at {tuple(last)}; take points with r = 0, or one "
                "and the same"
            )

    def surface(self) -> Float[np.ndarray, "a b 3"]:
        given = np.array(self.profile, np.float64)
        s = np.unique(np.concatenate([np.linspace(0, 1, ROWS), _lengths(given)]))
        r, z = _along(given, s, smooth=self.smooth).T
        angle = np.linspace(0, 2 * np.pi, 2 * AROUND, endpoint=False)
        inner = given[:, 0].min()
        rim = ((r - inner) / max(given[:, 0].max() - inner, 1e-12)) ** 2
        radius = r[:, None] * (1 + self.flute_depth * np.cos(self.flutes * angle))
        height = z[:, None] + self.curl_height * rim[:, None] * np.cos(self.curls * angle)
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
        return _placed(points, self.turn, self.foot)


@dataclass(frozen=True, kw_only=True)
class Sheet(AbstractShape):
    path: Annotated[tuple[Place, ...], MinLen(2)]  # of its middle [m]
    across: Direction  # along its width, about square to the path
    half_widths: Annotated[tuple[NotNegative, ...], MinLen(1)]  # at these points; one: everywhere [m]
    thickness: Length  # from face to face [m]
    fold: float = 0.0  # how far its edges are lifted, over their distance from the middle
    lobes: NotNegative = 0.0  # how far the edges reach back behind the first point, as those of a heart do [m]
    waves: NotNegative = 0.0  # of its edges [m]
    veins: Count | None = None  # ribs of the second colour on each side of the middle, and one along it

    def check(self) -> None:
        super().check()
        _require_one_or_as_many("sheet.half_widths", self.half_widths, self.path)

    def middle(self, s: Float[np.ndarray, " a"], u: Float[np.ndarray, " b"]) -> Float[np.ndarray, "a b 3"]:
        """Points halfway through it: s from 0 to 1 along it, u from -1 to 1 across [m]."""
        line, tangent, across, normal = self._axes(s)
        half = np.maximum(_along(self.half_widths, s, smooth=True), 0.0)
        wide = half[:, None] * u
        lift = self.fold * np.abs(wide) + self.waves * u**2 * np.sin(18 * s[:, None] + 3 * u)
        back = self.lobes * u**2 * np.maximum(1 - 2.5 * s[:, None], 0.0)
        return (
            line[:, None]
            + wide[..., None] * across[:, None]
            + lift[..., None] * normal[:, None]
            - back[..., None] * tangent[:, None]
        )

    def _axes(self, s: Float[np.ndarray, " a"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        line = _curve(self.path, s)
        tangent = _unit(np.gradient(_curve(self.path, np.linspace(0, 1, 400)), axis=0))
        tangent = _unit(np.stack([np.interp(s, np.linspace(0, 1, 400), t) for t in tangent.T], -1))
        across = _unit(np.array(self.across, np.float64) - tangent * (tangent @ np.array(self.across))[:, None])
        return line, tangent, across, np.cross(tangent, across)

    def surface(self) -> Float[np.ndarray, "a b 3"]:
        s, u = np.linspace(0, 1, ROWS), np.linspace(-1, 1, 33)
        middle = self.middle(s, u)
        normal = self._axes(s)[3][:, None]
        above, below = middle + self.thickness / 2 * normal, middle - self.thickness / 2 * normal
        out = np.concatenate([above, below[:, ::-1]], 1)
        ends = np.concatenate([middle, middle[:, ::-1]], 1)[[0, -1]]
        return np.concatenate([ends[:1], out, ends[1:]])

    def tone(self, along: Float[np.ndarray, " a"], around: int) -> Float[np.ndarray, "a b"]:
        share = super().tone(along, around)
        if self.veins is None:
            return share
        u = np.linspace(-1, 1, around // 2)
        u = np.abs(np.concatenate([u, u[::-1]]))
        s = along[:, None]
        # ribs leave the middle at equal distances and bend towards the tip
        rib = np.abs(((self.veins * (s - 0.28 * u) + 0.5) % 1) - 0.5) / self.veins
        ribs = np.exp(-((rib / 0.016) ** 2)) * (u < 0.86) + np.exp(-((u / 0.07) ** 2)) + 0.8 * (u > 0.94)
        return np.clip(np.maximum(share, ribs), 0, 1)

    def layer(self, spacing: float) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]]:
        """Points about a spacing apart halfway through it, and the volume that each stands for [m^3]."""
        fine = self.middle(np.linspace(0, 1, 200), np.linspace(-1, 1, 3))
        length = np.linalg.norm(np.diff(fine[:, 1], axis=0), axis=1).sum()
        rows = max(2, round(length / spacing))
        at = (np.arange(rows) + 0.5) / rows
        placed, stands_for = [], []
        for s in at:
            ends = np.array([s - 0.5 / rows, s, s + 0.5 / rows])
            width = 2 * float(np.interp(s, np.linspace(0, 1, 200), _half(fine)))
            columns = max(1, round(width / spacing))
            edges = np.linspace(-1, 1, columns + 1)
            corner = self.middle(ends, edges)
            placed.append(self.middle(ends, (edges[1:] + edges[:-1]) / 2)[1])
            diagonals = corner[2, 1:] - corner[0, :-1], corner[2, :-1] - corner[0, 1:]
            stands_for.append(self.thickness * np.linalg.norm(np.cross(*diagonals), axis=-1) / 2)
        volume = np.concatenate(stands_for)
        keep = volume > 0
        copies = [_about_z(2 * np.pi * k / self.copies) for k in range(self.copies)]
        points = np.concatenate(placed)[keep]
        return np.concatenate([points @ turn.T for turn in copies]), np.tile(volume[keep], self.copies)


def _half(fine: np.ndarray) -> np.ndarray:
    return np.linalg.norm(fine[:, 2] - fine[:, 0], axis=-1) / 2


def _require_one_or_as_many(name: str, values: tuple, points: tuple) -> None:
    if len(values) not in (1, len(points)):
        raise ValueError(f"{name} has {len(values)} values and path {len(points)} points; take one value, or as many")


def _lengths(points: np.ndarray) -> np.ndarray:
    """Share of the length at each of them, 0..1."""
    step = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-12)
    return np.concatenate([[0.0], np.cumsum(step) / step.sum()])


def _along(values, s: np.ndarray, *, smooth: bool = False) -> np.ndarray:
    """Values [k] or [k, d] at equal shares of the length, or a polygon's at those of its own, at `s`."""
    from scipy.interpolate import PchipInterpolator, interp1d

    values = np.array(values, np.float64)
    if len(values) == 1:
        return np.broadcast_to(values[0], (len(s), *values.shape[1:]))
    at = _lengths(values) if values.ndim == 2 else np.linspace(0, 1, len(values))
    at[-1] = 1.0
    return (PchipInterpolator(at, values) if smooth and len(values) > 2 else interp1d(at, values, axis=0))(s)


def _curve(points, s: np.ndarray) -> Float[np.ndarray, "a 3"]:
    """A smooth curve through points at equal steps of s."""
    from scipy.interpolate import CubicSpline

    points = np.array(points, np.float64)
    at = np.linspace(0, 1, len(points))
    if len(points) == 2:
        return points[0] + s[:, None] * (points[1] - points[0])
    return CubicSpline(at, points, bc_type="natural")(s)


def _frames(line: Float[np.ndarray, "a 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangent and two normals at every point, each turned as little as can be from the one before."""
    tangent = _unit(np.gradient(line, axis=0))
    side = np.empty_like(tangent)
    first = np.cross(tangent[0], np.eye(3)[np.abs(tangent[0]).argmin()])
    for i, t in enumerate(tangent):
        first = first - t * (first @ t)
        first = first / np.linalg.norm(first)
        side[i] = first
    return tangent, side, np.cross(tangent, side)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def _placed(points: np.ndarray, turn: Turn, at: Place) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return points @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix().T + np.array(at)


def _about_z(angle: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _turned_about_z(mesh: Mesh, angle: float) -> Mesh:
    turn = _about_z(angle)
    anchor = None if mesh.anchor is None else tuple((turn @ np.array(mesh.anchor)).tolist())
    return replace(mesh, vertices=(mesh.vertices @ turn.T).astype(np.float32), anchor=anchor)
