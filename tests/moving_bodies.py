"""A small body that turns, shears and opens, with Gaussians of every degree of harmonics: what exports are tried on."""

import math

import torch
from small_scene import world

from physics3d.export.moving import Moving
from physics3d.filling.body import Body
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.interior import Interior
from physics3d.gaussians.model import Gaussians
from physics3d.trajectory import Trajectory

FRAMES, FPS, SPACING = 5, 24.0, 0.05
MOVING, STILL = 40, 7
PARAMETERS = {"youngs_modulus": 2e4, "poissons_ratio": 0.3}


def gaussians(harmonics: int) -> Gaussians:
    """The last ones never move. Flat, long and round ones, in general position."""
    g = torch.Generator().manual_seed(harmonics)
    n = MOVING + STILL
    return Gaussians(
        mean=torch.rand(n, 3, generator=g) * 0.2 - 0.1,
        log_scale=torch.randn(n, 3, generator=g) - 4,
        quaternion=torch.randn(n, 4, generator=g),
        opacity_logit=torch.randn(n, generator=g) * 2,
        sh=torch.randn(n, harmonics, 3, generator=g) * 0.4,
    )


def body(g: Gaussians) -> Body:
    line = torch.arange(-0.1 + SPACING / 2, 0.1, SPACING)
    x = torch.cartesian_prod(line, line, line)
    inside = x.abs().amax(1) < SPACING
    return Body(
        position=x,
        volume=torch.full((len(x),), SPACING**3),
        part=torch.zeros(len(x), dtype=torch.int32),
        interior=inside,
        spacing=SPACING,
        embedding=embed(g.mean[:MOVING], torch.arange(MOVING), x, SPACING),
        attached=x[:, 2] < -SPACING,
    )


def deformation(i: int) -> torch.Tensor:
    """F of frame i, the same everywhere: a large turn, and a stretch that grows; the body has opened by the last."""
    angle, s = 0.9 * i, 0.25 * i
    turn = [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    return torch.tensor(turn) @ torch.tensor([[1 + s, 0.3 * s, 0], [0, 1 - 0.1 * s, 0], [0, 0.2 * s, 1 / (1 + s)]])


def moving(harmonics: int, opening: bool = False) -> tuple[Moving, Body]:
    g = gaussians(harmonics)
    made = body(g)
    X = made.position
    F = torch.stack([deformation(i) for i in range(FRAMES)])
    trajectory = Trajectory(
        rest_position=X,
        position=torch.einsum("tij,pj->tpi", F, X)
        + torch.arange(FRAMES)[:, None, None] * torch.tensor([0.1, 0.0, 0.02]),
        velocity=torch.zeros(FRAMES, len(X), 3),  # nobody asks
        deformation=F[:, None].expand(FRAMES, len(X), 3, 3).contiguous(),
        fps=FPS,
        health={},
        substeps=1,
        substep_dt=1e-3,
    )
    inside = Interior.of(g.select(torch.arange(MOVING)), X, made.interior, SPACING) if opening else None
    return Moving(gaussians=g, embedding=made.embedding, trajectory=trajectory, interior=inside), made


WORLD = world(PARAMETERS)
