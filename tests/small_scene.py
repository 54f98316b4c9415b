"""A soft bar that stands on the floor and is poked at its top: small enough to simulate and render in a second."""

import torch

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.filling.body import Body
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.model import Gaussians
from physics3d.learning.chain import chain_of
from physics3d.learning.fields import GlobalField
from physics3d.learning.loss import Chain
from physics3d.log import Log
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.priors.estimators.sds import ScoreDistillation
from physics3d.priors.exemplar import Exemplar
from physics3d.scenes.base import Capture, Take
from physics3d.world import World
from stages.learn import Learn

ELASTIC = {"youngs_modulus": 2e4, "poissons_ratio": 0.3}
DAMPED = ELASTIC | {
    "branch_shear_modulus": 6e3,
    "branch_bulk_modulus": 6e3,
    "shear_relaxation_time": 0.05,
    "bulk_relaxation_time": 0.05,
}
DX = 0.05
POKE = (Impulse(force=(1.2, 0.0, 0.0), centre=(0.0, 0.0, 0.4), radius=0.12, start=0.0, duration=0.1),)


def world(
    start: dict[str, float],
    precision: str = "float32",
    solver: str = "grid",
    boundaries: tuple[AbstractBoundary, ...] = (),
) -> World:
    """Its foot is held; `boundaries` besides."""
    return World(
        material=Viscoelastic(branches=1 if "branch_shear_modulus" in start else 0),
        density=300.0,
        start=start,
        dx=DX,
        gravity=(0.0, 0.0, 0.0),
        boundaries=(FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 0.06)), *boundaries),
        precision=precision,
        solver=solver,
    )


def bar() -> tuple[Gaussians, Body]:
    """0.1 x 0.1 x 0.4 m, 16 x 4 x 4 particles, one coloured Gaussian on each."""
    side, tall = torch.arange(4) * DX / 2 + DX / 4 - 0.05, torch.arange(16) * DX / 2 + DX / 4
    x = torch.stack(torch.meshgrid(side, side, tall, indexing="ij"), -1).reshape(-1, 3)
    n = len(x)
    color = 0.5 + 0.4 * torch.sin(40 * x)
    gaussians = Gaussians(
        mean=x,
        log_scale=torch.full((n, 3), DX / 3).log(),
        quaternion=torch.tensor([1.0, 0, 0, 0]).expand(n, 4).contiguous(),
        opacity_logit=torch.full((n,), 2.0),
        sh=((color - 0.5) / 0.28209479177387814)[:, None, :],
    )
    body = Body(
        position=x,
        volume=torch.full((n,), (DX / 2) ** 3),
        part=torch.zeros(n, dtype=torch.int32),
        interior=torch.zeros(n, dtype=torch.bool),
        spacing=DX / 2,
        embedding=embed(x, torch.arange(n), x, DX / 2),
    )
    return gaussians, body


def cameras(count: int = 1) -> tuple[Camera, ...]:
    places = [torch.tensor([0.15 * i, -1.0, 0.3]) for i in range(count)]
    target = torch.tensor([0.0, 0.0, 0.22])
    return tuple(
        Camera(width=48, height=40, fx=60, fy=60, cx=24, cy=20, world_to_camera=look_at(p, target)) for p in places
    )


def learner(start: dict[str, float], learn: tuple[str, ...], **options) -> Learn:
    options = {"steps": 12, "learning_rate": 0.15, "frames": 10, "image_scale": 1.0, "stay": 0.0} | options
    precision, solver = options.pop("precision", "float32"), options.pop("solver", "grid")
    return Learn(world=world(start, precision, solver), prior=options.pop("prior", Exemplar()), learn=learn, **options)


def bar_chain(world: World, field: GlobalField, clip: Capture, frames: int) -> Chain:
    """The bar in this world, compared with the first frames of the take."""
    gaussians, body = bar()
    every = torch.arange(frames)
    return chain_of(
        world,
        Exemplar(),
        ScoreDistillation(),
        field,
        clip,
        gaussians,
        body,
        clip.takes[0],
        every,
        image_scale=1.0,
        device="cpu",
        log=Log(None),
    )


def capture(
    truth: dict[str, float],
    *,
    frames: int = 10,
    fps: float = 20.0,
    views: int = 1,
    held_out=(),
    solver: str = "grid",
    boundaries: tuple[AbstractBoundary, ...] = (),
) -> Capture:
    """Clips rendered by the code under test, with the true parameters."""
    gaussians, _ = bar()
    blank = tuple(torch.zeros((frames, c.height, c.width, 3), dtype=torch.uint8) for c in cameras(views))
    take = Take(
        name="poke", role="learn", fps=fps, cameras=cameras(views), videos=blank, excitation=POKE, held_out_cameras=()
    )
    empty = Capture(name="bar", images=(), cameras=(), names=(), gaussians=gaussians, takes=(take,), truth=truth)
    field = GlobalField(start=world(truth).estimate().parameters, learn=("youngs_modulus",))
    chain = bar_chain(world(truth, solver=solver, boundaries=boundaries), field, empty, frames)
    with torch.no_grad():
        motion = chain.simulate(field.zero())
        videos = [chain.render(motion, view, torch.arange(frames)) for view in range(views)]
    videos = tuple((v.clamp(0, 1) * 255).round().to(torch.uint8) for v in videos)
    take = Take(
        name="poke",
        role="learn",
        fps=fps,
        cameras=cameras(views),
        videos=videos,
        excitation=POKE,
        held_out_cameras=held_out,
    )
    return Capture(name="bar", images=(), cameras=(), names=(), gaussians=gaussians, takes=(take,), truth=truth)
