"""Surface Gaussians -> particles of one size that also occupy the interior of solid parts, and none inside thin ones.

A reconstruction puts Gaussians on the visible surface only; a simulated body needs mass behind it.

    chosen     the Gaussians that show a surface: above the opacity threshold, without floaters       (`showing`, here)
    looked at  where the photographs' cameras see that surface, and what it stands on     (`seen.py`, `ground.py`), at
               the scale of the particles or of a thirtieth of the body: fewer particles fill the same body
    samples    of the surface, with outward normals                                                   (`surface.py`)
    inside     of the closed surface through the samples that bound a volume                           (`solids.py`)
    particles  one per lattice cell of that volume (`cells.py`), and one per spacing^2 of thin surface that no cell
               covers, V_p = area * thickness (`sheets.py`)
    pieces     isolated ones are joined to the rest, dropped or kept                                   (`pieces.py`)
    attached   the particles beside static Gaussians                                               (`attachment.py`)

so that sum V_p is the volume of the body. All lengths in metres.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Int
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.filling.attachment import attached_particles
from physics3d.filling.body import Body
from physics3d.filling.cells import solid_cells
from physics3d.filling.doubt import doubt_of
from physics3d.filling.ground import Ground, ground
from physics3d.filling.pieces import ISOLATED, join_pieces
from physics3d.filling.seen import LIMB, Seen, seen
from physics3d.filling.sheets import APART, disc_moment, sheet
from physics3d.filling.solids import AbstractSolid
from physics3d.filling.surface import Surface, over_discs, sample_surface
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.floaters import lonely
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.matter import REACH, of_owners, with_pieces

MOST_CELLS = 160  # along one side of the lattice
DETAIL = 30  # a body is looked at in at least so many parts along its longest side, however far apart its particles are
FLOATING = 3.0  # standard deviations by which a Gaussian is farther from its neighbours than all are


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
    sure: bool = False,
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
    moving = gaussians.select(which)
    reliable, opacity = showing(moving, opacity, log)
    shown = moving.select(reliable)
    detail = _detail(shown, spacing, seen=len(cameras) > 0)
    static = gaussians.select((label == 0) & (gaussians.opacity > opacity))

    view, below = _look(gaussians, label, shown, cameras, spacing=detail, opacity=opacity, log=log)
    surface, deviation = sample_surface(shown, spacing, detail=detail, beside=static, view=view, below=below, log=log)
    inside = _bounded(solid.inside(surface, detail), view, below, detail)
    position, volume, matter = solid_cells(inside, surface.point, spacing)
    inner = cKDTree(surface.point).query(position)[0] > spacing if len(position) else np.zeros(0, bool)

    doubt = None
    if surface.doubt is not None and len(position):
        bounds = ~surface.thin & ~surface.hidden & np.isfinite(surface.doubt)
        doubt = doubt_of(matter, surface.point[bounds], surface.doubt[bounds], detail, log)
    bare = _uncovered(surface, deviation, position, view, spacing)
    flat, area = sheet(surface.point[bare], surface.normal[bare], spacing, detail)
    thickness = sheet_thickness
    if thickness is None and bare.any():
        thickness = min(float(np.sqrt(12) * np.median(deviation[bare])), spacing)
    thin = f"thin: {len(flat)} particles, {area.sum():.4g} m^2, {1e3 * (thickness or 0):.2g} mm thick"
    log.info(
        f"solid: {len(position)} particles, {volume.sum():.4g} m^3, {int(inner.sum())} of them interior; "
        + (thin if len(flat) else "no thin part")
    )
    if not interior:
        matter = of_owners(matter, ~inner)
        position, volume, inner = position[~inner], volume[~inner], inner[~inner]
        log.info(f"interior left out: a shell of {volume.sum():.4g} m^3 stays")
    if len(flat):
        assert thickness is not None  # there is flat matter, so it was given or measured above
        # in pieces as large as those of what is solid
        edge = min(matter.size, spacing) if len(position) else spacing / 2
        piece, share = sheet(surface.point[bare], surface.normal[bare], edge, detail)
        side = surface.normal[bare][cKDTree(surface.point[bare]).query(piece)[1]]
        of_flat = cKDTree(flat).query(piece)[1]
        area = np.bincount(of_flat, weights=share, minlength=len(flat))
        moment = disc_moment(side, share, thickness)
        matter = with_pieces(matter, piece, share * thickness, moment, len(position) + of_flat, reach=APART * edge)
        position, volume = np.concatenate([position, flat]), np.concatenate([volume, area * thickness])
        inner = np.concatenate([inner, np.zeros(len(flat), bool)])

    _, nearest = cKDTree(shown.mean.double().numpy()).query(position)
    part = (label[which][reliable][torch.from_numpy(nearest)] - 1).numpy()
    keep, bridge, bridge_part = join_pieces(position, volume, part, spacing, isolated, drop_pieces_below, log)
    cubes = np.tile(spacing**2 / 12 * np.eye(3), (len(bridge), 1, 1))
    matter = of_owners(matter, keep)
    if len(bridge):
        number = int(keep.sum()) + np.arange(len(bridge))
        matter = with_pieces(matter, bridge, np.full(len(bridge), spacing**3), cubes, number, reach=REACH * spacing)
    position = np.concatenate([position[keep], bridge])
    volume = np.concatenate([volume[keep], np.full(len(bridge), spacing**3)])
    inner = np.concatenate([inner[keep], np.zeros(len(bridge), bool)])
    part = np.concatenate([part[keep], bridge_part])
    attached = torch.from_numpy(attached_particles(position, spacing, static, log, sure=sure)) if attach else None

    placed, of = torch.from_numpy(position).to(torch.float32), torch.from_numpy(part).to(torch.int32)
    return Body(
        position=placed,
        volume=torch.from_numpy(volume).to(torch.float32),
        part=of,
        interior=torch.from_numpy(inner),
        spacing=float(spacing),
        embedding=embed(moving.mean.to(torch.float32), which, placed, spacing, parts=(label[which] - 1, of)),
        attached=attached,
        matter=matter,
        doubt=doubt,
    )


def showing(moving: Gaussians, opacity: float, log: Log) -> tuple[Int[Tensor, " k"], float]:
    """Which of the Gaussians that move show its surface, and the opacity above which they do.

    A model of many faint Gaussians is judged by its own: the half of its median, where that is less than `opacity`.
    Raises ValueError if too few of them do.
    """
    if len(moving) == 0:
        raise ValueError(
            "no Gaussian may move (all labels are 0); correct segment.prompts, see the previews of segment"
        )
    opacity = min(opacity, 0.5 * float(moving.opacity.median()))
    solidly = moving.opacity > opacity
    if int(solidly.sum()) < 4:
        raise ValueError(
            f"only {int(solidly.sum())} of {len(moving)} moving Gaussians are opaque enough for a surface; correct "
            "segment.prompts, see the previews of segment"
        )
    reliable = torch.nonzero(solidly).flatten()
    reliable = reliable[~lonely(moving.mean[reliable], FLOATING)]
    log.info(
        f"{len(moving)} moving Gaussians, {int(solidly.sum()) - len(reliable)} floaters and "
        f"{int((~solidly).sum())} faint ones make no particles"
    )
    return reliable, opacity


def _detail(shown: Gaussians, spacing: float, *, seen: bool) -> float:
    """The scale [m] at which the surface is looked at: that of the particles. Where cameras see it, it is no coarser
    than the body needs, and no finer than its Gaussians tell; by itself, what is thin shows at a coarse scale only.

    Raises ValueError if the body is too small or too large for the particles."""
    size = np.ptp(shown.mean.double().numpy(), 0)
    if size.max() < 2 * spacing:
        raise ValueError(
            f"fill.spacing is {spacing:g} m, and the body {size.max():.3g} m: smaller than a cell of the grid, two "
            f"spacings; take at most {size.max() / 30:.2g} m, and scene.dx twice that"
        )
    if (size / spacing).max() > MOST_CELLS:
        raise ValueError(
            f"fill.spacing = {spacing:g} m cuts a body of {size.max():.3g} m into more than {MOST_CELLS} cells; "
            f"take at least {size.max() / MOST_CELLS:.2g} m, or correct the segmentation"
        )
    if not seen:
        return spacing
    thickness = 2 * float(torch.exp(shown.log_scale.amin(1)).median())
    return min(spacing, max(float(size.max()) / DETAIL, thickness))


def _look(
    gaussians: Gaussians,
    label: Int[Tensor, " n"],
    shown: Gaussians,
    cameras: Sequence[Camera],
    *,
    spacing: float,
    opacity: float,
    log: Log,
) -> tuple[Seen | None, Ground | None]:
    """What the cameras see of the body, and of what it stands on; None without cameras."""
    if not cameras:
        log.info("no cameras: the surface is taken a deviation outside the Gaussians' centres")
        return None, None
    at, _ = over_discs(shown, spacing / 2)
    box = dict(lower=at.min(0) - 2 * spacing, upper=at.max(0) + 2 * spacing)
    view = seen(gaussians, label, cameras, **box, spacing=spacing, log=log)
    return view, ground(gaussians, label, cameras, **box, spacing=spacing, opacity=opacity, log=log)


def _bounded(
    within: Callable[[np.ndarray], np.ndarray], view: Seen | None, below: Ground | None, spacing: float
) -> Callable[[np.ndarray], np.ndarray]:
    """`within`, but not where cameras see past the body, nor, out of their sight, surely below the ground."""

    def inside(x: np.ndarray) -> np.ndarray:
        found = within(x)
        if view is None or not found.any():
            return found
        at = x[found]
        past = view.beside(at)
        if below is not None:
            depth = below.behind(at)
            past &= depth < 0  # nothing is seen past a body in the ground
            # where the ground surely is, and never what is seen of the body
            past |= view.deep(at) & (depth > spacing + below.doubt(at))
        found[found] = ~past
        return found

    return inside


def _uncovered(
    surface: Surface, deviation: np.ndarray, position: np.ndarray, view: Seen | None, spacing: float
) -> np.ndarray:
    """Bool [m]: samples of the surface that no particle at `position` [p, 3] is near to; they are thin parts."""
    bare = np.ones(len(surface.point), bool)
    if len(position):
        bare = cKDTree(position).query(surface.point)[0] > 1.2 * spacing
    if view is not None:  # nor is there a sheet where the cameras see none, from neither of its sides
        side = LIMB * deviation[:, None] * surface.normal
        bare &= ~view.beside(surface.point) & ~(view.deep(surface.point + side) & view.deep(surface.point - side))
    return bare
