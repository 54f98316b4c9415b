"""The moving Gaussians as a few megabytes for a page: places in 16 bits, colours, opacities and widths in 8.

Where there are too many, the ones that cover most are kept: opacity times the square of the mean standard deviation,
which is also the radius of the round spot that the page draws (`pages/replay.js`).
"""

import math
from typing import Any

import numpy as np
import torch

from pipeline.embed import raw
from pipeline.moving import SceneMotion

BYTES = 2_000_000  # of the places of what moves
STILL = 8000  # Gaussians that never move, at most


def replay(made: SceneMotion) -> dict[str, Any]:
    """What the page is told, its two arrays in base64, and how many Gaussians there are of how many."""
    from physics3d.gaussians.carry import carry
    from physics3d.gaussians.sh import C0

    g, which, trajectory = made.gaussians, made.body.embedding.which, made.trajectory
    frames = len(trajectory.position)
    radius = torch.exp(2 * g.log_scale).mean(1).sqrt()
    weight = g.opacity * radius**2
    moves = torch.zeros(len(g), dtype=torch.bool)
    moves[which] = True
    most = max(1, BYTES // (6 * frames))
    moving, still = (_largest(weight, at, count) for at, count in ((moves, most), (~moves, STILL)))
    X = trajectory.rest_position
    with torch.no_grad():
        paths = torch.stack(
            [carry(g, made.body.embedding, X, x, F)[0] for x, F in zip(trajectory.position, trajectory.deformation)]
        )
    seen = paths[:, moving].reshape(-1, 3)
    centre = (seen.amin(0) + seen.amax(0)) / 2
    reach = float((seen - centre).norm(dim=1).max())
    # what lies far behind would take the precision from what is looked at
    still = still[(g.mean[still] - centre).norm(dim=1) < 6 * reach]
    places = torch.cat([seen, g.mean[still]]).double()
    lower, size = places.amin(0), (places.amax(0) - places.amin(0)).clamp_min(1e-9)
    shown = torch.cat([moving, still])
    widest = float(radius[shown].max())
    color = (0.5 + C0 * g.sh[shown, 0]).clamp(0, 1)
    looks = torch.cat([color, g.opacity[shown, None], (radius[shown, None] / widest).sqrt()], 1)
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
