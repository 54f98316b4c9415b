"""A source reads no file that `files()` does not list: the pipeline's fingerprints rest on it."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scene_formats as formats
import torch
from clips import FPS, decaying, swaying
from PIL import Image
from test_scenes_loaders import Z_UP, write
from test_scenes_strangers import transforms, write_llff

from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.ply import write_ply
from physics3d.log import Log
from physics3d.scenes.llff import LlffSource
from physics3d.scenes.ply import PlyScene
from physics3d.scenes.thing import ThingSource
from physics3d.scenes.unposed import UnposedSource
from physics3d.video import write_mp4

opened: list[Path] | None = None  # where a test is listening


@pytest.fixture(scope="module", autouse=True)
def ear():
    """An audit hook cannot be taken away again, so it only writes down what happens while a test listens."""

    def hear(event: str, details: tuple) -> None:
        if opened is not None and event == "open" and isinstance(details[0], str):
            opened.append(Path(details[0]))

    sys.addaudithook(hear)


def source(kind: str, folder: Path):
    if kind == "ply":
        n = 5
        cloud = Gaussians(
            mean=torch.rand(n, 3),
            log_scale=torch.full((n, 3), -3.0),
            quaternion=torch.ones(n, 4),
            opacity_logit=torch.zeros(n),
            sh=torch.zeros(n, 1, 3),
        )
        write_ply(folder / "model.ply", cloud)
        return PlyScene(name="x", path=str(folder / "model.ply"), up=(0, 0, 1), scale=1.0, views=1, width=8, height=8)
    if kind in ("photographs", "thing"):
        for i in range(2):  # too few for structure from motion: they are read, then refused
            Image.fromarray(np.full((80, 80, 3), 90 + i, np.uint8)).save(folder / f"{i}.png")
        if kind == "thing":
            write_mp4(folder / "clips" / "a.mp4", swaying(decaying(np.arange(30) / FPS)), FPS)
            return ThingSource(name="x", path=str(folder), camera_distance=1.0)
        return UnposedSource(name="x", path=str(folder), camera_distance=1.0)
    if kind == "llff":
        write_llff(folder, Z_UP)
        return LlffSource(name="x", path=str(folder), up=(0, 0, 1), scale=1.0)
    if kind == "masks and points":
        (folder / "masks").mkdir()
        made = transforms(folder, frame=lambda i, e: e.update(mask_path=f"masks/{i}.png"), ply_file_path="points.ply")
        for i in range(len(list((folder / "images").iterdir()))):
            Image.new("L", (formats.WIDTH, formats.HEIGHT), 255).save(folder / "masks" / f"{i}.png")
        source("ply", folder)
        (folder / "model.ply").rename(folder / "points.ply")
        return made
    made = write(kind, folder, Z_UP)
    if kind == "pinhole":  # pictures that lie elsewhere
        (folder / "cameras").mkdir()
        for name in ("transforms.json", "points3D.npz"):
            (folder / name).rename(folder / "cameras" / name)
        text = (folder / "cameras" / "transforms.json").read_text().replace("images/", "../images/")
        (folder / "cameras" / "transforms.json").write_text(text)
        made = type(made)(name="x", path=str(folder / "cameras"), up=(0, 0, 1), scale=1.0)
    return made


@pytest.mark.parametrize(
    "kind",
    [
        *("blender", "pinhole", "masks and points", "colmap_text", "colmap_binary", "llff", "pac_nerf", "ply"),
        *("photographs", "thing"),
    ],
)
def test_what_is_read_is_listed(kind, tmp_path):
    global opened
    made = source(kind, tmp_path)
    listed = {Path(name).resolve() for name in made.files()}
    opened = []
    try:
        made(log=Log(None))
    except ValueError as error:
        assert kind in ("photographs", "thing") and "at least 3" in str(error)
    finally:
        read = {path.resolve() for path in opened if path.resolve().is_relative_to(tmp_path)}
        opened = None
    assert read and read <= listed
    assert all(path.is_file() for path in listed)
