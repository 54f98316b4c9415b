"""Which inside test fills best: volume error, spread outside and time of each on bodies of known volume.

    python benchmarks/filling.py            prints the table, about a minute on one core

Bodies are made of flat Gaussians with 0.5 mm noise; spacing 8 mm. "outside" is the share of particles farther than half
a spacing outside the true body.
"""

import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests")]

from analytic_bodies import annulus, box, cup, discs, sphere, together, torus, wall

from physics3d.filling import Poisson, WindingNumber, fill
from physics3d.log import Log

SPACING, NOISE = 0.008, 0.0005
norm = np.linalg.norm
radius = lambda q: norm(q[:, :2], axis=1)


def without_cap(point, normal):
    return point[point[:, 2] > -0.04], normal[point[:, 2] > -0.04]


def bodies(rng):
    """name -> surface, volume [m^3], signed distance (negative inside) of the true body [m]."""
    drum = lambda q, r, h: np.maximum(radius(q) - r, np.abs(q[:, 2] - h / 2) - h / 2)
    ball = lambda q: norm(q, axis=1) - 0.05
    ring = lambda q: np.hypot(radius(q) - 0.06, q[:, 2]) - 0.025
    block = lambda q: (np.abs(q) - [0.05, 0.04, 0.03]).max(1)
    mug = lambda q: np.maximum(drum(q, 0.05, 0.1), -np.maximum(radius(q) - 0.034, 0.016 - q[:, 2]))
    yield "sphere", sphere(8000, 0.05, rng), 4 / 3 * np.pi * 0.05**3, ball
    yield "sphere without cap", without_cap(*sphere(8000, 0.05, rng)), 4 / 3 * np.pi * 0.05**3, ball
    yield "torus", torus(8000, 0.06, 0.025, rng), 2 * np.pi**2 * 0.06 * 0.025**2, ring
    yield "box", box(8000, (0.05, 0.04, 0.03), rng), 8 * 0.05 * 0.04 * 0.03, block
    cake = together(wall(8000, 0.06, 0, 0.06, rng), annulus(4000, 0, 0.06, 0.06, rng))
    yield "cake without base", cake, np.pi * 0.06**3, lambda q: drum(q, 0.06, 0.06)
    yield "open cup", cup(0.05, 0.016, 0.1, rng), np.pi * (0.05**2 * 0.1 - 0.034**2 * 0.084), mug


def main() -> None:
    print(f"{'body':20} {'inside test':15} {'particles':>9} {'volume error':>12} {'outside':>8} {'time':>7}")
    for name, surface, volume, distance in bodies(np.random.default_rng(0)):
        gaussians = discs(*surface, np.random.default_rng(1), noise=NOISE)
        for solid in (Poisson(), WindingNumber()):
            started = time.perf_counter()
            body = fill(
                gaussians,
                torch.ones(len(gaussians), dtype=torch.int32),
                spacing=SPACING,
                opacity=0.1,
                solid=solid,
                interior=True,
                sheet_thickness=None,
                isolated="keep",
                drop_pieces_below=0.0,
                attach=False,
                log=Log(None),
            )
            seconds = time.perf_counter() - started
            error = float(body.volume.double().sum()) / volume - 1
            outside = (distance(body.position.double().numpy()) > SPACING / 2).mean()
            print(
                f"{name:20} {type(solid).__name__:15} {len(body.position):9} {100 * error:+10.1f} % "
                f"{100 * outside:6.1f} % {seconds:5.1f} s"
            )


if __name__ == "__main__":
    main()
