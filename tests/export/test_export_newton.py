"""Our USD in somebody else's simulator: Newton's MPM swings what we wrote as we do. Needs `pip install newton`."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scene import ELASTIC, world

from physics3d.export.moving import Moving
from physics3d.export.usd import write_usd
from physics3d.filling.body import Body
from physics3d.gaussians.embedding import embed
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.solver import motion_of

SIDE, TALL, HELD = 0.1, 0.4, 0.05  # of a bar and of its foot [m]
ACROSS = 8  # particles: four cells
FPS, SECONDS = 100.0, 1.3
KICK = 0.15  # at its top [m/s]


def bar() -> Body:
    spacing = SIDE / ACROSS
    side = (torch.arange(ACROSS) + 0.5) * spacing - SIDE / 2
    x = torch.cartesian_prod(side, side, (torch.arange(round(TALL / spacing)) + 0.5) * spacing)
    return Body(
        position=x,
        volume=torch.full((len(x),), spacing**3),
        part=torch.zeros(len(x), dtype=torch.int32),
        interior=torch.zeros(len(x), dtype=torch.bool),
        spacing=spacing,
        embedding=embed(x[:1], torch.arange(1), x, spacing),
        attached=x[:, 2] < HELD,
    )


def frequency(way: np.ndarray, dt: float) -> float:
    """[Hz] of a swing, from where it passes through zero."""
    before = np.flatnonzero(np.diff(np.sign(way[1:])) != 0) + 1
    zeros = (before + way[before] / (way[before] - way[before + 1])) * dt
    assert len(zeros) >= 2, "not one whole swing"
    return 0.5 / float(np.diff(zeros).mean())


def by_newton(path, velocity: np.ndarray, top: np.ndarray) -> np.ndarray:
    """Mean way of the top [m] along x, step by step. What the file says is held becomes particles without mass, which
    is how Newton holds them."""
    import newton
    from newton.solvers import SolverImplicitMPM
    from pxr import Usd, UsdGeom

    builder = newton.ModelBuilder()
    SolverImplicitMPM.register_custom_attributes(builder)
    stage = Usd.Stage.Open(str(path))
    scene = builder.add_usd(stage, load_visual_shapes=False)["particle_scene_path"]
    config = SolverImplicitMPM.Config.create_from_usd(stage.GetPrimAtPath(scene))
    model = builder.finalize(device="cpu")
    assert config.voxel_size == pytest.approx(2 * SIDE / ACROSS)
    assert model.particle_mass.numpy().sum() == pytest.approx(300.0 * SIDE**2 * TALL, rel=1e-5)
    particles = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/Body/Particles"))
    held = np.array(particles.GetPrimvar("physics3d:attached").Get()) > 0
    model.particle_mass.assign(np.where(held, 0.0, model.particle_mass.numpy()).astype(np.float32))
    now, then = model.state(), model.state()
    now.particle_qd.assign(velocity)
    solver = SolverImplicitMPM(model, config=config)
    start, way = now.particle_q.numpy().copy(), [0.0]
    for _ in range(round(SECONDS * FPS)):
        solver.step(now, then, None, None, 1 / FPS)
        now, then = then, now
        way.append(float((now.particle_q.numpy() - start)[top, 0].mean()))
    assert np.abs(now.particle_q.numpy() - start)[held].max() == 0
    return np.array(way)


def test_newton_reads_our_usd_and_swings_as_we_do(tmp_path):
    pytest.importorskip("newton", reason="newton is not installed; pip install newton usd-core")
    body = bar()
    x, top = body.position, body.position[:, 2] > TALL - 0.03
    of = replace(world(ELASTIC), dx=2 * body.spacing, boundaries=(), solver="modes")
    parameters = of.estimate().parameters
    velocity = torch.zeros_like(x)
    velocity[:, 0] = KICK * ((x[:, 2] - HELD).clamp(min=0) / (TALL - HELD)) ** 2
    motion = motion_of(of, x, body.volume, excitation=body.held, device="cpu", log=Log(None))
    frames = round(SECONDS * FPS) + 1
    ours = motion(parameters, velocity=velocity, frames=frames, frame_dt=1 / FPS, log=Log(None))
    dot = Gaussians(
        mean=x[:1],
        log_scale=torch.full((1, 3), -4.0),
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logit=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    still = replace(ours, **{name: getattr(ours, name)[:1] for name in ("position", "velocity", "deformation")})
    made = Moving(gaussians=dot, embedding=body.embedding, trajectory=still, interior=None)
    write_usd(tmp_path / "bar.usdc", made, body, of, parameters, log=Log(None))

    theirs = frequency(by_newton(tmp_path / "bar.usdc", velocity.numpy(), top.numpy()), 1 / FPS)
    mine = frequency((ours.position[:, top, 0] - x[top, 0]).mean(1).numpy(), 1 / FPS)
    # four cells across: what holds it is felt half a cell farther up by a grid
    assert theirs == pytest.approx(mine, rel=0.05)
