"""The pipeline as a graph: which stage takes what, and which stages a scene does not need.

    capture -> reconstruct -> segment -> fill -> learn -> simulate -> render -> evaluate
                                                       -> foretell (where the cause of the recorded motion is unknown)
                                 guess (the configured material) -> learn's start, and what is compared with

`plan` writes the graph down without running anything, so that "is everything up to date?" is answered in a second;
`execute` runs it as a Prefect flow, one task per step. An entry `use.<step>` puts a filed result in a step's place.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.fields import declared
from pipeline.page import STAGES
from pipeline.server import server
from pipeline.stage import Filed, Part, StageError, Step, Unknown, as_task, build, damage, load, peek, usual_seconds


@dataclass(frozen=True)
class Plan:
    """Steps in an order in which they can run, and the stages that are left out, with the reason."""

    steps: list[Step]
    left_out: dict[str, str] = field(default_factory=dict)


def first(config: dict[str, Any], shelf: Path, ask: bool = True) -> Step:
    """The step that everything else depends on: what it finds decides which stages are needed.

    `ask` sources what they read, see `Step.of`, here and in `plan`.
    """
    return _step("capture", "capture", config, (), shelf, ask)


def _step(name: str, stage: str, config: dict[str, Any], inputs: tuple[Any, ...], shelf: Path, ask: bool) -> Step:
    if key := config.get("use", {}).get(name):
        return Step.take(name, stage, key, shelf)
    return Step.of(name, stage, config[stage], inputs, shelf, ask)


def plan(config: dict[str, Any], capture: Step, ask: bool = True, found: dict[str, Any] | None = None) -> Plan:
    """The graph of a scene whose capture has been filed, or, as far as can be known, is like `found`, see `peek`."""
    found = found or peek(capture.folder)
    without = left_out(config, found, capture.shelf)
    steps = [capture]

    def step(name: str, *inputs: Any, stage: str | None = None) -> Step:
        steps.append(_step(name, stage or name, config, inputs, capture.shelf, ask))
        return steps[-1]

    guess = step("guess")
    gaussians = capture.part("gaussians") if "reconstruct" in without else step("reconstruct", capture)
    segmentation = None if "segment" in without else step("segment", capture, gaussians)
    body = step("fill", capture, gaussians, segmentation)
    if _recorded(found) and (config["learn"] or {}).get("imagined"):
        # what would be imagined without a recording is nothing to learning from one
        config = config | {"learn": config["learn"] | {"imagined": None}}
    estimate = guess if "learn" in without else step("learn", capture, gaussians, body)
    trajectory = step("simulate", body, estimate)
    video = step("render", capture, gaussians, body, trajectory)
    if cause_unknown(found) and not {"foretell", "learn"} & set(without):
        step("foretell", capture, gaussians, body, estimate)
    if "evaluate" not in without:
        videos, estimates = {"learned": video}, {"learned": estimate}
        if "learn" in without:
            videos, estimates = {"initial": video}, {"initial": estimate}
        else:
            motion = step("simulate_initial", body, guess, stage="simulate")
            videos["initial"] = step("render_initial", capture, gaussians, body, motion, stage="render")
            estimates["initial"] = guess
        step("evaluate", capture, videos, estimates)
    names = [s.name for s in steps]
    if idle := [name for name, key in config.get("use", {}).items() if key and name not in names]:
        raise StageError(f"use.{idle[0]} takes the place of no step of this scene; set use.{idle[0]}=null")
    return Plan(steps, without)


def left_out(config: dict[str, Any], capture: dict[str, Any], shelf: Path) -> dict[str, str]:
    """Stage -> why this scene, or this method, does without it, and the time that saves, as far as earlier runs on this
    shelf tell. `capture` is the stored Capture, see `peek`."""
    why = {name: f"the configuration says {name}=null" for name in STAGES if config.get(name) is None}
    roles = {take["role"] for take in capture["takes"]}
    if capture["gaussians"] is not None:
        why["reconstruct"] = "the scene is a trained model already"
    if capture["single_object"]:
        why["segment"] = "the scene is a single object"
    elif not capture.get("images", True):
        why["segment"] = "the scene has no photographs, and says itself what moves"
    if not _recorded(capture) and config.get("learn") is not None and _needs_clip(config["learn"].get("prior")):
        why["learn"] = "the scene has no recorded motion to learn from, and the prior knows no other"
    if not roles:
        why["evaluate"] = "the scene has no recorded motion to compare with"
    if cause_unknown(capture):
        why["evaluate"] = "nobody knows what set the recorded motion going: it is foretold instead"
    for name in why:
        usual = usual_seconds(shelf, name)
        if usual is not None:
            why[name] += f"; it took {usual:.0f} s in other runs here"
    return why


def _recorded(capture: dict[str, Any]) -> bool:
    """Whether there is a motion to learn from."""
    return any(take["role"] == "learn" for take in capture["takes"])


def _needs_clip(prior: dict[str, Any] | None) -> bool:
    """Whether a prior knows nothing but recordings, as its source says."""
    return prior is None or bool(declared(prior["_target_"]).constants["needs_clip"])


def cause_unknown(capture: dict[str, Any]) -> bool:
    """Whether nobody knows what set the motion going that is learned from. `capture` is the stored Capture."""
    return any(take["role"] == "learn" and take.get("excitation", ()) is None for take in capture["takes"])


def up_to_date(config: dict[str, Any], shelf: Path, verify: bool) -> Plan | None:
    """The plan, if every step of it has been filed already, else None."""
    try:
        capture = first(config, shelf, ask=False)
        if damage(capture, verify):
            return None
        whole = plan(config, capture, ask=False)
    except Unknown:
        return None
    return None if any(damage(step, verify) for step in whole.steps) else whole


def execute(
    config: dict[str, Any],
    shelf: Path,
    home: Path,
    device: str,
    verify: bool,
    begin: Callable[[Step], None],
    done: Callable[[Filed], None],
) -> tuple[Plan, list[Filed]]:
    """Run the graph under Prefect; `begin` is called before each step that is computed, `done` after every one. Raises
    StageError with one line."""

    stages: dict[str, Any] = {}

    def prepare() -> None:
        stages.update(built(config, device))
        first(config, shelf)  # data that is not there is said before a server is waited for

    with server(home, meanwhile=prepare):
        from prefect import flow

        @flow(name="physics3d", flow_run_name=config["scene"]["name"], persist_result=False)
        def physics3d() -> tuple[Plan, list[Filed]]:
            filed: dict[Step, Filed] = {}
            said: set[str] = set()  # what holds the body, and how well, is true of learning and of simulating it

            def compute(step: Step) -> None:
                if damage(step, verify):
                    begin(step)
                filed[step] = as_task(step, device, verify, said)([filed[s] for s in before(step)])
                done(filed[step])

            capture = first(config, shelf)
            compute(capture)
            whole = plan(config, capture)
            suit(stages, getattr(load(capture, device), "outline", None), idle(config) | whole.left_out)
            for name, why in whole.left_out.items():
                print(f"{name:>16} | left out: {why}", flush=True)
            for step in whole.steps[1:]:
                compute(step)
            return whole, list(filed.values())

        return physics3d()


def built(config: dict[str, Any], device: str) -> dict[str, Any]:
    """Every stage, built once, so that a bad value, or a program that is missing, is found before hours of work, not
    after. Raises StageError."""
    from physics3d.video import ffmpeg

    try:
        stages = {name: build(config.get(name), device, name) for name in STAGES}
        ffmpeg()
    except (ValueError, RuntimeError) as error:
        raise StageError(str(error)) from error
    suit(stages, getattr(getattr(stages["capture"], "source", None), "outline", None), idle(config))
    return stages


def idle(config: dict[str, Any]) -> dict[str, str]:
    """Stages that are not run because a result is taken in their place."""
    return {name: "a result is taken in its place" for name, key in config.get("use", {}).items() if key}


def suit(stages: dict[str, Any], outline: Any, left_out: dict[str, str]) -> None:
    """Raise StageError if a stage cannot take a capture of this outline: before the work on it, not after."""
    for name, stage in stages.items():
        if outline is not None and name not in left_out and hasattr(stage, "fits"):
            try:
                stage.fits(outline)
            except ValueError as error:
                raise StageError(f"{name}: {error}") from error


def before(step: Step) -> list[Step]:
    """The steps behind a step's inputs."""
    sources = [s for i in step.inputs for s in (i.values() if isinstance(i, dict) else [i])]
    return [s.step if isinstance(s, Part) else s for s in sources if s is not None]
