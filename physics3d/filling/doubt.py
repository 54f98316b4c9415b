"""How far the surface of a filled body is in doubt, and what stiffness and mass that leaves open.

    shown      delta as the cameras tell it (`seen.py`), or what is unknown of the ground below (`ground.py`)
    not shown  a surface that closes the body where no photograph looks. Whether what was filled behind it is there,
               nobody knows: its depth t, to the nearest surface that is shown, is uniform between none and all of it,
               and delta = t/sqrt(3) is as much of t as the deviation of such a depth is of its mean

A piece of the surface of area A that lies one delta farther out adds dV = A delta there, and to a motion u

    d ln K = sum_pieces e dV / int e dV       d ln M = sum_pieces |v|^2 dV / int |v|^2 dV       e = |E|^2

with E Green's strain (the derivative of an integral by its boundary, Hadamard 1908; in a mode, Rayleigh's quotient to
first order). Of a plate of thickness t that bends, whose one face moves by delta, d ln K = 3 delta/t; of a rod of
radius r whose surface does, 4 delta/r. All of the surface is in doubt in the same direction: what is wrong is how
deep the centres of fitted Gaussians lie, which is the same all over a body. Lengths in metres.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.log import Log
from physics3d.matter import Matter

NEAR = 1.0  # of the scale of the surface: what lies as far from where it is shown is shown as well
UNIFORM = 1 / math.sqrt(3)  # deviation of a depth that is uniform from none on, of its mean
MUCH = 0.1  # of the surface that no photograph shows: said
AROUND = 12  # particles by which strain is carried on to the surface
SIDES = (("+x", "-x"), ("+y", "-y"), ("above", "below"))
TOWARDS = 0.3  # mean component of normals along an axis, from which that is where they look


@dataclass(frozen=True, kw_only=True)
class Doubt(AbstractArtifact):
    """k pieces of the surface of a body; float64."""

    position: Float[Tensor, "k 3"]  # [m]
    volume: Float[Tensor, " k"]  # dV, of one standard deviation [m^3]
    shown: Bool[Tensor, " k"]  # by a photograph

    def check(self) -> None:
        if not self.position.shape == (len(self.volume), 3) == (len(self.shown), 3):
            raise ValueError(
                f"Doubt: position {tuple(self.position.shape)}, volume and shown must have as many rows, [k, 3] and [k]"
            )
        require_finite("Doubt.position", self.position)
        require_finite("Doubt.volume", self.volume)


@dataclass(frozen=True, kw_only=True)
class Widths:
    """Relative standard deviations of the body's stiffness and mass in a motion, by where its surface is."""

    stiffness: float
    mass: float
    unshown: float  # the share of `stiffness` squared that is of what no photograph shows


def doubt_of(
    matter: Matter,
    point: Float[np.ndarray, "m 3"],
    delta: Float[np.ndarray, " m"],
    scale: float,
    log: Log,
) -> Doubt:
    """Of a solid body of these pieces of matter. `point`: where its surface is shown, to within `delta` [m]; `scale` at
    which that was looked at [m]. It is said if much is not shown."""
    x, side, area = faces(matter)
    distance, nearest = cKDTree(point).query(x)
    shown = distance < NEAR * scale + matter.size / 2
    width = np.where(shown, delta[nearest], UNIFORM * distance)
    if (share := float(area[~shown].sum() / area.sum())) > MUCH:
        mean = ((area[:, None] * side)[~shown]).sum(0) / area[~shown].sum()
        axis = int(np.abs(mean).argmax())
        where = SIDES[axis][int(mean[axis] < 0)] if abs(mean[axis]) > TOWARDS else "its other sides"
        log.warn(
            f"no photograph shows {100 * share:.0f} % of the body's surface: how thick it is there is guessed, and "
            f"what is learned will be as uncertain; photograph it from {where} as well"
        )
    log.metric("surface_not_shown", share)
    return Doubt(
        position=torch.from_numpy(x),
        volume=torch.from_numpy(area * width),
        shown=torch.from_numpy(shown),
    )


def faces(
    matter: Matter,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """The pieces of matter at the boundary, as places on it [m], which way it looks there, and how large it is [m^2].

    A piece is a cube of the lattice; one without a neighbour on a side has a face there, and its faces together make up
    its piece of the surface: their vectors add up to A n."""
    x, edge = matter.position.numpy(), matter.size
    tree = cKDTree(x)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    alone = np.stack([tree.query(x + edge * axis)[0] > 0.75 * edge for axis in axes], 1)
    bare = alone.any(1)
    both = alone[:, :3].astype(float) + alone[:, 3:]  # a layer one piece thick has two faces on one axis
    outward = alone[:, :3].astype(float) - alone[:, 3:]
    area = edge**2 * np.linalg.norm(both, axis=1)
    size = np.linalg.norm(outward, axis=1, keepdims=True)
    side = outward / np.maximum(size, 1)
    return (x + 0.5 * edge * side)[bare], side[bare], area[bare]


def widths(
    doubt: Doubt,
    position: Float[Tensor, "p 3"],
    volume: Float[Tensor, " p"],
    deformation: Float[Tensor, "t p 3 3"],
    velocity: Float[Tensor, "t p 3"],
) -> Widths:
    """What the doubt of a body's surface leaves open in this motion of its particles at `position` at rest: F and the
    velocity [m/s], or either of a mode, in any unit."""
    x, V = (a.detach().cpu().double().numpy() for a in (position, volume))
    F, v = (a.detach().cpu().double().numpy() for a in (deformation, velocity))
    strain = 0.5 * (np.swapaxes(F, -1, -2) @ F - np.eye(3))
    strain, v = (np.moveaxis(a.reshape(len(a), len(x), -1), 0, 1) for a in (strain, v))  # [p, t, 9], [p, t, 3]
    at = _carried_on(doubt.position.numpy(), x, np.concatenate([strain, v], -1))
    e, speed = (at[..., :9] ** 2).sum((1, 2)), (at[..., 9:] ** 2).sum((1, 2))
    inside = (strain**2).sum((1, 2)) @ V, (v**2).sum((1, 2)) @ V
    dV, shown = doubt.volume.numpy(), doubt.shown.numpy()
    share = lambda value, of, which: float((value * dV)[which].sum() / max(of, 1e-300))
    stiff = [share(e, inside[0], which) for which in (shown, ~shown)]
    mass = [share(speed, inside[1], which) for which in (shown, ~shown)]
    whole = math.hypot(*stiff)
    return Widths(stiffness=whole, mass=math.hypot(*mass), unshown=stiff[1] ** 2 / max(whole**2, 1e-300))


def _carried_on(
    place: Float[np.ndarray, "k 3"], x: Float[np.ndarray, "p 3"], value: Float[np.ndarray, "p t c"]
) -> Float[np.ndarray, "k t c"]:
    """Values at places on the surface, by the plane through those of the particles around it: strain of what bends is
    greatest there, and particles lie within."""
    count = min(AROUND, len(x))
    distance, near = cKDTree(x).query(place, k=count)
    distance, near = distance.reshape(len(place), count), near.reshape(len(place), count)
    offset = x[near] - place[:, None]
    scale = distance[:, -1:].clip(1e-12)
    A = np.concatenate([np.ones((*near.shape, 1)), offset / scale[..., None]], -1)
    # particles in one layer say nothing of how values change across it, and then nothing is added
    AA = np.swapaxes(A, 1, 2) @ A + 1e-2 * count * np.diag([0.0, 1.0, 1.0, 1.0])
    weight = np.linalg.solve(AA, np.swapaxes(A, 1, 2))[:, 0]  # [k, count]
    return np.einsum("kn,kntc->ktc", weight, value[near], optimize=True)
