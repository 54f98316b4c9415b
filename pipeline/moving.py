"""The moving Gaussians of a scene that was run, read from what its stages filed."""

from dataclasses import dataclass
from typing import Any

from pipeline.filed import filed
from pipeline.stage import Step, build, peek


@dataclass(frozen=True, kw_only=True)
class SceneMotion:
    """Everything that draws or exports the motion of one scene."""

    scene: str
    capture: Any  # physics3d.scenes.base.Capture
    gaussians: Any  # physics3d.gaussians.model.Gaussians
    body: Any  # physics3d.filling.body.Body
    estimate: Any  # physics3d.world.Estimate
    trajectory: Any  # physics3d.trajectory.Trajectory
    world: Any  # physics3d.world.World
    device: str  # that was asked for: auto, cpu, cuda
    interior: Any  # physics3d.gaussians.interior.Interior, or None where the body never opens


def scene_motion(words: list[str]) -> SceneMotion:
    """Of the scene that the words of a `make run` name. Raises as `filed`."""
    config, _, steps = filed(words, "capture", "guess", "reconstruct", "fill", "learn", "simulate")
    return of_steps(config, steps)


def of_steps(config: dict[str, Any], steps: dict[str, Step]) -> SceneMotion:
    """Raises ArtifactError naming the folder if a result is damaged."""
    from physics3d.log import Log

    capture = read(steps["capture"])
    gaussians = read(steps["reconstruct"]) if "reconstruct" in steps else capture.gaussians
    body, trajectory = read(steps["fill"]), read(steps["simulate"])
    render = build(config["render"], "cpu", "render")
    inside = render.inside(capture, gaussians, body, trajectory, Log(None)) if render.interior else None
    estimate = read(steps["learn"] if "learn" in steps else steps["guess"])
    return SceneMotion(
        scene=peek(steps["capture"].folder)["name"],
        capture=capture,
        gaussians=gaussians,
        body=body,
        estimate=estimate,
        trajectory=trajectory,
        world=build(config["world"], "cpu", "world").weighed(estimate),
        device=config["device"],
        interior=inside,
    )


def read(step: Step) -> Any:
    """A stage's result; a damaged one is an error that names its folder, and not computed again here."""
    from physics3d.artifact import AbstractArtifact

    return AbstractArtifact.load(step.folder)
