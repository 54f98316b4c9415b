"""Bodies with known volume, made of flat Gaussians on their surfaces, and captures of them; metres."""

import numpy as np
import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.scenes.base import Capture


def discs(point, normal, rng, *, sigma=0.0015, thickness=0.0003, noise=0.0, color=(0.5, 0.5, 0.5)) -> Gaussians:
    """One flat Gaussian per point of the surface, whose outer side lies on it; which side its least axis points to is
    random, as in a reconstruction."""
    n = len(point)
    point = point - thickness * normal + noise * rng.normal(size=point.shape)
    normal = normal * rng.choice([-1, 1], n)[:, None]
    quaternion = np.concatenate([1 + normal[:, 2:], np.cross([0.0, 0.0, 1.0], normal)], 1)
    quaternion[1 + normal[:, 2] < 1e-6] = (0, 1, 0, 0)
    tensor = lambda a: torch.from_numpy(np.ascontiguousarray(a)).float()
    return Gaussians(
        mean=tensor(point),
        log_scale=tensor(np.log(np.tile([sigma, sigma, thickness], (n, 1)))),
        quaternion=tensor(quaternion),
        opacity_logit=torch.full((n,), 2.2),
        sh=((torch.tensor(color) - 0.5) / 0.28209479177387814).float().expand(n, 1, 3).clone(),
    )


def joined(*gaussians: Gaussians) -> Gaussians:
    names = ("mean", "log_scale", "quaternion", "opacity_logit", "sh")
    return Gaussians(**{name: torch.cat([getattr(g, name) for g in gaussians]) for name in names})


def sphere(n, radius, rng):
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    return radius * p, p


def torus(n, large, small, rng):
    u, v = rng.uniform(0, 2 * np.pi, (2, 4 * n))
    k = np.flatnonzero(rng.uniform(size=4 * n) < (large + small * np.cos(v)) / (large + small))[:n]
    u, v = u[k], v[k]
    normal = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], 1)
    return small * normal + large * np.stack([np.cos(u), np.sin(u), 0 * u], 1), normal


def box(n, half, rng):
    half = np.array(half)
    area = half.prod() / half
    axis, side = rng.choice(3, n, p=area / area.sum()), rng.choice([-1, 1], n)
    normal = np.zeros((n, 3))
    normal[np.arange(n), axis] = side
    point = rng.uniform(-1, 1, (n, 3)) * half
    point[np.arange(n), axis] = side * half[axis]
    return point, normal


def wall(n, radius, z0, z1, rng, *, inward=False):
    a = rng.uniform(0, 2 * np.pi, n)
    normal = np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    point = radius * normal + np.stack([0 * a, 0 * a, rng.uniform(z0, z1, n)], 1)
    return point, -normal if inward else normal


def annulus(n, inner, outer, z, rng, *, up=1.0):
    r, a = np.sqrt(rng.uniform(inner**2, outer**2, n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([r * np.cos(a), r * np.sin(a), 0 * a + z], 1), np.tile([0.0, 0.0, up], (n, 1))


def cup(radius, thickness, height, rng, *, density=3e5):
    """Open at the top; walls and bottom of one thickness."""
    count = lambda area: int(density * area)
    r, t, h = radius, thickness, height
    return together(
        wall(count(2 * np.pi * r * h), r, 0, h, rng),
        wall(count(2 * np.pi * (r - t) * (h - t)), r - t, t, h, rng, inward=True),
        annulus(count(np.pi * r**2), 0, r, 0, rng, up=-1.0),
        annulus(count(np.pi * (r - t) ** 2), 0, r - t, t, rng),
        annulus(count(np.pi * (r**2 - (r - t) ** 2)), r - t, r, h, rng),
    )


def sheet(n, side, rng):
    """A square of the plane z = 0."""
    return rng.uniform(-side / 2, side / 2, (n, 3)) * [1, 1, 0], np.tile([0.0, 0.0, 1.0], (n, 1))


def together(*surfaces):
    return tuple(np.concatenate(parts) for parts in zip(*surfaces))


def cameras_around(count, distance, *, target=(0.0, 0.0, 0.0), elevation=0.5, size=(160, 120)) -> tuple[Camera, ...]:
    width, height = size
    centre = torch.tensor(target, dtype=torch.float64)
    found = []
    for k in range(count):
        a = 2 * np.pi * k / count
        offset = [np.cos(a) * np.cos(elevation), np.sin(a) * np.cos(elevation), np.sin(elevation)]
        pose = look_at(centre + distance * torch.tensor(offset, dtype=torch.float64), centre)
        found.append(
            Camera(width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2, world_to_camera=pose)
        )
    return tuple(found)


def captured(gaussians: Gaussians, cameras: tuple[Camera, ...], *, mattes_of: Gaussians | None = None) -> Capture:
    """Photographs of the Gaussians themselves; mattes of some of them if wanted."""
    picture = lambda c: (render(gaussians, c, background=(1.0, 1.0, 1.0)).color.clamp(0, 1) * 255).round().byte()
    matte = lambda c: (render(mattes_of, c, background=(0.0, 0.0, 0.0)).alpha.clamp(0, 1) * 255).round().byte()
    return Capture(
        name="analytic",
        images=tuple(picture(c) for c in cameras),
        cameras=cameras,
        names=tuple(f"view_{k:02d}.png" for k in range(len(cameras))),
        alphas=tuple(matte(c) for c in cameras) if mattes_of is not None else (),
    )


def spheres_on_table(rng) -> tuple[Gaussians, torch.Tensor, torch.Tensor]:
    """A red and a green ball (radius 5 and 4 cm) on a grey table: Gaussians, truth labels 0 table, 1 red, 2 green."""
    red, _ = sphere(3000, 0.05, rng)
    green, green_normal = sphere(2500, 0.04, rng)
    table = rng.uniform(-0.2, 0.2, (6000, 3)) * [1, 1, 0]
    table[:, 2] = -0.05
    parts = (
        discs(table, np.tile([0.0, 0.0, 1.0], (6000, 1)), rng, sigma=0.004, color=(0.6, 0.6, 0.65)),
        discs(red - np.array([0.06, 0, 0]), red / 0.05, rng, sigma=0.003, color=(0.8, 0.2, 0.15)),
        discs(green + np.array([0.06, 0, -0.01]), green_normal, rng, sigma=0.003, color=(0.2, 0.65, 0.3)),
    )
    truth = torch.cat([torch.full((len(g),), k) for k, g in enumerate(parts)])
    return joined(*parts), truth, torch.cat([g.opacity for g in parts])


def petal(n, rng, *, length=0.1, width=0.06, bend=0.06):
    """A sheet bent about the y axis with radius `bend`: (points, normals), area [m^2]."""
    s, t = rng.uniform(-length / 2, length / 2, n), rng.uniform(-width / 2, width / 2, n)
    a = s / bend
    normal = np.stack([np.sin(a), 0 * a, np.cos(a)], 1)
    return (bend * normal + t[:, None] * np.array([0.0, 1.0, 0.0]), normal), length * width
