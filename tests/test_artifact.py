"""What is saved comes back the same; what was damaged, or is not ours, does not come back at all."""

import json
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from physics3d.artifact import AbstractArtifact, ArtifactError
from physics3d.boundaries.impulse import Impulse
from physics3d.gaussians.cameras import Camera
from physics3d.metrics.scores import Scores
from physics3d.scenes.base import Capture, Take
from physics3d.video import Video


def video(value: int = 7) -> Video:
    frames = torch.full((2, 4, 6, 3), value, dtype=torch.uint8)
    return Video(frames=(frames, frames + 1), fps=24.0, names=("a", "b"))


def test_an_artifact_comes_back_the_same(tmp_path):
    video().save(tmp_path / "video")
    back = AbstractArtifact.load(tmp_path / "video")
    assert isinstance(back, Video) and back.fps == 24.0 and back.names == ("a", "b")
    assert all(torch.equal(a, b) for a, b in zip(back.frames, video().frames))
    scores = Scores(values={"learned": {"psnr": 1.5, "vmaf": None}}, notes={"vmaf": "small"})
    scores.save(tmp_path / "scores")
    assert Scores.load(tmp_path / "scores") == scores


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "fields.json").unlink(),
        lambda folder: (folder / "fields.json").write_text("{"),
        lambda folder: (folder / "arrays.safetensors").write_bytes(b"123"),
        lambda folder: edit(folder, lambda tree: tree["fields"].pop("fps")),
        lambda folder: edit(folder, lambda tree: tree["fields"].update(fps=-1.0)),
        lambda folder: edit(folder, lambda tree: tree["fields"].update(names={"__tensor__": "nothing"})),
        lambda folder: edit(folder, lambda tree: tree.update({"__class__": "physics3d.video:Film"})),
        lambda folder: edit(folder, lambda tree: tree["fields"].update(names=7)),
        lambda folder: edit(folder, lambda tree: tree.update(fields=[])),
        lambda folder: edit(folder, lambda tree: tree.clear()),
        lambda folder: (folder / "fields.json").write_text("null"),
        lambda folder: (folder / "fields.json").write_bytes(b"\xff\xfe"),
        lambda folder: (folder / "fields.json").write_text("[" * 100_000),
        lambda folder: edit(folder, lambda tree: tree["fields"].update(names=nested(40))),
    ],
    ids=[
        *("no fields", "cut off", "no arrays", "missing field", "impossible value", "missing tensor", "unknown class"),
        *("wrong kind", "fields no table", "empty", "null", "no text", "deeper than Python", "deeper than allowed"),
    ],
)
def test_damage_is_an_artifact_error_that_names_the_folder(tmp_path, damage):
    video().save(tmp_path)
    damage(tmp_path)
    with pytest.raises(ArtifactError, match=str(tmp_path)):
        Video.load(tmp_path)


def test_classes_of_others_are_refused(tmp_path):
    video().save(tmp_path)
    edit(tmp_path, lambda tree: tree.update({"__class__": "subprocess:Popen"}))
    with pytest.raises(ArtifactError, match="refusing to load class subprocess:Popen"):
        AbstractArtifact.load(tmp_path)


@pytest.mark.parametrize(
    "name",
    [
        "physics3d.video:write_mp4",  # a function
        "physics3d.video:Path",  # imported there
        "physics3d.video:contact_sheet.__call__",
        "physics3d.scenes.unposed:UnposedSource",  # a dataclass of this project, and no artifact
        "physics3d.world:World",
        "physics3d.scenes.base:Camera",  # under another name than its own
        "physics3d.artifact:AbstractArtifact",
        "physics3d.artifact:dataclasses",
        "stages.render:Render",
        "physics3d.nowhere:X",
        "physics3d.:X",
        "physics3d",
        "",
    ],
)
@pytest.mark.parametrize("place", ["root", "field"])
def test_nothing_is_called_by_name_but_artifacts_and_what_they_declare(tmp_path, name, place):
    video().save(tmp_path)
    called = {"__class__": name, "fields": {}}
    edit(tmp_path, lambda tree: tree.update(called) if place == "root" else tree["fields"].update(fps=called))
    with pytest.raises(ArtifactError, match=str(tmp_path)):
        AbstractArtifact.load(tmp_path)


def test_an_artifact_stands_only_where_it_is_declared(tmp_path):
    """A video declares no video inside of itself."""
    video().save(tmp_path)
    edit(tmp_path, lambda tree: tree["fields"].update(fps=json.loads(json.dumps(tree))))
    with pytest.raises(ArtifactError, match=r"refusing to load class physics3d\.video:Video: no object is expected"):
        AbstractArtifact.load(tmp_path)


def test_what_implements_a_declared_interface_comes_back(tmp_path):
    poke = Impulse(force=(0.0, 0.0, 1.0), centre=(0.0, 0.0, 0.0), radius=0.1, start=0.0, duration=0.1)
    camera = Camera(width=6, height=4, fx=5.0, fy=5.0, cx=3.0, cy=2.0, world_to_camera=torch.eye(4).double())
    clip = torch.zeros(2, 4, 6, 3, dtype=torch.uint8)
    take = Take(name="poke", role="learn", fps=1.0, cameras=(camera,), videos=(clip,), excitation=(poke,))
    Capture(name="x", images=(clip[0],), cameras=(camera,), names=("a",), takes=(take,)).save(tmp_path)
    assert Capture.load(tmp_path).takes[0].excitation == (poke,)


def test_what_is_too_deep_to_be_loaded_is_not_saved(tmp_path):
    with pytest.raises(TypeError, match=r"nested deeper than 32 levels"):
        Scores(values={"a": {"b": nested(40)}}, notes={}).save(tmp_path)


def test_another_class_than_expected_is_an_error(tmp_path):
    video().save(tmp_path)
    with pytest.raises(ArtifactError, match="valid Scores: it holds a Video"):
        Scores.load(tmp_path)


def test_what_cannot_be_stored_is_named(tmp_path):
    @dataclass(frozen=True)
    class Odd(AbstractArtifact):
        table: dict = field(default_factory=lambda: {"a": [np.float32(1), {1, 2}]})

    with pytest.raises(TypeError, match=r"table\.a\.1: cannot store a set"):
        Odd().save(tmp_path)


def nested(levels: int) -> list:
    return [nested(levels - 1)] if levels else []


def edit(folder, change) -> None:
    tree = json.loads((folder / "fields.json").read_text())
    change(tree)
    (folder / "fields.json").write_text(json.dumps(tree))
