"""A poke by hand that is kept as a scene: what is read back pushes as the hand did."""

import shutil

import numpy as np
import pytest

from physics3d.boundaries.base import overlap
from physics3d.view.poke import WINDOWS, Record, keep, place
from pipeline import settings
from pipeline.page import problem
from pipeline.stage import build


def record(kind: str, rng: np.random.Generator) -> Record:
    steps, t = 137, np.linspace(0, 1, 137)[:, None]
    forces = {
        "held": np.tile([0.03, -0.01, 0.002], (steps, 1)),
        "drawn": t * [0.05, 0.0, -0.02],
        "shaken": rng.normal(size=(steps, 3)),
        "late": np.where(t > 0.6, 1.0, 0.0) * [0.0, 0.1, 0.0],
        "short": np.tile([0.5, 0.0, 0.0], (2, 1)),
    }[kind]
    centre, radius = place(np.array([0.0361234567, -0.01, 0.2]), 0.012)
    return Record(centre=centre, radius=radius, dt=1 / 73, forces=list(forces))


@pytest.fixture
def scenes(tmp_path, monkeypatch):
    """A copy of conf/, for a scene that is written there."""
    shutil.copytree(settings.CONF, tmp_path / "conf")
    monkeypatch.setattr(settings, "CONF", tmp_path / "conf")
    return tmp_path / "conf" / "scene"


@pytest.mark.parametrize("kind", ["held", "drawn", "shaken", "late", "short"])
@pytest.mark.parametrize("base", ["carnation", "plush"])
def test_what_the_settings_read_back_gives_the_same_impulse(scenes, rng, base, kind):
    poked = record(kind, rng)
    name = keep(scenes, base, poked.impulses(), ("poked at twice the stiffness",))
    config, picked = settings.compose([f"scene={name}", "profile=smoke"])
    assert picked["scene"] == name and config["scene"]["name"] == name and problem(config, {}) is None
    simulate = build(config["simulate"], "cpu", "simulate")
    assert simulate.force is None and 1 <= len(simulate.excitation) <= WINDOWS
    dt, edges = poked.dt, np.arange(0, len(poked.forces) + 1)
    total = np.zeros(3)
    for step in edges:  # whatever steps a solver takes: those of the hand here
        for push in simulate.excitation:
            share = overlap(push.start, push.duration, step * dt, dt)
            total += share * dt * np.array(push.force)
            assert push.centre == poked.centre and push.radius == poked.radius
    by_hand = dt * np.sum(poked.forces, 0)
    size = dt * np.linalg.norm(poked.forces, axis=1).sum()
    # seven digits are written; windows of a thousandth of the largest force are left out
    np.testing.assert_allclose(total, by_hand, atol=1e-5 * size)


def test_a_force_that_grows_is_kept_as_it_grew(rng):
    pushes = record("drawn", rng).impulses()
    size = [np.linalg.norm(p.force) for p in pushes]
    assert len(pushes) == WINDOWS and (np.diff(size) > 0).all()
    assert len(record("held", rng).impulses()) == 1


def test_nothing_is_written_over(scenes, rng):
    pushes = record("held", rng).impulses()
    assert [keep(scenes, "bird", pushes) for _ in range(3)] == ["bird_poke", "bird_poke_2", "bird_poke_3"]


def test_no_poke_is_no_scene():
    with pytest.raises(ValueError, match="drag the body first"):
        Record(centre=(0.0, 0.0, 0.0), radius=0.1, dt=0.01, forces=[np.zeros(3)] * 5).impulses()
