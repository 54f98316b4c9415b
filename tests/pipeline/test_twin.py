"""make twin takes words: another twin is the same one but for what they say."""

from dataclasses import replace

import pytest

from pipeline.settings import SettingsError
from pipeline.twin import changed, handed_over, main


def test_words_change_the_fields_that_they_name_and_no_other():
    words = ["youngs_modulus=3e5", "seed=1", "motion=stiffer", "learn_force=[0.1,0.0,0.02]"]
    twin = changed(handed_over(), words)
    expected = replace(handed_over(), youngs_modulus=3e5, seed=1, motion="stiffer", learn_force=[0.1, 0.0, 0.02])
    assert twin == expected and changed(handed_over(), []) == handed_over()


@pytest.mark.parametrize(
    "word", ["mass=1", "seed", "seed=", "seed=1.5", "youngs_modulus=-3", "youngs_modulus=soft", "fps=[1"]
)
def test_a_word_that_means_nothing_is_named_before_anything_is_made(word, tmp_path, capsys):
    with pytest.raises(SettingsError, match=word.partition("=")[0] if word != "fps=[1" else "expected"):
        changed(handed_over(), [word])
    assert main([word], {"OUT": str(tmp_path / "new")}) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "new").exists()
