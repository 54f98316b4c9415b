"""make reference-motion: what it is not made for is refused in one line, before anything is meshed."""

import pytest

from pipeline.reference_motion import main


@pytest.mark.parametrize(
    "words, code, line",
    [
        *((["scene=carnation", f"edge={x}"], 2, f"edge={x}: take an edge of") for x in ("long", "nan", "0", "-1")),
        *((["scene=carnation", f"steps={n}"], 2, "a whole number of 1 to 1000") for n in ("2.5", "0", "-1", "")),
        (["scene=trained", "data=a, (b"], 1, "scene.source is a PlyScene"),
        (["scene=ball"], 1, "scene.source is a BallTwin"),
        (["scene=nothing"], 2, "nothing"),
    ],
)
def test_what_it_is_not_made_for_is_one_line(words, code, line, capsys):
    assert main(words) == code
    said = capsys.readouterr().err
    assert line in said and said.count("\n") == 1 and said.startswith("error: ")
