"""make reference-motion: what it is not made for is refused in one line, before anything is meshed."""

import pytest

from pipeline.reference_motion import main


@pytest.mark.parametrize(
    "words, code, line",
    [
        (["scene=carnation", "edge=long"], 2, "edge is a length in m"),
        (["scene=carnation", "steps=2.5"], 2, "steps a whole number"),
        (["scene=ball"], 1, "scene.source is a BallTwin"),
        (["scene=nothing"], 2, "nothing"),
    ],
)
def test_what_it_is_not_made_for_is_one_line(words, code, line, capsys):
    assert main(words) == code
    said = capsys.readouterr().err
    assert line in said and said.count("\n") == 1 and said.startswith("error: ")
