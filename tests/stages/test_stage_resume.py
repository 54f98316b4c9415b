"""Reconstruction and learning, stopped again and again, end with the bits and curves of a run that nobody stopped."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from interrupted import Interrupted
from small_scene import DAMPED, ELASTIC, bar, capture, learner
from test_stage_reconstruct import QUICK, make_capture

import physics3d.checkpoint
from physics3d.artifact import AbstractArtifact, encode
from physics3d.gaussians.adam import Rates
from physics3d.gaussians.densification.adaptive import Adaptive
from physics3d.gaussians.densification.relocation import Relocation
from physics3d.log import METRICS, Log

SHORT = replace(QUICK, iterations=24, max_gaussians=150, check_every=6, densification=Adaptive(every=4))
FITS = {
    "adaptive, exposures": replace(SHORT, exposure=True),
    "relocation, harmonics": replace(SHORT, densification=Relocation(every=4), sh_degree=1),
}


def points(folder: Path) -> list[tuple[str, int | None, float]]:
    lines = map(json.loads, (folder / METRICS).read_text().splitlines())
    return [(line["name"], line["step"], line["value"]) for line in lines]


def resumptions(folder: Path) -> int:
    return (folder / "stopped" / "log.txt").read_text().count("resuming")


def assert_unchanged_by_stops(
    stage: Callable[[Log], AbstractArtifact], folder: Path, stops: tuple[int | str, ...]
) -> None:
    """`stops`: after how many items of its bars, or at which line, each run is interrupted, before one that is not."""
    straight = stage(Log(folder / "straight", quiet=True))
    for after in stops:
        with pytest.raises(KeyboardInterrupt):
            stage(Interrupted(folder / "stopped", after))
        (folder / "stopped" / METRICS).unlink(missing_ok=True)  # as `pipeline/stage.py` does
    resumed = stage(Log(folder / "stopped", quiet=True))
    (tree, tensors), (same, others) = encode(straight), encode(resumed)
    assert tree == same and all(torch.equal(tensors[name], others[name]) for name in tensors | others)
    assert points(folder / "stopped") == points(folder / "straight")
    shown = [sorted(p.name for p in (folder / which / "previews").glob("*")) for which in ("straight", "stopped")]
    assert shown[0] == shown[1]
    for name in shown[0]:
        one, other = ((folder / which / "previews" / name).read_bytes() for which in ("straight", "stopped"))
        assert one == other, name


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
def test_a_fit_of_gaussians_ends_as_if_it_had_not_been_stopped(tmp_path, monkeypatch, fit):
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)  # a checkpoint after every step
    scene = make_capture(matte=True, points=True)
    # before and after Gaussians are added, between two looks and right after one
    assert_unchanged_by_stops(lambda log: fit(scene, log=log), tmp_path, (1, 5, 8, 4))
    assert resumptions(tmp_path) == 4


def test_what_a_fit_did_after_its_last_checkpoint_is_done_again_and_not_told_twice(tmp_path, monkeypatch):
    """It ends early, at the second look after Gaussians were added: what was best, and since when, is remembered."""
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.05)  # a checkpoint after some of the steps
    scene = make_capture(matte=False, points=True)
    still = Rates(mean=1e-6, log_scale=1e-5, sh=1e-5)
    fit = replace(SHORT, iterations=30, check_every=2, patience=2, rates=still)
    assert_unchanged_by_stops(lambda log: fit(scene, log=log), tmp_path, (12, 7))
    assert max(step for _, step, _ in points(tmp_path / "straight") if step is not None) < 30


@pytest.mark.parametrize(
    ("solver", "start", "stops"),
    [
        # in the search, the descent, while the polish looks around, and behind what the intervals are made of
        ("grid", ELASTIC, (1, 3, 8, "residuals hang together")),
        # without a grid, as a body that is held learns by default: while its basis is made, and when all is learned
        ("modes", DAMPED, ("224 pieces", 9, 15, "youngs_modulus: 1.5e+04")),
    ],
)
def test_learning_ends_as_if_it_had_not_been_stopped(tmp_path, monkeypatch, solver, start, stops):
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    clip = capture(start, frames=3, solver=solver)
    options = dict(search=2, steps=2, polish=1, frames=3, frames_per_step=2, stay=0.01, solver=solver)
    learn = tuple(name for name in start if name in ("youngs_modulus", "shear_relaxation_time"))
    stage = learner(start | {"youngs_modulus": 1.5e4}, learn, **options)
    assert_unchanged_by_stops(lambda log: stage(clip, *bar(), log=log), tmp_path, stops)
    assert resumptions(tmp_path) == len(stops)
    assert f"solver: {solver}" in (tmp_path / "straight" / "log.txt").read_text()
