"""docs/configuration.md is what `make configuration` makes now, leaves no entry out, and leaves none without words."""

import re
import shutil
from functools import cache

import pytest
import write_configuration
import yaml

from pipeline.fingerprint import ROOT
from pipeline.settings import CONF, GROUPS, choices

PAGE = ROOT / "docs" / "configuration.md"


@cache
def made() -> str:
    return write_configuration.page(CONF)


def test_the_page_is_the_files():
    """`make configuration` after a change of conf/ or of a hint."""
    assert PAGE.read_text() == made()


def leaves(tree, key=()):
    """Keys of a file as YAML reads it, without what writes the page; what stands in a list of numbers is its key's."""
    if isinstance(tree, dict):
        for name, value in tree.items():
            if name not in ("_target_", "defaults"):
                yield from leaves(value, (*key, str(name)))
    elif isinstance(tree, list) and any(isinstance(item, dict) for item in tree):
        for i, item in enumerate(tree):
            yield from leaves(item, (*key, str(i)))
    elif key:
        yield ".".join(key)


@cache
def rows(title: str) -> dict[str, list[str]]:
    """Entry -> its cells, of the section of that title."""
    section = re.search(rf"^### `{re.escape(title)}`\n(.*?)(?=^##|\Z)", made(), re.M | re.S)
    assert section, title
    cells = [re.split(r"(?<!\\)\|", line)[1:-1] for line in section[1].splitlines() if line.startswith("| `")]
    return {row[0].strip(" `"): [cell.strip() for cell in row[1:]] for row in cells}


def ancestors(key: str) -> list[str]:
    """The nearest first."""
    parts = key.split(".")
    return [".".join(parts[:i]) for i in range(len(parts) - 1, 0, -1)]


CHOICES = [(group, name) for group in GROUPS for name in choices(group)]


@pytest.mark.parametrize("group, name", CHOICES)
def test_every_entry_of_every_choice_is_on_the_page_with_words(group, name):
    plain = yaml.safe_load((CONF / group / f"{name}.yaml").read_text()) or {}
    found = rows(f"{group}={name}")
    for key in leaves(plain):
        if group == "material":
            if key in ("learn", "ties"):
                continue  # they are in the line above the tables
            key = key.removeprefix("start.")
        # a mapping on one line, and names with an object each, are one row, which has a value
        above = [key, *(k for k in ancestors(key) if k in found and found[k][0])]
        shown = next((k for k in above if k in found), None)
        assert shown, f"conf/{group}/{name}.yaml: {key} is not on the page"
        assert len(found[shown][-1]) > 1, key


def test_every_entry_of_the_experiment_is_on_the_page_with_words():
    plain = yaml.safe_load((CONF / "config.yaml").read_text())
    for key in leaves(plain):
        top, _, inner = key.partition(".")
        found = rows(top) if re.search(rf"^### `{top}`$", made(), re.M) else {}
        alone = re.search(rf"^\| `{re.escape(top)}` \|", made(), re.M)
        shown = next((k for k in (inner, inner.rpartition(".")[0]) if k in found), None)
        assert shown or alone, key
        assert not shown or len(found[shown][-1]) > 1, key


def test_the_default_on_the_page_is_the_one_in_the_file():
    """Of the experiment, read by YAML alone."""
    plain = yaml.safe_load((CONF / "config.yaml").read_text())
    for stage in ("world", "reconstruct", "segment", "fill", "learn", "simulate", "render"):
        for name, value in plain[stage].items():
            if name in (found := rows(stage)) and not isinstance(value, dict):
                assert yaml.safe_load(found[name][0].strip("`").replace("\\|", "|")) == value, f"{stage}.{name}"


def test_an_entry_that_nobody_explains_is_an_error(tmp_path):
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    added = {"config.yaml": "  cfl: 0.5", "scene/photos.yaml": "  dx: 0.02", "prior/exemplar.yaml": "blur: [1.0, 4.0]"}
    for file, line in added.items():
        text = (conf / file).read_text()
        assert line in text
        indent = " " * (len(line) - len(line.lstrip()))
        (conf / file).write_text(text.replace(line, f"{indent}riddle: 1 # [1/s]\n{line}", 1))
    with pytest.raises(write_configuration.NoWords) as error:
        write_configuration.page(conf)
    assert "3 entries need words" in str(error.value)
    assert all(f"{file}: " in str(error.value) for file in added) and str(error.value).count("riddle") == 3


@pytest.mark.parametrize("comment, value, words, unit", [
    ("cell of the grid [m]", "0.02", "cell of the grid", "m"),
    ("| true: a gain", "false", "false, or true: a gain", ""),
    ("[x, y, z] in its axes; null: guessed", "null", "[x, y, z] in its axes; null: guessed", ""),
    ("between neighbours [m], half a cell", "1", "between neighbours, half a cell", "m"),
    ("[Pa]", "1e5", "", "Pa"),
])  # fmt: skip
def test_a_comment_is_taken_apart_into_words_and_unit(comment, value, words, unit):
    assert write_configuration.split(comment, value) == (words, unit)
