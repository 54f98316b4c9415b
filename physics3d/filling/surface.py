"""Gaussians -> samples of the surface that they show, about half a spacing apart, with outward normals.

    samples    every Gaussian spread over its disc, averaged over voxels of half a spacing
    normals    least axis of the local covariance; outward is the side from which more of the sky is seen (what the body
               stands on or leans against hides the sky)
    thin       both sides see the sky alike (a petal, a leaf), or cameras see past it on both sides, less than a spacing
               apart; such samples bound no volume
    place      where the photographs' cameras see the surface (`seen.py`), and not below what the body stands on
               (`ground.py`), into which its sides go on; without cameras a deviation outside the Gaussians' centres

All lengths in metres.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from physics3d.filling.enclosure import DIRECTIONS, Enclosure
from physics3d.filling.ground import Ground
from physics3d.filling.seen import LIMB, Seen
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log

LEAST_SEEN = (
    0.1  # share of the samples of solid parts that cameras must see; fits of the scenes in conf/ have 0.66 and more
)
RIM = (0.5, 2.0)  # height above the ground of samples whose sides go on below it [spacings]
DEEP = 2.0  # they go on at most so far [spacings]
THIN = 1.0  # what cameras see past on both sides of, this far apart, bounds no volume either [spacings]
LEVEL = 0.7  # cosine to the ground's normal from which a sample is no side


@dataclass(frozen=True)
class Surface:
    """Samples of the surface that the Gaussians show, about half a spacing apart."""

    point: np.ndarray  # [m, 3] [m]
    normal: np.ndarray  # [m, 3] unit, outward
    enclosure: "Enclosure"  # where the samples are met by rays
    thin: np.ndarray  # [m] bool: both sides see the sky
    hidden: np.ndarray  # [m] bool: neither side does, or no camera sees a surface near it
    # [m] standard deviation of where it is, as cameras tell it [m], infinite where none sees it; None without cameras
    doubt: np.ndarray | None = None


def sample_surface(
    gaussians: Gaussians,
    spacing: float,
    *,
    detail: float | None = None,
    beside: Gaussians | None = None,
    view: Seen | None = None,
    below: Ground | None = None,
    log: Log = Log(None),
) -> tuple[Surface, np.ndarray]:
    """Samples about half of `detail` [m] apart, and the least deviation [m] of the Gaussians at each.

    None is `spacing` [m], that of the particles: whatever the detail, it says what is thin and what is enclosed.
    `beside` are Gaussians that do not belong to the body but hide the sky: what it stands on or leans against. `view`
    is what cameras see: samples of solid parts are moved onto its surface, those not near it are inside and left out;
    `below` closes it where it stands or leans.
    """
    detail = spacing if detail is None else detail
    step = detail / 2
    point, owner = over_discs(gaussians, step)
    gap = np.quantile(cKDTree(point).query(point, k=2)[0][:, 1], 0.95)
    h = max(0.75 * spacing, 1.5 * gap)
    walls = point
    if beside is not None and len(beside):
        reach = 0.25 * np.ptp(point, 0).max()
        around, _ = over_discs(beside, h)
        near = ((around > point.min(0) - reach) & (around < point.max(0) + reach)).all(1)
        walls = np.concatenate([point, around[near]])

    point, axis, deviation = _averaged(gaussians, point, owner, step)
    enclosure = Enclosure(walls, h)
    normal, thin, hidden = _towards_the_sky(point, axis, enclosure)
    if view is None:
        # what is seen of a fitted Gaussian is its outer side, a deviation away from its centre
        outward = np.where(thin | hidden, 0.0, deviation)[:, None] * normal
        return Surface(point + outward, normal, enclosure, thin=thin, hidden=hidden), deviation

    side = THIN / 2 * spacing * axis
    thin |= ~hidden & (view.distance_at(point + side) > 0) & (view.distance_at(point - side) > 0)
    solid = ~thin & ~hidden
    point, normal, found = _settled(point, normal, deviation, solid, view, detail, log)
    hidden, doubt = hidden | (solid & ~found), view.doubt_at(point)
    if below is not None:
        end, downwards = _ends_below(view, below, detail)
        side, outwards = _sides_below(point[solid & found], normal[solid & found], view, below, detail)
        point, normal = np.concatenate([point, end, side]), np.concatenate([normal, downwards, outwards])
        none = np.zeros(len(end) + len(side))
        thin, hidden = (np.concatenate([a, none > 0]) for a in (thin, hidden))
        deviation = np.concatenate([deviation, none])
        doubt = np.concatenate([doubt, below.doubt(end), below.doubt(side)])
    # what is filled reaches out to the samples where they are now
    enclosure = Enclosure(np.concatenate([walls, point]), h)
    return Surface(point, normal, enclosure, thin=thin, hidden=hidden, doubt=doubt), deviation


def over_discs(gaussians: Gaussians, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [k, 3] [m] at most `step` apart over one deviation of every disc, and the Gaussian [k] that each is of."""
    scale, order = torch.exp(gaussians.log_scale.double()).sort(dim=1)
    axes = torch.gather(gaussians.rotation().double(), 2, order[:, None, :].expand(-1, 3, -1)).numpy()
    scale, mean = scale.numpy(), gaussians.mean.double().numpy()  # type: ignore[assignment]
    points, owners = [], []
    counts = np.clip(2 * np.ceil(scale[:, 1:] / step - 0.5).astype(int) + 1, 1, 25)  # odd, so that the centre is one
    for a, b in np.unique(counts, axis=0):
        at = np.flatnonzero((counts == (a, b)).all(1))
        s, t = np.meshgrid(np.linspace(-1, 1, a) if a > 1 else [0.0], np.linspace(-1, 1, b) if b > 1 else [0.0])
        s, t = (v.reshape(-1)[s.reshape(-1) ** 2 + t.reshape(-1) ** 2 <= 1 + 1e-9] for v in (s, t))
        first = s[:, None] * (scale[at, 1, None] * axes[at, :, 1])[:, None, :]
        second = t[:, None] * (scale[at, 2, None] * axes[at, :, 2])[:, None, :]
        points.append((mean[at, None, :] + first + second).reshape(-1, 3))
        owners.append(np.repeat(at, len(s)))
    return np.concatenate(points), np.concatenate(owners)


def _averaged(
    gaussians: Gaussians, point: np.ndarray, owner: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One sample per voxel of size `step`, the mean of what lies in it: place, least axis, least deviation there."""
    _, group = np.unique(np.floor(point / step).astype(np.int64), axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group).astype(float)
    average = lambda v: np.bincount(group, weights=v) / count
    point = np.stack([average(point[:, k]) for k in range(3)], 1)
    deviation = average(torch.exp(gaussians.log_scale.double()).amin(1).numpy()[owner])
    shape = gaussians.covariance().double().numpy()[owner]
    shape = np.stack([average(shape[:, i, j]) for i in range(3) for j in range(3)], 1).reshape(-1, 3, 3)

    neighbours = cKDTree(point).query(point, k=min(12, len(point)))[1]
    offset = point[neighbours] - point[neighbours].mean(1, keepdims=True)
    shape = shape + np.einsum("nki,nkj->nij", offset, offset) / neighbours.shape[1]
    return point, np.linalg.eigh(shape)[1][:, :, 0], deviation


def _towards_the_sky(
    point: np.ndarray, axis: np.ndarray, enclosure: Enclosure
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outward normals of samples with that least axis; which are thin; which are hidden.

    The sky is looked at from both sides, from one and a half voxels off the surface: thinner walls are thin parts;
    directions along the surface count a little, because from the bottom of a cup only straight up is free.
    """
    cosine = axis @ (DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)).T
    sky = []
    for side in (1, -1):
        weight = np.where(side * cosine > -0.2, np.maximum(side * cosine, 0.2), 0)
        free = ~enclosure.directions(point + side * 1.5 * enclosure.h * axis)
        sky.append((free * weight).sum(1) / weight.sum(1))
    front, back = sky
    more, less = np.maximum(front, back), np.minimum(front, back)
    return np.where((front >= back)[:, None], axis, -axis), (less > 0.6 * more) & (more > 0.02), more <= 0.02


def _settled(
    point: np.ndarray,
    normal: np.ndarray,
    deviation: np.ndarray,
    solid: np.ndarray,
    view: Seen,
    spacing: float,
    log: Log,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples of solid parts moved onto the surface that cameras see, their normals there, and which found it.

    They start where Gaussians show, `LIMB` deviations outside of their centres.
    """
    moved, outside, found = view.settled(point + LIMB * deviation[:, None] * normal, 1.5 * spacing)
    share = float(found[solid].mean()) if solid.any() else 1.0
    log.info(f"{100 * share:.0f} % of the samples of solid parts are near the surface that the cameras see")
    if share < LEAST_SEEN:
        if np.median(deviation[solid]) > 0.75 * spacing:
            raise ValueError(
                f"the Gaussians of the body are {2e3 * np.median(deviation[solid]):.3g} mm thick, and its particles "
                f"{1e3 * spacing:.3g} mm apart: no surface can be seen so well; reconstruct longer or with more "
                "Gaussians, or take a larger scene.spacing and scene.dx"
            )
        raise ValueError(
            f"the cameras see the surface of the body near {100 * share:.1f} % of its Gaussians only; cameras, "
            "Gaussians and labels do not belong together: look at the previews of reconstruct and segment"
        )
    point, normal = (np.where((solid & found)[:, None], a, b) for a, b in ((moved, point), (outside, normal)))
    return point, normal, found


def _ends_below(view: Seen, below: Ground, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Where no camera sees the body it ends as far below the ground as that is in doubt: samples and normals."""
    under = view.deep(below.hidden) & ~view.beside(below.hidden)
    end = below.hidden - (spacing + below.doubt(below.hidden))[:, None] * below.normal
    return end[under], -below.normal[under]


def _sides_below(
    point: np.ndarray, normal: np.ndarray, view: Seen, below: Ground, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Down to these ends the sides go on as they are seen above the ground: samples [k, 3] [m] and outward normals,
    of those of solid parts that were found.

    Else the body would be rounded off where it is held: a stem whose section shrinks to a third on its way into the
    soil bends there.
    """
    high = -below.behind(point)
    rim = np.flatnonzero((high > RIM[0] * spacing) & (high < RIM[1] * spacing))
    if not len(rim) or not len(below.hidden):
        return np.zeros((0, 3)), np.zeros((0, 3))
    up = below.normal[cKDTree(below.hidden).query(point[rim], k=min(8, len(below.hidden)))[1]]
    up = up.reshape(len(rim), -1, 3).mean(1)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    steep = np.abs((up * normal[rim]).sum(1)) < LEVEL
    rim, up = rim[steep], up[steep]
    along = up - (up * normal[rim]).sum(1, keepdims=True) * normal[rim]  # of the side itself
    along /= (along * up).sum(1, keepdims=True)
    depth = np.arange(1, 2 * (RIM[1] + DEEP) + 1) * spacing / 2
    side = (point[rim, None] - depth[None, :, None] * along[:, None]).reshape(-1, 3)
    outward = np.repeat(normal[rim], len(depth), 0)
    behind = below.behind(side)
    on = (behind > 0) & (behind < np.minimum(spacing + below.doubt(side), DEEP * spacing)) & view.deep(side)
    return side[on], outward[on]
