"""PAC-NeRF captures that are incomplete or wrong are refused in one line that names what is wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
import scene_formats as formats
from PIL import Image

from physics3d.log import Log
from physics3d.scenes.axes import Axes
from physics3d.scenes.pac_nerf import PacNerfSource


@pytest.fixture
def folder(tmp_path) -> Path:
    formats.write_pac_nerf(tmp_path, Axes(up=(0.0, 1.0, 0.0), scale=1.0))
    return tmp_path


def change(folder: Path, edit) -> None:
    file = folder / "all_data.json"
    entries = json.loads(file.read_text())
    file.write_text(json.dumps(edit(entries) or entries))


def each(key, value):
    """Put `value(old)` at `key` of the entry of camera 1, frame 1."""

    def edit(entries):
        entry = next(e for e in entries if "r_1_1" in e["file_path"])
        entry[key] = value(entry[key])

    return edit


def mirrored(c2w):
    return (np.array(c2w) * [-1, 1, 1, 1]).tolist()


def at(i, j, number):
    def put(matrix):
        matrix[i][j] = number
        return matrix

    return put


ENTRIES = {
    "NaN in a pose": (each("c2w", at(0, 3, float("nan"))), r"a_1_1\.png.*NaN"),
    "mirrored": (each("c2w", mirrored), r"a_1_1\.png.*mirroring"),
    "not orthonormal": (each("c2w", at(0, 0, 5.0)), r"a_1_1\.png.*not a rotation"),
    "short pose": (each("c2w", lambda m: m[:2]), r"a_1_1\.png: its entry needs c2w"),
    "zero focal length": (each("intrinsic", at(0, 0, 0.0)), r"a_1_1\.png.*focal length 0"),
    "negative focal length": (each("intrinsic", at(1, 1, -60.0)), r"a_1_1\.png.*focal length 60, -60"),
    "NaN in a lens": (each("intrinsic", at(0, 2, float("nan"))), r"a_1_1\.png: intrinsic"),
    "transposed lens": (each("intrinsic", lambda K: np.array(K).T.tolist()), r"a_1_1\.png: intrinsic"),
    "NaN in time": (each("time", lambda t: float("nan")), "all_data.json.*time"),
    "another instant": (each("time", lambda t: t + 0.01), r"a_.*_1\.png is of time"),
    "listed twice": (lambda e: [*e, e[-2]], "listed twice"),
    "a camera that moves": (each("c2w", at(0, 3, 3.0)), r"a_1_1\.png: its camera differs from that of frame 0"),
    "time stands still": (lambda e: [{**x, "time": 0.0} for x in e], "time runs from 0.0 to 0.0"),
}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_wrong_entry_is_named(name, folder):
    edit, message = ENTRIES[name]
    change(folder, edit)
    refused(folder, message)


def resize(file: Path) -> None:
    Image.open(file).resize((40, 30)).save(file)


FILES = {
    "cut short": (lambda f: f.write_bytes(f.read_bytes()[: f.stat().st_size // 2]), r"a_1_1\.png"),
    "empty": (lambda f: f.write_bytes(b""), r"a_1_1\.png is empty"),
    "another size": (resize, r"a_1_1\.png .*frame 0 of its camera"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_wrong_picture_is_named(name, folder):
    spoil, message = FILES[name]
    spoil(folder / "data/a_1_1.png")
    refused(folder, message)


def test_a_first_frame_without_matte_is_named(folder):
    file = folder / "data/a_1_0.png"
    Image.open(file).convert("RGB").save(file)
    refused(folder, r"a_1_0\.png has no alpha channel")


def test_lost_frames_are_named(folder):
    (folder / "data/a_1_1.png").unlink()
    refused(folder, r"share frames \[0, 2\]")
    (folder / "data/a_1_0.png").unlink()
    refused(folder, r"a_C_0\.png")


def refused(folder: Path, message: str) -> None:
    source = PacNerfSource(name="x", path=str(folder), truth={})
    with pytest.raises(ValueError, match=message) as caught:
        source(log=Log(None))
    assert "\n" not in str(caught.value)
