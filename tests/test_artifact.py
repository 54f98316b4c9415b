"""What is saved comes back the same; what was damaged, or is not ours, does not come back at all."""

import json
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from physics3d.artifact import AbstractArtifact, ArtifactError
from physics3d.metrics.scores import Scores
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
    ],
    ids=["no fields", "cut off", "no arrays", "missing field", "impossible value", "missing tensor", "unknown class"],
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


def edit(folder, change) -> None:
    tree = json.loads((folder / "fields.json").read_text())
    change(tree)
    (folder / "fields.json").write_text(json.dumps(tree))
