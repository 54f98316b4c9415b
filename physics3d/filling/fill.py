"""Surface Gaussians -> particles of one size that also occupy the interior of solid parts, and none inside thin ones.

A reconstruction puts Gaussians on the visible surface only; a simulated body needs mass behind it.

    samples    every Gaussian above the opacity threshold, spread over its disc, without floaters
    normals    least axis of the local covariance; outward is the side from which more of the sky is seen (what the body
               stands on or leans against hides the sky)
    thin       both sides see the sky alike (a petal, a leaf); such samples bound no volume
    surface    where the photographs' cameras see it (`seen.py`), and not below what the body stands on
    inside     of the closed surface through the remaining samples (`Poisson`), or by `WindingNumber`
    particles  one per lattice cell of that volume, at the centroid of the part inside, V_p = its measure [m^3];
               plus one per spacing^2 of thin surface that no cell covers, V_p = area * thickness

so that sum V_p is the volume of the body. Cells of less than a quarter give their volume to the nearest particle.
Isolated pieces are named, and joined to the rest, dropped or kept; particles beside static Gaussians are marked.
Poisson reconstruction: Kazhdan, Hoppe (2013). All lengths in metres.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.spatial import Delaunay, QhullError, cKDTree
from torch import Tensor

from physics3d.artifact import AbstractArtifact, require_finite
from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.held_particles import HeldParticles
from physics3d.checks import Share
from physics3d.filling.seen import Ground, Seen, ground, seen
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.deform import Embedding, embed
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.open3d_import import open3d

DIRECTIONS = np.array(
    [d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
)  # [26, 3], towards voxel neighbours
MOST_CELLS = 160  # along one side of the lattice
LEAST_FRACTION = 0.25  # a cell filled less than this is no particle of its own
SUBDIVISION = 4  # samples along each side of a boundary cell
ISOLATED = ("attach", "drop", "keep")  # what may become of a piece
JOINT = 4.0  # widest gap that is bridged [spacings]: two cells of the simulation grid
CONTACT = (0.6, 1.0)  # particles nearer to a static Gaussian are held by it; at most, where none is so near [spacings]
LEAST_SEEN = (
    0.1  # share of the samples of solid parts that cameras must see; fits of the scenes in conf/ have 0.66 and more
)
SPECK = 0.05  # static clusters of less than this share are mistakes of the segmentation and hold nothing


@dataclass(frozen=True, kw_only=True)
class Body(AbstractArtifact):
    position: Float[Tensor, "p 3"]  # at rest [m]
    volume: Float[Tensor, " p"]  # [m^3]
    part: Int[Tensor, " p"]  # int32, 0-based index into the segmentation's parts
    interior: Bool[Tensor, " p"]  # put there by filling: farther than a spacing from every Gaussian
    spacing: float  # distance between neighbours [m]
    embedding: Embedding  # how the moving Gaussians ride on the particles
    attached: Bool[Tensor, " p"] | None = None  # beside something static, which holds them there; None: nothing is
    parts: tuple[str, ...] = ()  # names of the segmentation's parts; empty: they have none

    def held(self, boundaries: tuple[AbstractBoundary, ...]) -> tuple[AbstractBoundary, ...]:
        """What holds the body where it is attached: nothing if the scene's `boundaries` say where it is fixed."""
        if self.attached is None or not bool(self.attached.any()):
            return ()
        if any(isinstance(b, FixedRegion | HeldParticles) for b in boundaries):
            return ()
        return (HeldParticles(position=self.position[self.attached]),)

    def check(self) -> None:
        p = len(self.position)
        if p == 0:
            raise ValueError("Body: no particle at all; lower fill.opacity or fill.spacing")
        if self.position.shape != (p, 3) or any(
            v is not None and len(v) != p for v in (self.volume, self.part, self.interior, self.attached)
        ):
            raise ValueError(
                f"Body: position {tuple(self.position.shape)}, volume, part, interior and attached must have {p} rows"
            )
        if self.parts and not 0 <= int(self.part.min()) <= int(self.part.max()) < len(self.parts):
            raise ValueError(
                f"Body.part lies in {int(self.part.min())}..{int(self.part.max())}, must be an index of {self.parts}"
            )
        require_finite("Body.position", self.position)
        require_finite("Body.volume", self.volume)
        if not bool((self.volume > 0).all()):
            raise ValueError(
                f"Body.volume: {int((self.volume <= 0).sum())} particles without volume; each must be > 0 m^3"
            )
        if not self.spacing > 0:
            raise ValueError(f"Body.spacing is {self.spacing:g} m, must be > 0")


@dataclass(frozen=True)
class Surface:
    """Samples of the surface that the Gaussians show, about half a spacing apart."""

    point: np.ndarray  # [m, 3] [m]
    normal: np.ndarray  # [m, 3] unit, outward
    enclosure: "Enclosure"  # where the samples are met by rays
    thin: np.ndarray  # [m] bool: both sides see the sky
    hidden: np.ndarray  # [m] bool: neither side does, or no camera sees a surface near it


class AbstractSolid:
    """Which points lie inside the closed surface through oriented samples. A frozen dataclass."""

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        """A function [m, 3] -> bool [m]."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Poisson(AbstractSolid):
    """Inside the screened Poisson surface of the samples that bound a volume. Closes missing caps."""

    enclosure: Share = 0.4  # least share of directions in which a point inside must meet the surface

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        chosen = ~surface.thin & ~surface.hidden
        if chosen.sum() < 50:
            return lambda x: np.zeros(len(x), bool)
        o3d = open3d()
        point = surface.point[chosen]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(point))
        cloud.normals = o3d.utility.Vector3dVector(surface.normal[chosen])
        # finest octree cell of about half a spacing, as dense as the samples are
        depth = int(np.clip(np.ceil(np.log2(1.1 * np.ptp(point, 0).max() / (0.5 * spacing))), 4, 9))
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        lower, upper = surface.point.min(0), surface.point.max(0)

        def inside(x: np.ndarray) -> np.ndarray:
            found = ((x >= lower) & (x <= upper)).all(1)
            at = np.flatnonzero(found)
            if len(at):
                occupied = scene.compute_occupancy(o3d.core.Tensor(x[at].astype(np.float32)), nthreads=1, nsamples=3)
                found[at] = (occupied.numpy() > 0.5) & (surface.enclosure.share(x[at]) >= self.enclosure)
            return found

        return inside


@dataclass(frozen=True, kw_only=True)
class WindingNumber(AbstractSolid):
    """w(q) = sum_i a_i n_i . (p_i - q) / (4 pi |p_i - q|^3) > 1/2 (Barill et al. 2018), summed directly.

    No mesh and no Open3D; gentle with gaps; cost = samples x points, a minute for large bodies at fine spacing.
    """

    def inside(self, surface: Surface, spacing: float) -> Callable[[np.ndarray], np.ndarray]:
        chosen = ~surface.thin & ~surface.hidden
        point, normal = surface.point[chosen], surface.normal[chosen]
        if len(point) < 50:
            return lambda x: np.zeros(len(x), bool)
        area = sample_area(point, normal, spacing, cKDTree(point))
        origin = point.mean(0)  # float32 is enough, and half the traffic, near the origin
        p = torch.from_numpy(point - origin).float()
        weighted = torch.from_numpy(normal * area[:, None] / (4 * np.pi)).float()
        through = (weighted * p).sum(1)

        def inside(x: np.ndarray) -> np.ndarray:
            found = np.zeros(len(x), bool)
            chunk = max(1, 1_000_000 // len(p))
            for start in range(0, len(x), chunk):
                q = torch.from_numpy(x[start : start + chunk] - origin).float()
                # a sample nearer than half a spacing is a disc, not a point
                r = torch.cdist(q, p).clamp(min=spacing / 2)
                found[start : start + chunk] = ((through - q @ weighted.T) / r**3).sum(1).numpy() > 0.5
            return found

        return inside


class Enclosure:
    """For every voxel of size h [m] around the points, in which of the 26 directions a ray meets them."""

    def __init__(self, point: np.ndarray, h: float):
        self.h, self.lower = h, point.min(0) - 1.5 * h
        at = self.voxel(point)
        occupied = np.zeros(at.max(0) + 2, bool)
        occupied[tuple(at.T)] = True
        self.blocked = np.stack([swept(occupied, d) for d in DIRECTIONS])

    def voxel(self, x: np.ndarray) -> np.ndarray:
        return np.floor((x - self.lower) / self.h).astype(np.int64)

    def directions(self, x: np.ndarray) -> np.ndarray:
        """bool [m, 26]: does a ray from x in that direction meet a voxel of the surface?"""
        at, size = self.voxel(x), np.array(self.blocked.shape[1:])
        within = ((at >= 0) & (at < size)).all(1)
        return self.blocked[:, *np.where(within[:, None], at, 0).T].T & within[:, None]  # type: ignore[arg-type, index]

    def share(self, x: np.ndarray) -> np.ndarray:
        """[m] in 0..1: share of the directions in which x is enclosed."""
        return self.directions(x).mean(1)


def swept(occupied: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """OR of `occupied` over v, v + d, v + 2 d, ... by doubling the stride.

    A diagonal step also looks at the voxels it passes between, else it would slip through a surface one voxel thick.
    """
    blocked = occupied.copy()
    for taken in itertools.product(*[(0, d) if d else (0,) for d in direction]):
        blocked |= shifted(occupied, np.array(taken))
    stride = 1
    while stride < max(occupied.shape):
        blocked |= shifted(blocked, direction * stride)
        stride *= 2
    return blocked


def shifted(a: np.ndarray, by: np.ndarray) -> np.ndarray:
    """b[v] = a[v + by], False outside."""
    by = [int(np.clip(d, -n, n)) for d, n in zip(by, a.shape)]  # type: ignore[assignment]
    out = np.zeros_like(a)
    to = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(by, a.shape))
    of = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(by, a.shape))
    out[to] = a[of]
    return out


def fill(
    gaussians: Gaussians,
    label: Int[Tensor, " n"],
    *,
    spacing: float,
    opacity: float,
    solid: AbstractSolid,
    interior: bool,
    sheet_thickness: float | None,
    isolated: str,
    drop_pieces_below: float,
    attach: bool,
    cameras: Sequence[Camera],
    log: Log,
) -> Body:
    """Particles for the Gaussians with label > 0 (part = label - 1), and the embedding of all of them.

    spacing [m]; Gaussians below `opacity`, or below half of the median one where that is less, become no particles but
    are embedded; `interior` False leaves a shell; `sheet_thickness` [m] of thin parts, None takes sqrt(12) times the
    median least deviation of their Gaussians; isolated pieces with less than the share `drop_pieces_below` of the
    volume are dropped, of the others becomes what `isolated` says, see `join_pieces`; `attach` marks the particles
    beside static Gaussians. `cameras` of the photographs say where the surface is (`seen.py`); with none it is a
    deviation outside the Gaussians' centres.
    Raises ValueError if nothing moves, the lattice would be too large, or the cameras do not see the body.
    """
    if not spacing > 0:
        raise ValueError(f"fill.spacing is {spacing:g} m, must be > 0; half a cell of the simulation grid is right")
    if isolated not in ISOLATED:
        raise ValueError(f"fill.isolated is {isolated!r}; take one of {', '.join(ISOLATED)}")
    which = torch.nonzero(label > 0).flatten()
    if len(which) == 0:
        raise ValueError(
            "no Gaussian may move (all labels are 0); correct segment.prompts, see the previews of segment"
        )
    moving = gaussians.select(which)
    # a model of many faint Gaussians is judged by its own: the half of its median, where that is less
    opacity = min(opacity, 0.5 * float(moving.opacity.median()))
    solidly = moving.opacity > opacity
    if int(solidly.sum()) < 4:
        raise ValueError(
            f"only {int(solidly.sum())} of {len(which)} moving Gaussians are opaque enough for a surface; correct "
            "segment.prompts, see the previews of segment"
        )
    reliable = torch.nonzero(solidly).flatten()
    reliable = reliable[torch.from_numpy(without_floaters(moving.mean[reliable].double().numpy()))]
    log.info(
        f"{len(which)} moving Gaussians, {int(solidly.sum()) - len(reliable)} floaters and "
        f"{int((~solidly).sum())} faint ones make no particles"
    )
    size = np.ptp(moving.mean[reliable].double().numpy(), 0)
    if (size / spacing).max() > MOST_CELLS:
        raise ValueError(
            f"fill.spacing = {spacing:g} m cuts a body of {size.max():.3g} m into more than {MOST_CELLS} cells; "
            f"take at least {size.max() / MOST_CELLS:.2g} m, or correct the segmentation"
        )

    shown = moving.select(reliable)
    static = gaussians.select((label == 0) & (gaussians.opacity > opacity))
    view, below = None, None
    if cameras:
        at, _ = spread(shown, spacing / 2)
        box = dict(lower=at.min(0) - 2 * spacing, upper=at.max(0) + 2 * spacing)
        view = seen(gaussians, label, cameras, **box, spacing=spacing, log=log)
        below = ground(gaussians, label, cameras, **box, spacing=spacing, opacity=opacity, log=log)
    else:
        log.info("no cameras: the surface is taken a deviation outside the Gaussians' centres")
    surface, deviation = sample_surface(shown, spacing, beside=static, view=view, below=below, log=log)
    within = solid.inside(surface, spacing)

    def inside(x: np.ndarray) -> np.ndarray:
        found = within(x)
        if view is not None:
            found &= ~view.beside(x)
            # below the ground, where it surely is, and never what is seen of the body
            if below is not None and found.any():
                buried = below.behind(x[found]) > spacing + below.doubt(x[found])
                found[found] &= ~(view.deep(x[found]) & buried)
        return found

    position, volume = solid_cells(inside, surface.point, spacing)
    distance, _ = cKDTree(surface.point).query(position) if len(position) else (np.zeros(0), None)
    inner = distance > spacing
    solid_volume = volume.sum()

    if len(position):
        uncovered = cKDTree(position).query(surface.point)[0] > 1.2 * spacing
    else:
        uncovered = np.ones(len(surface.point), bool)
    if view is not None:  # nor is there a sheet where the cameras see none
        uncovered &= ~view.beside(surface.point) & ~view.deep(surface.point)
    thin_position, thin_area = sheet(surface.point[uncovered], surface.normal[uncovered], spacing)
    thickness = sheet_thickness
    if thickness is None and uncovered.any():
        thickness = min(float(np.sqrt(12) * np.median(deviation[uncovered])), spacing)
    log.info(
        f"solid: {len(position)} particles, {solid_volume:.4g} m^3, {int(inner.sum())} of them interior; "
        + (
            f"thin: {len(thin_position)} particles, {thin_area.sum():.4g} m^2, {1e3 * thickness:.2g} mm thick"  # type: ignore[operator]
            if len(thin_position)
            else "no thin part"
        )
    )
    if not interior:
        position, volume, inner = position[~inner], volume[~inner], inner[~inner]
        log.info(f"interior left out: a shell of {volume.sum():.4g} m^3 stays")
    if len(thin_position):
        position = np.concatenate([position, thin_position])
        volume = np.concatenate([volume, thin_area * thickness])
        inner = np.concatenate([inner, np.zeros(len(thin_position), bool)])

    _, nearest = cKDTree(shown.mean.double().numpy()).query(position)
    part = (label[which][reliable][torch.from_numpy(nearest)] - 1).numpy()
    keep, bridge, bridge_part = join_pieces(position, volume, part, spacing, isolated, drop_pieces_below, log)
    position = np.concatenate([position[keep], bridge])
    volume = np.concatenate([volume[keep], np.full(len(bridge), spacing**3)])
    inner = np.concatenate([inner[keep], np.zeros(len(bridge), bool)])
    part = np.concatenate([part[keep], bridge_part])
    attached = touching(position, spacing, static, log) if attach else None

    placed, of = torch.from_numpy(position).to(torch.float32), torch.from_numpy(part).to(torch.int32)
    return Body(
        position=placed,
        volume=torch.from_numpy(volume).to(torch.float32),
        part=of,
        interior=torch.from_numpy(inner),
        spacing=float(spacing),
        embedding=embed(moving.mean.to(torch.float32), which, placed, spacing, parts=(label[which] - 1, of)),
        attached=None if attached is None else torch.from_numpy(attached),
    )


def without_floaters(point: np.ndarray) -> np.ndarray:
    """Indices of points whose mean distance to 20 neighbours is below its mean + 3 deviations over all points."""
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(point))
    _, kept = cloud.remove_statistical_outlier(nb_neighbors=min(20, len(point) - 1), std_ratio=3.0)
    return np.asarray(kept, dtype=np.int64)


def spread(gaussians: Gaussians, step: float) -> tuple[np.ndarray, np.ndarray]:
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


def sample_surface(
    gaussians: Gaussians,
    spacing: float,
    *,
    beside: Gaussians | None = None,
    view: Seen | None = None,
    below: Ground | None = None,
    log: Log = Log(None),
) -> tuple[Surface, np.ndarray]:
    """Samples about half a spacing apart, and the least deviation [m] of the Gaussians at each.

    `beside` are Gaussians that do not belong to the body but hide the sky: what it stands on or leans against. `view`
    is what cameras see: samples of solid parts are moved onto its surface, those not near it are inside and left out;
    `below` closes it where it stands or leans.
    """
    step = spacing / 2
    point, owner = spread(gaussians, step)
    gap = np.quantile(cKDTree(point).query(point, k=2)[0][:, 1], 0.95)
    h = max(0.75 * spacing, 1.5 * gap)
    walls = point
    if beside is not None and len(beside):
        reach = 0.25 * np.ptp(point, 0).max()
        around, _ = spread(beside, h)
        near = ((around > point.min(0) - reach) & (around < point.max(0) + reach)).all(1)
        walls = np.concatenate([point, around[near]])
    enclosure = Enclosure(walls, h)

    # one sample per voxel of half a spacing: the mean of what lies in it
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
    normal = np.linalg.eigh(shape)[1][:, :, 0]

    # the sky seen from both sides, from one and a half voxels off the surface: thinner walls are thin parts; directions
    # along the surface count a little, because from the bottom of a cup only straight up is free
    cosine = normal @ (DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)).T
    sky = []
    for side in (1, -1):
        weight = np.where(side * cosine > -0.2, np.maximum(side * cosine, 0.2), 0)
        free = ~enclosure.directions(point + side * 1.5 * enclosure.h * normal)
        sky.append((free * weight).sum(1) / weight.sum(1))
    front, back = sky
    normal = np.where((front >= back)[:, None], normal, -normal)
    more, less = np.maximum(front, back), np.minimum(front, back)
    thin, hidden = (less > 0.6 * more) & (more > 0.02), more <= 0.02
    if view is not None:
        moved, outside, found = view.settled(point, 1.5 * spacing)
        solid = ~thin & ~hidden
        share = float(found[solid].mean()) if solid.any() else 1.0
        log.info(f"{100 * share:.0f} % of the samples of solid parts are near the surface that the cameras see")
        if share < LEAST_SEEN:
            raise ValueError(
                f"the cameras see the surface of the body near {100 * share:.1f} % of its Gaussians only; cameras, "
                "Gaussians and labels do not belong together: look at the previews of reconstruct and segment"
            )
        point, normal = (np.where((solid & found)[:, None], a, b) for a, b in ((moved, point), (outside, normal)))
        hidden = hidden | (solid & ~found)
        if below is not None:
            # where no camera sees the body it ends as far below the ground as that is in doubt
            under = view.deep(below.hidden) & ~view.beside(below.hidden)
            end = below.hidden - (spacing + below.doubt(below.hidden))[:, None] * below.normal
            point = np.concatenate([point, end[under]])
            normal = np.concatenate([normal, -below.normal[under]])
            more = np.zeros(int(under.sum()))
            thin, hidden = (np.concatenate([a, more > 0]) for a in (thin, hidden))
            deviation = np.concatenate([deviation, more])
        # what is filled reaches out to the samples where they are now
        return Surface(point, normal, Enclosure(np.concatenate([walls, point]), h), thin=thin, hidden=hidden), deviation
    # what is seen of a fitted Gaussian is its outer side, a deviation away from its centre
    outward = np.where(thin | hidden, 0.0, deviation)[:, None] * normal
    return Surface(point + outward, normal, enclosure, thin=thin, hidden=hidden), deviation


def solid_cells(
    inside: Callable[[np.ndarray], np.ndarray], surface: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centroid [c, 3] [m] and volume [c] [m^3] of the part of every lattice cell that is inside."""
    lower, upper = surface.min(0), surface.max(0)
    count = np.ceil((upper - lower) / spacing).astype(int) + 2
    origin = (lower + upper - count * spacing) / 2
    centre = origin + (np.indices(count).reshape(3, -1).T + 0.5) * spacing
    full = inside(centre).reshape(count)
    cube = np.ones((3, 3, 3), bool)
    boundary = ndimage.binary_dilation(full, cube) & ~ndimage.binary_erosion(full, cube)
    boundary[tuple(np.floor((surface - origin) / spacing).astype(int).T)] = True
    full, boundary = (full & ~boundary).reshape(-1), boundary.reshape(-1)

    part = (np.indices((SUBDIVISION,) * 3).reshape(3, -1).T + 0.5) / SUBDIVISION - 0.5
    fine = centre[boundary, None, :] + spacing * part
    found = inside(fine.reshape(-1, 3)).reshape(fine.shape[:2])
    fraction = found.mean(1)
    filled = fraction > 0
    centroid = np.einsum("ck,cki->ci", found[filled], fine[filled]) / found[filled].sum(1, keepdims=True)
    fraction = fraction[filled]

    own = fraction >= LEAST_FRACTION
    position = np.concatenate([centre[full], centroid[own]])
    volume = np.concatenate([np.ones(int(full.sum())), fraction[own]])
    if len(position) and not own.all():
        distance, nearest = cKDTree(position).query(centroid[~own])
        near = distance < 2 * spacing
        np.add.at(volume, nearest[near], fraction[~own][near])
    return position, volume * spacing**3


def sheet(point: np.ndarray, normal: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Thin surface -> particles [s, 3] about a spacing apart, and the area [s] [m^2] that each stands for."""
    if len(point) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    tree = cKDTree(point)
    # random sequential packing of discs leaves 1.44 diameter^2 to each: this diameter gives one spacing^2
    radius = spacing / np.sqrt(1.44)
    free, chosen = np.ones(len(point), bool), []
    for i in range(len(point)):
        if free[i]:
            chosen.append(i)
            free[tree.query_ball_point(point[i], radius)] = False
    position = point[chosen]
    _, owner = cKDTree(position).query(point)
    area = np.bincount(owner, weights=sample_area(point, normal, spacing, tree), minlength=len(position))
    lonely = area <= 0  # fewer than three samples close by: a thread; it counts as a square of one sample
    return position, np.where(lonely, (spacing / 2) ** 2, area)


def sample_area(point: np.ndarray, normal: np.ndarray, spacing: float, tree: cKDTree) -> np.ndarray:
    """Area [m^2] of each sample: a third of the Delaunay triangles around it, among neighbours in its layer."""
    area = np.zeros(len(point))
    _, neighbours = tree.query(point, k=min(20, len(point)), distance_upper_bound=1.5 * spacing)
    tangent = np.linalg.svd(normal[:, None, :])[2][:, 1:, :]
    for i, row in enumerate(neighbours):
        row = row[row < len(point)]
        offset = point[row] - point[i]
        flat = np.abs(offset @ normal[i]) < 0.5 * spacing  # other layers have their own area
        planar = offset[flat] @ tangent[i].T
        if len(planar) < 3:
            continue
        try:
            corners = planar[Delaunay(planar).simplices]
        except QhullError:  # all on a line
            continue
        here = (np.abs(corners) < 1e-12).all(2).any(1)
        a, b, c = (corners[here, k] for k in range(3))
        sides = np.stack([np.linalg.norm(a - b, axis=1), np.linalg.norm(b - c, axis=1), np.linalg.norm(c - a, axis=1)])
        u, v = b - a, c - a
        triangle = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
        area[i] = triangle[sides.max(0) < 1.5 * spacing].sum() / 3
    return area


def clusters(position: np.ndarray, gap: float) -> np.ndarray:
    """Number [n] of each point's connected piece; neighbours are nearer than `gap` [m], piece 0 has most points."""
    pairs = cKDTree(position).query_pairs(gap, output_type="ndarray")
    n = len(position)
    links = sparse.coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, piece = sparse.csgraph.connected_components(links, directed=False)
    rank = np.argsort(np.argsort(-np.bincount(piece), kind="stable"), kind="stable")
    return rank[piece]


def join_pieces(
    position: np.ndarray,
    volume: np.ndarray,
    part: np.ndarray,
    spacing: float,
    isolated: str,
    drop_below: float,
    log: Log,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(particles to keep [p] bool, positions of new ones [b, 3], their part [b]); every piece is named in the log.

    Pieces lie more than two spacings (a cell) apart. Those below `drop_below` of the volume are dropped, and so are all
    but the largest if `isolated` is "drop"; their Gaussians ride on what remains. "attach" bridges a gap of at most
    JOINT spacings to a piece of the same part by particles a spacing apart; wider ones stay, as with "keep".
    """
    piece = clusters(position, 2 * spacing)
    count = int(piece.max()) + 1
    share = np.bincount(piece, weights=volume) / volume.sum()
    main = int(share.argmax())
    log.metric("pieces", count)
    keep, bridges, of = np.ones(len(position), bool), [np.zeros((0, 3))], [np.zeros(0, part.dtype)]
    joined = piece == main
    lines = []
    for k in sorted(set(range(count)) - {main}, key=lambda k: -share[k]):
        own = piece == k
        if isolated == "drop" or share[k] < drop_below:
            keep[own], fate = False, "dropped; its Gaussians ride on the rest"
        elif isolated == "keep":
            joined |= own
            fate = "kept, it moves on its own"
        else:
            kind = np.bincount(part[own] - part.min()).argmax() + part.min()
            bridge, gap = bridged(position[own], position[joined & (part == kind)], spacing)
            joined |= own
            if gap <= JOINT * spacing:
                bridges.append(bridge)
                of.append(np.full(len(bridge), kind, part.dtype))
                fate = f"attached across {1e3 * gap:.3g} mm by {len(bridge)} particles"
            else:
                fate = f"kept, it moves on its own: {1e3 * gap:.3g} mm from the rest of its part"
        at = ", ".join(f"{v:.3f}" for v in position[own].mean(0))
        lines.append(
            f"isolated piece at ({at}) m: {int(own.sum())} particles, {100 * share[k]:.2g} % of the volume, {fate}"
        )
    for line in lines[:8]:
        log.info(line)
    if len(lines) > 8:
        log.info(f"{len(lines) - 8} more isolated pieces, smaller than these; {int((~keep).sum())} particles dropped")
    return keep, np.concatenate(bridges), np.concatenate(of)


def bridged(piece: np.ndarray, rest: np.ndarray, spacing: float) -> tuple[np.ndarray, float]:
    """Points [b, 3] a spacing apart that fill the gap where it is narrowest, and its width [m]; inf without a rest."""
    if len(rest) == 0:
        return np.zeros((0, 3)), np.inf
    distance, nearest = cKDTree(rest).query(piece)
    gap = distance.min()
    ends = np.flatnonzero(distance < gap + 0.5 * spacing)
    between = np.linspace(0, 1, max(2, round(gap / spacing) + 1))[1:-1, None, None]
    points = (piece[ends] + between * (rest[nearest[ends]] - piece[ends])).reshape(-1, 3)
    _, cell = np.unique(np.round(points / spacing).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    return np.stack([np.bincount(cell, weights=points[:, k]) for k in range(3)], 1) / np.bincount(cell)[:, None], gap


def touching(position: np.ndarray, spacing: float, static: Gaussians, log: Log) -> np.ndarray:
    """Bool [p]: particles within CONTACT spacings of static Gaussians that are part of more than a speck.

    A flat contact also holds what lies within its outline: of a stem in its soil only the rim touches what is seen.
    """
    attached = np.zeros(len(position), bool)
    if len(static):
        least, reach = (c * spacing for c in CONTACT)
        solid = static.select(torch.from_numpy(not_specks(static.mean.double().numpy(), 4 * spacing)))
        point, _ = spread(solid, spacing / 2)
        near = ((point > position.min(0) - reach) & (point < position.max(0) + reach)).all(1)
        if near.any():
            distance, _ = cKDTree(point[near]).query(position)
            attached = distance < min(max(least, 1.3 * distance.min()), reach)
    if not attached.any():
        log.metric("attached", 0)
        log.info("nothing static touches the body: it is held nowhere, unless the scene names a fixed region")
        return attached
    where = position[attached]
    patch = clusters(where, 3 * spacing)
    for k in range(int(patch.max()) + 1):
        attached |= within_outline(position, where[patch == k], spacing)
    log.metric("attached", int(attached.sum()))
    where = position[attached]
    patch = clusters(where, 3 * spacing)
    for k in range(min(int(patch.max()) + 1, 8)):
        at = ", ".join(f"{v:.3f}" for v in where[patch == k].mean(0))
        log.info(f"attached at ({at}) m: {int((patch == k).sum())} particles beside static Gaussians are held there")
    if patch.max() >= 8:
        log.info(f"and at {int(patch.max()) - 7} smaller places")
    return attached


def within_outline(position: np.ndarray, patch: np.ndarray, spacing: float) -> np.ndarray:
    """Bool [p]: inside the convex outline of a flat patch [k, 3], in its own layer; of no use where it is not flat."""
    centre = patch.mean(0)
    _, size, axes = np.linalg.svd(patch - centre, full_matrices=False)
    if len(patch) < 4 or size[2] > spacing * np.sqrt(len(patch)) or size[1] < 1e-3 * size[0]:
        return np.zeros(len(position), bool)
    local, all_of_them = (patch - centre) @ axes.T, (position - centre) @ axes.T
    inside = Delaunay(local[:, :2]).find_simplex(all_of_them[:, :2]) >= 0
    low, high = local[:, 2].min() - spacing / 4, local[:, 2].max() + spacing / 4
    return inside & (all_of_them[:, 2] >= low) & (all_of_them[:, 2] <= high)


def not_specks(point: np.ndarray, cell: float) -> np.ndarray:
    """Bool [n]: points of clusters of cells [m] that hold at least the share SPECK of all points."""
    cells, of = np.unique(np.floor(point / cell).astype(np.int64), axis=0, return_inverse=True)
    cluster = clusters(cells.astype(float), 1.8)[of.reshape(-1)]
    return (np.bincount(cluster) >= SPECK * len(point))[cluster]
