"""A run whose stages return a small moving body at once: for the commands that show or export what was filed."""

from dataclasses import dataclass
from pathlib import Path

import torch
from moving_bodies import moving
from toy import Photograph, configuration

from physics3d.filling.body import Body
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.metrics.image import likeness
from physics3d.metrics.scores import Scores
from physics3d.metrics.take_page import take_page
from physics3d.scenes.base import Capture
from physics3d.trajectory import Trajectory
from pipeline.flow import first, plan
from pipeline.stage import Step, run

HARMONICS = 4


@dataclass(frozen=True, kw_only=True)
class Fit:
    def __call__(self, capture: Capture, *, log: Log) -> Gaussians:
        return moving(HARMONICS)[0].gaussians


@dataclass(frozen=True, kw_only=True)
class Cover:
    def __call__(self, *inputs: object, log: Log) -> Body:
        return moving(HARMONICS)[1]


@dataclass(frozen=True, kw_only=True)
class Move:
    def __call__(self, *inputs: object, log: Log) -> Trajectory:
        log.image("motion", torch.rand(40, 60, 3, generator=torch.Generator().manual_seed(0)))
        return moving(HARMONICS)[0].trajectory


@dataclass(frozen=True, kw_only=True)
class Shoot:
    """The capture of the toy, but for a camera that looks at the body."""

    name: str = "it's <a> body"

    def __call__(self, *, log: Log) -> Capture:
        from dataclasses import replace

        capture = Photograph(roles=("learn", "evaluate"))(log=log)
        pose = look_at(torch.tensor([0.5, -0.9, 0.4]), torch.zeros(3))
        camera = Camera(width=64, height=48, fx=80.0, fy=80.0, cx=32.0, cy=24.0, world_to_camera=pose)
        takes = tuple(
            replace(take, cameras=(camera,), videos=(torch.zeros(5, 48, 64, 3, dtype=torch.uint8),))
            for take in capture.takes
        )
        return replace(capture, name=self.name, takes=takes)


def moved_configuration(folder: Path) -> dict:
    """Of everything but the numbers that the commands do not read."""
    config = configuration(folder)
    config |= {
        "capture": {"_target_": "moved.Shoot"},
        "reconstruct": {"_target_": "moved.Fit"},
        "fill": {"_target_": "moved.Cover"},
        "simulate": {"_target_": "moved.Move"},
        "render": {"_target_": "stages.render.Render"},
        "world": {
            "_target_": "physics3d.world.World",
            "material": {"_target_": "physics3d.materials.viscoelastic.Viscoelastic", "branches": 0},
            "start": {"youngs_modulus": 2e4, "poissons_ratio": 0.3},
            "density": 300.0,
            "dx": 0.1,
        },
    }
    return config


def run_all(config: dict) -> dict[str, Step]:
    """As `make run` does, without Prefect; the steps by name."""
    capture = first(config, Path(config["output"]) / "artifacts")
    run(capture, "cpu")
    whole = plan(config, capture)
    for step in whole.steps:
        run(step, "cpu")
    return {step.name: step for step in whole.steps}


@dataclass(frozen=True, kw_only=True)
class Film:
    """The same, with two takes of which nobody knows what pushed the body; their names may be any words."""

    names: tuple[str, str] = ("a: poke", "<b>")

    def __call__(self, *, log: Log) -> Capture:
        from dataclasses import replace

        capture = Shoot()(log=log)
        video = torch.randint(0, 255, (30, 48, 64, 3), generator=torch.Generator().manual_seed(0)).byte()
        takes = tuple(
            replace(take, name=name, videos=(video,), excitation=None) for name, take in zip(self.names, capture.takes)
        )
        return replace(capture, takes=takes)


@dataclass(frozen=True, kw_only=True)
class Predict:
    """Foretells what the last frame seen shows, and writes the pages of the takes."""

    def __call__(self, capture: Capture, *inputs: object, log: Log) -> Scores:
        values = {}
        for k, take in enumerate(capture.takes):
            seen, video = 15, take.videos[0]
            clips = {name: video[seen - 1].expand(15, -1, -1, -1) for name in ("modes as seen", "image modes")}
            rows = {name: {"psnr": 10.125 + k, "frequency": None} for name in clips}
            like = {name: likeness(clip, video[seen:]) for name, clip in clips.items()}
            lines = {name: {"PSNR [dB]": each.psnr_per_frame, "SSIM": each.ssim} for name, each in like.items()}
            take_page(
                take.name, video, take.fps, clips, rows, lines,
                by_length={}, seen=seen, said=["it swings"], best="modes as seen", bar="image modes", log=log,
            )  # fmt: skip
            values |= {f"{take.name}: {name}": row for name, row in rows.items()}
        return Scores(values=values, notes={f"{capture.takes[0].name}: frequency": "nothing swings"})


def foretold_configuration(folder: Path) -> dict:
    """Of a run whose takes have no known cause."""
    stages = {"capture": {"_target_": "moved.Film"}, "foretell": {"_target_": "moved.Predict"}}
    return moved_configuration(folder) | stages
