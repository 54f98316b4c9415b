"""The shape of the carnation twin, in metres: stem, calyx, sepals, petals and leaves; pot, soil, table and backdrop.

Everything is a parametrised surface with vertex colours. z is up, the table is at z = 0, the pot stands at the origin.
"""

from dataclasses import replace

import numpy as np

from physics3d.scenes.room import room
from physics3d.scenes.studio import Mesh, joined, smooth_noise, surface_grid, to_linear

SOIL = 0.072  # height of the soil [m]
STEM_TOP = 0.190  # height where the calyx begins [m]
STEM_RADIUS = (0.0130, 0.0112)  # at the soil and at the top [m]
BLOOM = (0.042, 0.034)  # half width and height of the visible blossom [m]
DOME = (0.040, 0.031)  # the same of the space that the petals fill, all but their frills [m]
PETALS = 52
GOLDEN = np.pi * (3 - 5**0.5)
# position along the stem, azimuth [rad], length [m]
LEAVES = ((0.36, 0.5, 0.060), (0.38, 0.5 + np.pi, 0.066), (0.62, 2.2, 0.050), (0.63, 2.2 + np.pi, 0.046))


def stem_curve(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre line, s = 0 at the root inside the soil, 1 at the calyx -> position [n, 3] [m], unit tangent [n, 3]."""
    s = np.asarray(s, np.float64)
    root = SOIL - 0.03
    position = np.stack([0.036 * s**2 - 0.010 * s**3, -0.008 * s**2, root + (STEM_TOP - root) * s], -1)
    tangent = np.stack([0.072 * s - 0.030 * s**2, -0.016 * s, np.full_like(s, STEM_TOP - root)], -1)
    return position, tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)


def frame_at_top() -> tuple[np.ndarray, np.ndarray]:
    """Where the calyx begins [3], and the axes of the blossom as columns [3, 3], the last along the stem."""
    position, tangent = stem_curve(np.array(1.0))
    z = tangent
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return position, np.stack([x, np.cross(z, x), z], 1)


def blossom_centre() -> tuple[float, float, float]:
    top, axes = frame_at_top()
    return tuple((top + axes @ [0.0, 0.0, 0.038]).round(4).tolist())


def revolved(
    radius: np.ndarray,
    height: np.ndarray,
    colour: tuple[float, float, float],
    around: int = 40,
    variation: float = 0.0,
    rng=None,
) -> Mesh:
    """Surface of revolution about z through (radius, height) [m]; `colour` in sRGB, mottled by `variation`."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    position = np.stack(
        [
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            np.broadcast_to(height[:, None], (len(radius), around)),
        ],
        -1,
    )
    albedo = np.broadcast_to(to_linear(np.array(colour)), position.shape)
    if rng is not None:
        albedo = albedo * (1 + variation * smooth_noise(rng, len(radius), around)[..., None])
    return surface_grid(position, albedo, closed_b=True)


def plant(seed: int) -> tuple[list[Mesh], list[Mesh]]:
    """What moves -> (visible meshes, closed meshes that hold the material)."""
    rng = np.random.default_rng(seed)
    top, axes = frame_at_top()
    stem = _tube(rng)
    calyx = _calyx(rng, top, axes)
    dome = _placed(_dome(), top, axes)
    leaves = [_leaf(rng, s, angle, length) for s, angle, length in LEAVES]
    sepals = [_placed(_sepal(rng, i), top, axes) for i in range(6)]
    petals = [_placed(_petal(rng, i), top, axes) for i in range(PETALS)]
    return [joined([stem, calyx, *sepals]), *leaves, joined(petals)], [stem, calyx, dome]


def _placed(mesh: Mesh, origin: np.ndarray, axes: np.ndarray) -> Mesh:
    return replace(mesh, vertices=(mesh.vertices @ axes.T + origin).astype(np.float32))


def _tube(rng) -> Mesh:
    """The stem, closed at both ends, with two slightly swollen nodes."""
    s = np.concatenate([[0.0], np.linspace(0, 1, 48), [1.0]])
    centre, tangent = stem_curve(s)
    radius = STEM_RADIUS[0] + (STEM_RADIUS[1] - STEM_RADIUS[0]) * s
    for node in (0.37, 0.625):
        radius = radius + 0.0010 * np.exp(-(((s - node) / 0.02) ** 2))
    radius[0] = radius[-1] = 0
    side = np.cross([0.0, 1.0, 0.0], tangent)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    across = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    ring_ = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * across[:, None]
    position = centre[:, None] + radius[:, None, None] * ring_
    albedo = to_linear(np.array((0.44, 0.60, 0.36))) * (
        1 + 0.18 * smooth_noise(rng, len(s), 28, cells=(14, 7))[..., None]
    )
    lighter = np.exp(-(((s - 0.37) / 0.02) ** 2)) + np.exp(-(((s - 0.625) / 0.02) ** 2))
    return surface_grid(position, albedo * (1 + 0.35 * lighter[:, None, None]), closed_b=True, moves=True)


def _calyx(rng, top, axes) -> Mesh:
    """The green cup under the petals, closed."""
    z = np.array([-0.004, -0.004, 0.0, 0.006, 0.013, 0.020, 0.026, 0.026])
    r = np.array([0.0, 0.0108, 0.0122, 0.0148, 0.0162, 0.0165, 0.0160, 0.0])
    fine = np.linspace(0, len(z) - 1, 40)
    mesh = revolved(np.interp(fine, range(8), r), np.interp(fine, range(8), z), (0.47, 0.62, 0.38), 32, 0.15, rng)
    return _placed(mesh, top, axes)


def _dome() -> Mesh:
    """The space that the petals fill: a flattened dome over the calyx, closed, slightly inside the petals' edges."""
    t = np.linspace(0, np.pi, 30)
    width, height = DOME
    r = width * np.sin(t) ** 0.9
    z = 0.032 - np.cos(t) * np.where(t < np.pi / 2, 0.012, height - 0.006)
    r[0] = r[-1] = 0
    return revolved(r, z, (0.9, 0.4, 0.5))


def _sepal(rng, i: int) -> Mesh:
    """One pointed green tooth of the calyx, bent outward."""
    v, u = np.meshgrid(np.linspace(0, 1, 14), np.linspace(-1, 1, 9), indexing="ij")
    angle = i * np.pi / 3 + u * 0.56 * (1 - v**1.6) * (1 - 0.1 * v)
    r = 0.0168 + 0.0015 * np.sin(np.pi * v) + 0.012 * v**2
    z = 0.006 + 0.027 * v - 0.006 * v**3
    position = np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
    tone = 0.95 + 0.25 * v - 0.1 * np.abs(u) + 0.04 * rng.normal()
    return surface_grid(position, to_linear(np.array((0.46, 0.63, 0.36))) * tone[..., None], translucency=0.2)


def _petal(rng, i: int) -> Mesh:
    """A fan with a narrow claw in the calyx and a ruffled, toothed edge; inner petals stand, outer ones spread."""
    k = (i + 0.5) / PETALS
    opening = np.radians(4 + 96 * k**0.72) + 0.07 * rng.normal()
    azimuth = i * GOLDEN + 0.2 * rng.normal()
    v, u = np.meshgrid(np.linspace(0, 1, 18) ** 0.8, np.linspace(-1, 1, 37), indexing="ij")
    # centre line: up out of the calyx, then outward, a quadratic curve from the claw to the tip
    width, height = BLOOM
    tip = np.array([1.07 * width * np.sin(opening), 0.032 + 1.0 * (height - 0.004) * np.cos(opening)])
    tip *= 1 + 0.05 * rng.normal()
    claw = np.array([0.007 * k, 0.018])
    knee = np.array([0.003 + 0.012 * k, 0.028 + 0.016 * (1 - 0.4 * k)])
    tooth = np.abs(((u[-1] * 8.5 + rng.random()) % 1) - 0.5)  # sawtooth along the edge
    reach = 1 - 0.13 * u[-1] ** 2 - 0.10 * tooth - 0.03 * np.sin(9 * u[-1] + 6 * rng.random())
    t = v * (1 - (1 - reach) * v**2)
    line = ((1 - t) ** 2)[..., None] * claw + (2 * t * (1 - t))[..., None] * knee + (t**2)[..., None] * tip
    slope = (2 * (1 - t))[..., None] * (knee - claw) + (2 * t)[..., None] * (tip - knee)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    fan = (0.0150 + 0.0095 * k + 0.001 * rng.normal()) * (0.16 + 0.84 * v**0.9)
    # ruffles: waves across the fan that grow towards the edge
    phases = 2 * np.pi * rng.random(4)
    wave = (
        0.55 * np.sin(3.1 * u + phases[0])
        + 0.55 * np.sin(6.3 * u + phases[1] + 1.5 * v)
        + 0.40 * np.sin(11 * u + phases[2] - 2 * v)
        + 0.22 * np.sin(19 * u + phases[3])
    )
    lift = 0.0044 * v**1.7 * wave + 0.006 * (v**1.5) * u**2 * (0.4 - k)
    radial = line[..., 0] - slope[..., 1] * lift
    z = line[..., 1] + slope[..., 0] * lift
    sideways = fan * np.sin(1.15 * u) + 0.0012 * v**2 * np.sin(13 * u + phases[1])
    radial = radial - 0.35 * sideways**2 / 0.03 * (1 - 0.5 * k)  # the fan wraps around the axis
    position = np.stack([radial, sideways, z], -1)
    c, s = np.cos(azimuth), np.sin(azimuth)
    position = position @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    # paler and greenish in the claw, deep pink in the blade, light at the toothed edge, veins
    base, blade, edge = (to_linear(np.array(c)) for c in ((0.93, 0.86, 0.74), (0.93, 0.42, 0.58), (0.98, 0.72, 0.80)))
    tone = np.clip(1.6 * v, 0, 1)[..., None]
    rim = np.clip((v - 0.80) / 0.2, 0, 1)[..., None] ** 1.5
    albedo = (1 - tone) * base + tone * ((1 - 0.75 * rim) * blade + 0.75 * rim * edge)
    vein = 1 + 0.07 * np.cos(26 * u + 3 * np.sin(3 * v))
    albedo = albedo * (vein * (0.94 + 0.10 * rng.random()))[..., None]
    return surface_grid(position, albedo, translucency=0.45, moves=True)


def _leaf(rng, s: float, azimuth: float, length: float) -> Mesh:
    """A narrow grey-green leaf, folded along its middle, that leaves a node upward and bends over."""
    (start,), (tangent,) = stem_curve(np.array([s]))
    v, u = np.meshgrid(np.linspace(0, 1, 30), np.linspace(-1, 1, 9), indexing="ij")
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    out -= tangent * (out @ tangent)
    out /= np.linalg.norm(out)
    across = np.cross(tangent, out)
    rise = 0.75 + 0.1 * rng.normal()
    r = 0.008 + length * (0.86 * v + 0.1 * v**2)
    z = length * (rise * np.sin(1.9 * v) * 1.05 - 0.28 * v**2)
    width = 0.0062 * np.sqrt(np.clip(1 - v**3, 0, 1)) * (1 - 0.45 * v) + 0.0003
    sway = 0.006 * np.sin(2.5 * v + 6 * rng.random()) * v
    position = (
        start
        + r[..., None] * out
        + (z + 0.25 * width * np.abs(u))[..., None] * tangent
        + (width * u + sway)[..., None] * across
    )
    tone = 1 + 0.25 * np.exp(-((u / 0.15) ** 2)) - 0.12 * np.abs(u) + 0.1 * v
    return surface_grid(
        position,
        to_linear(np.array((0.43, 0.58, 0.42))) * tone[..., None],
        translucency=0.25,
        moves=True,
        anchor=tuple(start),
    )


def surroundings(seed: int) -> list[Mesh]:
    """Pot, soil, table and backdrop: photographed, never simulated."""
    rng = np.random.default_rng(seed + 1)
    # outside from the foot to the rim, over the rim, inside down to the soil
    profile = np.array(
        [
            (0.0, 0.0), (0.029, 0.0), (0.030, 0.002), (0.0365, 0.060), (0.0375, 0.0605), (0.0415, 0.061),
            (0.0425, 0.062),
            (0.0440, 0.079), (0.0432, 0.0805), (0.0405, 0.0805), (0.0395, 0.079), (0.0380, 0.060),
        ]
    )  # fmt: skip
    at = np.linspace(0, len(profile) - 1, 70)
    steps = np.arange(len(profile))
    pot = revolved(
        np.interp(at, steps, profile[:, 0]), np.interp(at, steps, profile[:, 1]), (0.78, 0.46, 0.32), 96, 0.22, rng
    )
    r, a = np.meshgrid(np.linspace(0, 0.0395, 40), np.linspace(0, 2 * np.pi, 90, endpoint=False), indexing="ij")
    bumps = 0.0022 * smooth_noise(rng, 40, 90, cells=(14, 40)) + 0.0012 * rng.normal(size=r.shape) * (r > 0.004)
    soil_tone = 1 + 0.5 * smooth_noise(rng, 40, 90, cells=(18, 45)) + 0.25 * rng.random(r.shape)
    soil = surface_grid(
        np.stack([r * np.cos(a), r * np.sin(a), SOIL + bumps], -1),
        to_linear(np.array((0.36, 0.27, 0.21))) * soil_tone[..., None],
        closed_b=True,
    )
    return [pot, soil, *room()]
