"""The moving Gaussians as a few megabytes for a page: places in 16 bits; turns, colours, opacities and widths in 8.

Where there are too many, the ones that cover most are kept: opacity times the mean square of the standard deviations.
The page draws them as ellipsoids that turn with the body, as wide as they are at rest, in the colour that they have on
average over all directions (`pages/replay.js`).
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pipeline.embed import raw
from pipeline.moving import SceneMotion

BYTES = 2_500_000  # of places and turns of what moves
STILL = 8000  # Gaussians that never move, at most


def replay(made: SceneMotion) -> dict[str, Any] | None:
    """What the page is told, arrays in base64, and how many of how many Gaussians it shows; None if none moves."""
    from physics3d.export.moving import Moving
    from physics3d.gaussians.sh import C0

    g, which, trajectory = made.gaussians, made.body.embedding.which, made.trajectory
    if len(which) == 0:
        return None
    frames = len(trajectory.position)
    weight = g.opacity * torch.exp(2 * g.log_scale).mean(1)
    moves = torch.zeros(len(g), dtype=torch.bool)
    moves[which] = True
    most = max(1, BYTES // (10 * frames))
    moving, still = (_largest(weight, at, count) for at, count in ((moves, most), (~moves, STILL)))
    row = torch.zeros(len(g), dtype=torch.long)
    row[which] = torch.arange(len(which))
    every = made.body.embedding
    embedding = replace(
        every,
        which=torch.arange(len(moving)),
        neighbours=every.neighbours[row[moving]],
        weights=every.weights[row[moving]],
    )
    plain = replace(g, sh=g.sh[:, :1]).select(moving)  # harmonics would be turned in vain
    moved = list(Moving(gaussians=plain, embedding=embedding, trajectory=trajectory).frames())
    paths = torch.stack([frame.mean for frame in moved])
    seen = paths.reshape(-1, 3)
    centre = (seen.amin(0) + seen.amax(0)) / 2
    reach = float((seen - centre).norm(dim=1).max())
    # what lies far behind would take the precision from what is looked at
    still = still[(g.mean[still] - centre).norm(dim=1) < 6 * reach]
    places = torch.cat([seen, g.mean[still]]).double()
    lower, size = places.amin(0), (places.amax(0) - places.amin(0)).clamp_min(1e-9)
    shown = torch.cat([moving, still])
    wide = g.log_scale[shown].exp()
    widest = float(wide.max())
    color = (0.5 + C0 * g.sh[shown, 0]).clamp(0, 1)
    looks = torch.cat([color, g.opacity[shown, None], (wide / widest).sqrt()], 1)
    turns = torch.cat([frame.quaternion for frame in moved] + [g.quaternion[still]])
    turns = torch.nn.functional.normalize(turns, dim=1)
    azimuth, elevation = _direction(made, centre)
    told = {
        "moving": len(moving),
        "still": len(still),
        "frames": frames,
        "fps": trajectory.fps,
        "lower": lower.tolist(),
        "size": size.tolist(),
        "centre": centre.tolist(),
        "distance": 1.15 * reach / math.sin(math.pi / 12),
        "azimuth": azimuth,
        "elevation": elevation,
        "widest": widest,
        "background": [255 * c for c in made.capture.background],
    }
    rounded = ((places - lower) / size * 65535).round().numpy().astype("<u2")
    return {
        "told": told,
        "places": raw(rounded),
        "turns": raw((turns * 127).round().numpy().astype(np.int8)),
        "looks": raw((looks * 255).round().numpy().astype(np.uint8)),
        "shown": len(shown),
        "all": len(g),
    }


def _largest(weight: torch.Tensor, at: torch.Tensor, count: int) -> torch.Tensor:
    """Indices of at most `count` of those where `at`, by weight."""
    index = torch.nonzero(at).flatten()
    return index[weight[index].argsort(descending=True)[:count]]


def _direction(made: SceneMotion, centre: torch.Tensor) -> tuple[float, float]:
    """Azimuth and elevation from which the scene was filmed or, without a film, photographed first [rad]."""
    take = made.capture.take("evaluate") or made.capture.take("learn")
    cameras = take.cameras if take is not None else made.capture.cameras
    if not cameras:
        return 0.6, 0.25
    x, y, z = (cameras[0].centre - centre.double()).tolist()
    return math.atan2(y, x), math.atan2(z, math.hypot(x, y))
