"""A video is written whole or not at all, and read whole or not at all; whatever ffmpeg says is heard."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from physics3d.video import read_mp4, write_mp4

ROOT = Path(__file__).resolve().parent.parent


def clip(t: int = 7, h: int = 33, w: int = 41) -> torch.Tensor:
    """A grey ramp that brightens: nothing that compression would change by much."""
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    frames = [(x * 2 + y + 8 * i).clamp(0, 255) for i in range(t)]
    return torch.stack(frames).to(torch.uint8)[..., None].expand(t, h, w, 3).contiguous()


@pytest.mark.parametrize("name", ["a.mp4", "-a b:c?%d 'q'.mp4", "ü (1) [2].mp4", "http:x.mp4"])
def test_what_is_written_comes_back(tmp_path, name, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a bare name must be no option or protocol of ffmpeg
    write_mp4(Path(name), clip(), 29.97)
    frames, fps = read_mp4(Path(name))
    assert frames.shape == (7, 32, 40, 3) and fps == pytest.approx(29.97)  # odd sizes lose a row and a column
    # crf 10 of a smooth ramp: within a few grey levels everywhere
    assert (frames.int() - clip()[:, :32, :40].int()).abs().max() <= 6


@pytest.mark.parametrize(
    "shape, fps", [((2, 1, 8), 30.0), ((2, 8, 1), 30.0), ((0, 8, 8), 30.0), ((2, 8, 8), 0.0), ((2, 8, 8), float("nan"))]
)
def test_what_makes_no_video_is_refused(tmp_path, shape, fps):
    with pytest.raises(ValueError, match=r"a\.mp4: .* make no video"):
        write_mp4(tmp_path / "a.mp4", torch.zeros(*shape, 3, dtype=torch.uint8), fps)
    assert not (tmp_path / "a.mp4").exists()


def test_a_full_disk_fails_and_leaves_nothing(tmp_path):
    """A limit on the size of files, for this process and ffmpeg, stands for the full disk."""
    script = f"""
import resource, signal, sys
from pathlib import Path
import torch
from physics3d.video import write_mp4
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
frames = torch.randint(0, 255, (20, 64, 64, 3), dtype=torch.uint8)
try:
    write_mp4(Path({str(tmp_path / "a.mp4")!r}), frames, 30.0)
except RuntimeError as error:
    sys.exit(f"error: {{error}}")
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.startswith("error: ffmpeg failed with status "), done.stderr
    assert done.stderr.count("\n") == 1 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "program, message",
    [
        ("echo 'no such encoder' >&2; exit 3", r"ffmpeg failed with status 3: no such encoder"),
        ("exit 1", r"ffmpeg failed with status 1: it said nothing"),
        ("kill -9 $$", r"ffmpeg failed with status -9"),
        ("cat >/dev/null; exit 0", r"holds 0 of 7 frames"),  # says that all is well, and has written nothing
        (None, r"no ffmpeg found .* IMAGEIO_FFMPEG_EXE"),
    ],
)
def test_an_ffmpeg_that_fails_is_heard(tmp_path, monkeypatch, program, message):
    fake = tmp_path / "ffmpeg"
    if program is not None:
        fake.write_text(f"#!/bin/sh\n{program}\n")
        fake.chmod(fake.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake))
    with pytest.raises(RuntimeError, match=message) as caught:
        write_mp4(tmp_path / "a.mp4", clip(), 30.0)
    assert "\n" not in str(caught.value) and not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize("damage", ["cut", "overwritten", "empty", "text", "missing", "folder"])
def test_a_damaged_video_is_named(tmp_path, damage):
    path = tmp_path / "a.mp4"
    write_mp4(path, torch.randint(0, 255, (10, 64, 64, 3), dtype=torch.uint8), 30.0)
    data = bytearray(path.read_bytes())
    match damage:
        case "cut":
            path.write_bytes(data[: len(data) // 2])
        case "overwritten":
            data[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
            path.write_bytes(data)
        case "empty" | "text":
            path.write_bytes(b"" if damage == "empty" else b"not a video")
        case _:
            os.remove(path)
            if damage == "folder":
                path.mkdir()
    with pytest.raises(ValueError, match=r"(cannot read the|no) video (at )?.*a\.mp4") as caught:
        read_mp4(path)
    assert "\n" not in str(caught.value)
