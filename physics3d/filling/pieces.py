"""Isolated pieces of a body, more than a cell from the rest: named, and joined to it, dropped or kept."""

import numpy as np
from scipy.spatial import cKDTree

from physics3d.clusters import clusters
from physics3d.log import Log

ISOLATED = ("attach", "drop", "keep")  # what may become of a piece
JOINT = 4.0  # widest gap that is bridged [spacings]: two cells of the simulation grid


def join_pieces(
    position: np.ndarray,
    volume: np.ndarray,
    part: np.ndarray,
    spacing: float,
    isolated: str,
    drop_below: float,
    log: Log,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(particles to keep [p] bool, positions of new ones [b, 3], their part [b]); every piece is in the log.

    Pieces lie more than two spacings (a cell) apart. Those below `drop_below` of the volume are dropped, which is said
    of all of them in one line, and so are all but the largest if `isolated` is "drop"; their Gaussians ride on what
    remains. "attach" bridges a gap of at most JOINT spacings to a piece of the same part by particles a spacing apart;
    wider ones stay, as with "keep".
    """
    piece = clusters(position, 2 * spacing)
    count = int(piece.max()) + 1
    share = np.bincount(piece, weights=volume) / volume.sum()
    main = int(share.argmax())
    log.metric("pieces", count)
    keep, bridges, of = np.ones(len(position), bool), [np.zeros((0, 3))], [np.zeros(0, part.dtype)]
    joined = piece == main
    lines = []
    small = [k for k in range(count) if k != main and share[k] < drop_below]
    keep[np.isin(piece, small)] = False
    for k in sorted(set(range(count)) - {main, *small}, key=lambda k: -share[k]):
        own = piece == k
        if isolated == "drop":
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
        log.info(f"isolated pieces besides, each smaller than these: {len(lines) - 8}")
    if small:
        log.info(
            f"isolated pieces too small to keep: {len(small)}, of {int(np.isin(piece, small).sum())} particles, "
            f"{100 * share[small].sum():.2g} % of the volume; dropped, their Gaussians ride on the rest"
        )
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
