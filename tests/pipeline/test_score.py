"""make score: any two clips, through the same door as the Makefile's."""

import numpy as np
import pytest
from clips import FPS, decaying, encode, swaying

from pipeline.score import main

SWAY = decaying(np.arange(60) / FPS, damping=0.4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A real clip; a prediction of half the size and rate, a bit longer, a little out of tune; and bad ones."""
    folder = tmp_path_factory.mktemp("clips with 'quotes' $and spaces")
    encode(swaying(SWAY, noise=2.0), folder / "real.mp4")
    half = np.arange(40) / 15
    small = swaying(decaying(half, frequency=2.02, damping=0.4), h=96, w=128)[:, ::2, ::2]
    encode(small, folder / "close.mp4", "-c:v", "libx264", "-crf", "8", "-pix_fmt", "yuv444p", fps=15)
    encode(swaying(SWAY[:30])[:, :, :64], folder / "narrow.mp4")
    encode(swaying(np.zeros(60)), folder / "still.mp4")
    encode(swaying(SWAY[:1]), folder / "one.mp4")
    (folder / "text.mp4").write_text("no video")
    return folder


def rows(text: str) -> dict[str, list[str]]:
    """Row of the first table -> cells."""
    table = [line.strip("|").split("|") for line in text.split("## ")[1].splitlines() if line.startswith("|")]
    return {cells[0].strip(): [c.strip() for c in cells[1:]] for cells in table}


def test_a_prediction_stands_beside_the_still_pictures(folder, capsys):
    assert main({"REAL": str(folder / "real.mp4"), "PRED": str(folder / "close.mp4")}) == 0
    out = folder / "close_score"
    text = (out / "score.md").read_text()
    for name in ("frames", "curves", "slices"):
        assert (out / "previews" / f"{name}.png").stat().st_size > 5000
    table = rows(text)
    header = table[""]
    psnr, error = header.index("PSNR [dB]"), header.index("flow error")
    stills = [name for name in table if "frozen" in name or "mean" in name]
    assert len(stills) == 3
    for still in stills:
        assert float(table["prediction"][psnr]) > float(table[still][psnr]) + 3  # it moves as the real one does
        assert float(table[still][error]) == pytest.approx(1, abs=1e-3) and float(table["prediction"][error]) < 0.6
    shown = capsys.readouterr().out
    for said in ("sizes", "rates 30 and 15 fps", "the first 2.00 s", "MS-SSIM needs"):
        assert said in shown and said in text


def test_the_folder_is_chosen(folder, tmp_path):
    out = tmp_path / "here it is"
    assert main({"REAL": str(folder / "real.mp4"), "PRED": str(folder / "real.mp4"), "OUT": str(out)}) == 0
    table = rows((out / "score.md").read_text())
    assert table["prediction"][table[""].index("PSNR [dB]")] == "inf"


@pytest.mark.parametrize(
    "real, predicted, message",
    [
        ("real", "text", "cannot read the clip text.mp4"),
        ("real", "none", "no clip at"),
        ("real", "one", "1 frame"),
        ("real", "narrow", "other shapes"),
        ("still", "real", "nothing moves"),
    ],
)
def test_what_cannot_be_compared_is_one_line(folder, capsys, real, predicted, message):
    assert main({"REAL": str(folder / f"{real}.mp4"), "PRED": str(folder / f"{predicted}.mp4")}) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (folder / f"{predicted}_score" / "score.md").exists() or predicted == "real"


def test_what_is_not_given_is_named(capsys):
    assert main({"REAL": "a.mp4"}) == 2 and "PRED is not given" in capsys.readouterr().err
    assert main({}) == 2 and "REAL is not given" in capsys.readouterr().err
    for nothing in (".", "/", ".."):  # they have no name that a folder could be called after
        assert main({"REAL": nothing, "PRED": nothing}) == 1 and "no clip at" in capsys.readouterr().err
