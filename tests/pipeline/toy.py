"""Throw-away stages to test the machinery with; switches make them slow, fail, or fill the disk."""

import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import torch

from physics3d.checkpoint import Checkpoint
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.metrics.scores import Scores
from physics3d.scenes.base import Capture, Take
from physics3d.video import Video
from physics3d.world import Estimate
from pipeline.flow import STAGES


def configuration(folder: Path, **changes: dict) -> dict:
    """A whole experiment of throw-away stages; `changes` are entries of the stages' configurations."""
    config: dict = {name: {"_target_": "toy.Add", "amount": 1, "name": name} for name in STAGES}
    for name in STAGES:
        config[name]["diary"] = str(folder / "diary")
    diary = str(folder / "diary")
    config["capture"] = {"_target_": "toy.Photograph", "roles": ["learn", "evaluate"], "diary": diary}
    config["guess"] = {"_target_": "toy.Material", "modulus": 1.0, "diary": diary, "name": "guess"}
    config["learn"] = {"_target_": "toy.Material", "modulus": 1.5, "diary": diary, "name": "learn"}
    config["evaluate"] = {"_target_": "toy.Compare", "diary": diary}
    for name, change in changes.items():
        config[name] = None if change is None else config[name] | change
    rest = {"output": str(folder), "device": "cpu", "verify": False, "scene": {"name": "toy"}, "seed": 0}
    return config | rest


ALL = [
    *("capture", "guess", "reconstruct", "segment", "fill", "learn", "simulate", "render"),
    *("simulate_initial", "render_initial", "evaluate"),
]


def clip(value: float) -> Video:
    return Video(frames=(torch.full((2, 4, 4, 3), int(value), dtype=torch.uint8),), fps=1.0, names=("toy",))


def note(diary: str, name: str) -> None:
    """Append a name to a diary, and stay as long as there is a file "stop in <name>" beside it."""
    if not diary:
        return
    with Path(diary).open("a") as lines:
        lines.write(name + "\n")
    place = Path(diary).parent
    if (place / f"stop in {name}").exists():
        with (place / f"processes in {name}").open("a") as lines:
            lines.write(f"{os.getpid()}\n")
    while (place / f"stop in {name}").exists():
        time.sleep(0.02)


@dataclass(frozen=True, kw_only=True)
class Add:
    """Adds `amount` to the pixels of its inputs."""

    amount: int
    diary: str
    name: str
    seconds: float = 0.0
    error: str = ""
    size: int = 0  # of an extra file [byte]
    device: str = "cpu"
    table: dict[str, float] = field(default_factory=dict)

    def __call__(self, *inputs: object, log: Log) -> Video:
        note(self.diary, self.name)
        log.info(f"adding {self.amount}")
        for step in range(3):
            log.metric("curve", self.amount / (step + 1), step)
            log.image("frame", torch.full((8, 8, 3), 0.1 * step), step)
        if self.size:
            log.path("large.bin").write_bytes(bytes(self.size))
        time.sleep(self.seconds)
        if self.error:
            raise ValueError(self.error)
        videos = [v for v in inputs if isinstance(v, Video)]
        return clip(self.amount + sum(int(v.frames[0][0, 0, 0, 0]) for v in videos))


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """A capture of one grey photograph, with takes of the given roles."""

    roles: tuple[str, ...] = ()
    single_object: bool = False
    trained: bool = False
    diary: str = ""

    def __call__(self, *, log: Log) -> Capture:
        note(self.diary, "capture")
        camera = Camera(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, world_to_camera=torch.eye(4).double())
        return Capture(
            name="toy",
            images=(torch.full((8, 8, 3), 128, dtype=torch.uint8),),
            cameras=(camera,),
            names=("grey",),
            takes=tuple(
                Take(name=role, role=role, fps=1.0, cameras=(camera,), videos=clip(0).frames) for role in self.roles
            ),
            gaussians=blob() if self.trained else None,
            single_object=self.single_object,
            truth={"youngs_modulus": 2.0},
        )


@dataclass(frozen=True, kw_only=True)
class Material:
    """An estimate, whatever the inputs."""

    modulus: float
    seconds: float = 0.0
    error: str = ""
    diary: str = ""
    name: str = ""
    prior: object = None
    imagined: object = None

    def __call__(self, *inputs: object, log: Log) -> Estimate:
        note(self.diary, self.name)
        log.info(f"{self.name}: estimating")  # a line that was said by another stage is not said again
        log.metric("loss", 1.0, 0)
        time.sleep(self.seconds)
        if self.error:
            raise ValueError(self.error)
        return Estimate(parameters={"youngs_modulus": torch.tensor(self.modulus)}, velocity=torch.zeros(3))


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Scores the first pixel of the videos."""

    diary: str = ""

    def __call__(
        self, capture: Capture, videos: dict[str, Video], estimates: dict[str, Estimate], *, log: Log
    ) -> Scores:
        note(self.diary, "evaluate")
        assert videos.keys() == estimates.keys()
        return Scores(
            values={k: {"psnr": float(v.frames[0][0, 0, 0, 0]), "vmaf": None} for k, v in videos.items()},
            notes={"vmaf": "too small"},
        )


def blob() -> Gaussians:
    return Gaussians(
        mean=torch.zeros(1, 3),
        log_scale=torch.zeros(1, 3),
        quaternion=torch.ones(1, 4),
        opacity_logit=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )


@dataclass(frozen=True, kw_only=True)
class Counting:
    """A random walk in steps, with a checkpoint after each; a file "stop at <step>" beside the diary says how it ends
    there: kill, or interrupt, after which the file is gone."""

    steps: int
    diary: str
    size: int = 0  # of what a checkpoint holds beside the walk [byte]

    def __call__(self, *, log: Log) -> Video:
        log.info("counting")
        generator, checkpoint = torch.Generator().manual_seed(0), Checkpoint(log)
        begin, walk = 0, torch.zeros(4)
        if kept := checkpoint.load():
            begin, walk = kept["step"], kept["walk"]
            generator.set_state(kept["generator"])
        for step in range(begin, self.steps):
            note(self.diary, str(step))
            walk = walk + torch.rand(4, generator=generator)
            log.metric("curve", float(walk[0]), step)
            log.image("frame", torch.full((8, 8, 3), 0.1 * step), step)
            state = dict(step=step + 1, walk=walk, generator=generator.get_state(), more=torch.zeros(self.size))
            checkpoint.save(state, f"at step {step + 1} of {self.steps}")
            order = Path(self.diary).with_name(f"stop at {step}")
            if order.exists():
                how = order.read_text()
                order.unlink()
                if how == "kill":
                    os.kill(os.getpid(), signal.SIGKILL)
                raise KeyboardInterrupt
        return Video(
            frames=((255 * walk / self.steps).byte().reshape(1, 2, 2, 1).repeat(1, 1, 1, 3),), fps=1.0, names=("toy",)
        )
