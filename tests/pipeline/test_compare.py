"""The page that compares methods, and what its command refuses."""

import csv
import math

import pytest
import torch
from PIL import Image

from pipeline.compare import main
from pipeline.compare_page import METRICS, Row, write

ROWS = [
    Row(scene="cake", method="filmed", scores={}, video=torch.zeros((9, 12, 16, 3), dtype=torch.uint8)),
    Row(scene="cake", method="frozen first frame", scores={"psnr": 25.0, "flow_error": 1.0}),
    Row(
        scene="cake",
        method="physics3d",
        scores={"psnr": 30.0, "flow_error": 0.25},
        seconds=100.0,
        learned={"youngs_modulus": "1e5 (between 8e4 and 1.2e5)"},
        video=torch.full((9, 12, 16, 3), 200, dtype=torch.uint8),
    ),
    Row(scene="cake", method="without_filling", scores={"psnr": 28.0}, seconds=80.0),
]


def test_every_number_is_on_the_page_and_the_best_is_bold(tmp_path):
    write(tmp_path, ROWS, {("hat", "physics3d"): "capture: no photographs"}, {"seed": 7})
    text = (tmp_path / "compare.md").read_text()
    rows = {line.split("|")[1].strip(): line for line in text.splitlines() if line.startswith("| ")}
    assert "filmed" not in rows, "what was filmed has no score"
    assert "**30**" in rows["physics3d"] and "**0.25**" in rows["physics3d"] and "| 100 |" in rows["physics3d"]
    assert "**" not in rows["frozen first frame"] and "| 25 |" in rows["frozen first frame"]
    assert {line.count("|") for line in rows.values()} == {len(METRICS) + 3}
    assert "seed 7" in text and "1e5 (between 8e4 and 1.2e5)" in text
    assert "hat, physics3d: not done, capture: no photographs" in text
    table = list(csv.DictReader((tmp_path / "compare.csv").open()))
    assert [float(row["psnr"] or math.nan) for row in table[1:]] == [25.0, 30.0, 28.0]
    # a line of six pictures for what was filmed, and one for the method that has a video
    with Image.open(tmp_path / "compare_cake.jpg") as picture:
        assert picture.width > 2 * picture.height
    assert (tmp_path / "compare.png").stat().st_size > 1000


@pytest.mark.parametrize(
    "words, message",
    [
        (["scenes=carnation", "methods=physgaussian"], "take physics3d among them"),
        (["scenes=carnation", "methods=physics3d,nothing"], "no method 'nothing'"),
        (["scenes="], "scenes is empty"),
        (["scenes=carnation", "runner=train"], "runner is 'train'"),
    ],
)
def test_what_cannot_be_compared_is_one_line(words, message, capsys):
    assert main(words) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
