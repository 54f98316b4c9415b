"""What a stage reads belongs to its fingerprint, wherever it lies, also where nobody imports the code that reads it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from pipeline.stage import Step, Unknown

ROOT = Path(__file__).resolve().parent.parent.parent
POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
LIGHT = """
import json, sys
from pathlib import Path
from pipeline.stage import Step
print(Step.of("capture", "capture", json.loads(sys.argv[1]), (), Path(sys.argv[2]), ask=False).fingerprint)
assert not {"torch", "PIL", "numpy"} & set(sys.modules)
"""


@pytest.fixture
def scene(tmp_path) -> Path:
    """cameras/transforms.json names pictures in images/, one of them by an absolute path."""
    root = tmp_path / "scene"
    (root / "images").mkdir(parents=True)
    (root / "cameras").mkdir()
    for name in ("0.png", "1.png"):
        Image.new("RGB", (4, 4), (9, 9, 9)).save(root / "images" / name)
    files = ["../images/0.png", str(root / "images" / "1.png")]
    frames = [{"file_path": name, "transform_matrix": POSE} for name in files]
    (root / "cameras" / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return root


def config(path: Path) -> dict:
    source = {"_target_": "physics3d.scenes.transforms.TransformsSource", "name": "x", "up": [0, 0, 1], "scale": 1.0}
    return {"_target_": "stages.capture.LoadCapture", "source": source | {"path": str(path)}}


def key(path: Path, shelf: Path, ask: bool = True) -> str:
    return Step.of("capture", "capture", config(path), (), shelf, ask).fingerprint


@pytest.mark.parametrize("entry", ["cameras", "cameras/transforms.json"])
@pytest.mark.parametrize("picture", ["0.png", "1.png"])
def test_a_picture_that_lies_elsewhere_matters(scene, tmp_path, entry, picture):
    shelf = tmp_path / "artifacts"
    with pytest.raises(Unknown):  # nobody has asked yet what is read
        key(scene / entry, shelf, ask=False)
    before = key(scene / entry, shelf)
    assert key(scene / entry, shelf, ask=False) == before
    file = scene / "images" / picture
    kept = file.read_bytes()
    Image.new("RGB", (4, 4), (9, 9, 8)).save(file)
    after = key(scene / entry, shelf, ask=False)
    assert after != before and after == key(scene / entry, shelf)
    file.write_bytes(kept)
    assert key(scene / entry, shelf, ask=False) == before
    file.unlink()
    assert key(scene / entry, shelf, ask=False) not in (before, after)


def test_the_answer_is_remembered_for_its_place_and_content_only(scene, tmp_path):
    """A copy of the data has files of its own: those of the original must not be looked at in their place."""
    shelf, copy = tmp_path / "artifacts", tmp_path / "copy"
    text = (scene / "cameras" / "transforms.json").read_text().replace(str(scene / "images"), "../images")
    (scene / "cameras" / "transforms.json").write_text(text)
    before = key(scene / "cameras", shelf)
    shutil.copytree(scene, copy)
    with pytest.raises(Unknown):
        key(copy / "cameras", shelf, ask=False)
    assert key(copy / "cameras", shelf) == before  # equal content: nothing is computed again
    Image.new("RGB", (4, 4)).save(copy / "images" / "0.png")
    assert key(copy / "cameras", shelf, ask=False) != before == key(scene / "cameras", shelf, ask=False)
    frames = json.loads(text)["frames"][:1]
    (copy / "cameras" / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    with pytest.raises(Unknown):
        key(copy / "cameras", shelf, ask=False)


def test_the_light_way_imports_nothing_heavy(scene, tmp_path):
    shelf = tmp_path / "artifacts"
    before = key(scene / "cameras", shelf)
    call = [sys.executable, "-c", LIGHT, json.dumps(config(scene / "cameras")), str(shelf)]
    done = subprocess.run(call, cwd=os.getcwd(), env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True)
    assert done.stdout.decode().strip() == before, done.stderr.decode()


@pytest.mark.parametrize("memory", ["null", "[]", "{", '{"KEY": 1}', '{"KEY": [["x"]]}', '{"KEY": [[1, 2]]}'])
def test_a_damaged_memory_is_none(scene, tmp_path, memory):
    shelf = tmp_path / "artifacts"
    before = key(scene / "cameras", shelf)
    file = shelf / ".reads.json"
    (question,) = json.loads(file.read_text())
    file.write_text(memory.replace("KEY", question))
    with pytest.raises(Unknown):
        key(scene / "cameras", shelf, ask=False)
    assert key(scene / "cameras", shelf) == before == key(scene / "cameras", shelf, ask=False)


def test_weights_that_are_nowhere_are_said_before_anything_is_computed(tmp_path, monkeypatch):
    from huggingface_hub import constants

    from pipeline.stage import StageError

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    masker = {"_target_": "physics3d.segmentation.maskers.sam2.Sam2", "weights": "nobody/no-such-model"}
    stage = {"_target_": "stages.segment.Segment", "prompts": [], "masker": masker}
    with pytest.raises(StageError, match=r"^segment: masker\.weights=nobody/no-such-model is neither"):
        Step.of("segment", "segment", stage, (), tmp_path)
    weights = tmp_path / "sam2.pt"
    weights.write_bytes(b"abc")
    masker["weights"] = str(weights)
    before = Step.of("segment", "segment", stage, (), tmp_path / "artifacts").fingerprint
    weights.write_bytes(b"abd")
    assert Step.of("segment", "segment", stage, (), tmp_path / "artifacts").fingerprint != before
