"""make export and make film: what was filed goes out whole, or not at all, and every mistake is one line."""

import os
import shlex
import shutil

import pytest
from moved import moved_configuration, run_all
from moving_bodies import FPS, FRAMES, MOVING, STILL

from physics3d.gaussians.ply import read_ply
from physics3d.video import read_mp4
from pipeline import export, filed, film


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The configuration of a scene that was run."""
    config = moved_configuration(tmp_path_factory.mktemp("run"))
    run_all(config)
    return config


@pytest.fixture
def command(scene, monkeypatch, capsys):
    """Runs a command of the scene: (exit code, what it printed, what it said is wrong)."""
    monkeypatch.setattr(filed, "compose", lambda words: (scene, {}))

    def call(module, **environment):
        code = module.main([], {name: str(value) for name, value in environment.items()})
        told = capsys.readouterr()
        return code, told.out, told.err

    return call


def nothing_else(folder, *names):
    assert sorted(os.listdir(folder)) == sorted(names)


@pytest.mark.parametrize(
    "kind, suffix, count",
    [("ply", ".ply", FRAMES), ("usd", ".usdc", 1), ("gltf", ".glb", 1), ("spz", ".spz", 1)],
)
def test_every_format_goes_into_its_folder(command, tmp_path, kind, suffix, count):
    out = tmp_path / "new" / "it's here"
    code, said, wrong = command(export, FORMAT=kind, OUT=out)
    assert (code, wrong) == (0, "")
    files = list(out.iterdir())
    assert len(files) == count and {f.suffix for f in files} == {suffix}
    nothing_else(out.parent, "it's here")
    # the size is said before, and not below what is written
    before, after = (line.split() for line in said.splitlines())
    assert before[0] == "writing" and after[0] == "written" and "MB," in said
    most = float(said.split("at most ")[1].split(" MB")[0])
    assert sum(f.stat().st_size for f in files) <= most * 1.01e6


def test_a_frame_of_the_sequence_is_a_model_that_the_project_reads(command, tmp_path):
    assert command(export, FORMAT="ply", OUT=tmp_path / "out")[0] == 0
    frame = read_ply(tmp_path / "out" / "frame0004.ply")
    assert len(frame) == MOVING + STILL + 8  # and the particles inside: the body opens


@pytest.mark.parametrize(
    "environment, code, message",
    [
        ({"FORMAT": "obj"}, 2, "FORMAT=obj: take one of ply, usd, gltf, spz"),
        ({"FORMAT": "spz", "FRAME": "5"}, 1, "there is no frame 5; take one of 0 to 4"),
        ({"FORMAT": "gltf", "FRAME": "five"}, 2, "FRAME=five is no number"),
        ({"FORMAT": "gltf", "FRAME": "5"}, 1, "there is no frame 5; take one of 0 to 4"),
    ],
)
def test_what_cannot_be_exported_is_one_line(command, tmp_path, environment, code, message):
    got, _, wrong = command(export, OUT=tmp_path / "out", **environment)
    assert got == code and message in wrong and wrong.count("\n") == 1
    nothing_else(tmp_path)


@pytest.mark.parametrize("module, name", [(export, "out"), (film, "out.mp4")])
def test_what_is_there_already_is_kept(command, tmp_path, module, name):
    (tmp_path / name).write_text("mine")
    code, said, wrong = command(module, FORMAT="gltf", OUT=tmp_path / name)
    assert code == 1 and not said and "is there already" in wrong and wrong.count("\n") == 1
    assert (tmp_path / name).read_text() == "mine"
    nothing_else(tmp_path, name)


def test_a_full_disk_is_said_before_anything_is_written(command, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 1000))
    code, _, wrong = command(export, FORMAT="ply", OUT=tmp_path / "out")
    assert code == 1 and "the disk is full" in wrong and wrong.count("\n") == 1
    nothing_else(tmp_path)


def test_a_disk_that_fills_meanwhile_leaves_nothing(tmp_path):
    with pytest.raises(OSError, match="No space"), filed.beside(tmp_path / "out") as folder:
        folder.mkdir()
        (folder / "half").write_text("a half")
        raise OSError(28, "No space left on device")
    nothing_else(tmp_path)


def test_a_scene_that_was_not_run_names_the_command(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(filed, "compose", lambda words: (scene | {"output": str(tmp_path)}, {}))
    words = ["scene=a b", "profile=smoke", "method=physics3d", "seed=1", "output=it's"]
    for module in (export, film):
        assert module.main(words, {"FORMAT": "ply", "OUT": str(tmp_path / "out.mp4")}) == 1
        wrong = capsys.readouterr().err
        assert "not computed yet" in wrong and wrong.count("\n") == 1
        said = shlex.split(wrong.partition("; ")[2])
        assert said[:4] == ["make", "run", "SCENE=a b", "PROFILE=smoke"]
        assert shlex.split(said[4].removeprefix("ARGS=")) == ["seed=1", "output=it's"] and len(said) == 5


def test_a_film_has_the_size_and_the_length_that_were_asked_for(command, tmp_path):
    code, said, wrong = command(film, OUT=tmp_path / "a.mp4", SIZE="64x48", LENGTH="0.5")
    assert (code, wrong) == (0, "") and "12 frames of 64 x 48 px" in said
    frames, fps = read_mp4(tmp_path / "a.mp4")
    assert frames.shape == (12, 48, 64, 3) and fps == pytest.approx(FPS)
    assert frames.float().std() > 5  # something is in the picture
    nothing_else(tmp_path, "a.mp4")


def test_a_film_goes_round_slowly_and_ends_where_a_motion_ends(command, tmp_path):
    code, _, wrong = command(film, OUT=tmp_path / "a.mp4", SIZE="64x48")
    assert (code, wrong) == (0, "")
    frames, _ = read_mp4(tmp_path / "a.mp4")
    assert len(frames) % FRAMES == 0 and 0 <= len(frames) - 6 * FPS < FRAMES


@pytest.mark.parametrize(
    "environment", [{"SIZE": "big"}, {"SIZE": "63x48"}, {"SIZE": "0x0"}, {"LENGTH": "-1"}, {"LENGTH": "0"}]
)
def test_a_film_of_no_size_or_length_is_one_line(command, tmp_path, environment):
    code, _, wrong = command(film, OUT=tmp_path / "a.mp4", **environment)
    (name,) = environment
    assert code == 2 and wrong.startswith(f"error: {name}={environment[name]}") and wrong.count("\n") == 1
    nothing_else(tmp_path)
