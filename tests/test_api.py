"""The public interface: all of it is there, and described as it is. What it does without: test_imports.py."""

import inspect
import re
from pathlib import Path

import pytest

import physics3d

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "api.md").read_text()


def signature(name: str) -> str:
    """As the page writes it: names of the arguments, those by name only behind a star."""
    of = getattr(physics3d, name)
    if inspect.isclass(of) and issubclass(of, Exception):
        return name
    words, only_by_name = [], False
    for p in inspect.signature(of).parameters.values():
        if p.kind == p.KEYWORD_ONLY and not only_by_name:
            words.append("*")
            only_by_name = True
        words.append(p.name)
    return f"{name}({', '.join(words)})" if words else name


@pytest.mark.parametrize("name", physics3d.__all__)
def test_a_public_name_is_described_where_it_is_and_on_the_page_as_it_is(name):
    of = getattr(physics3d, name)
    text = inspect.getdoc(of) or ""
    assert len(text.split()) >= 4 and not text.startswith(f"{name}("), f"{name} needs a docstring of its own"
    rows = [row for row in PAGE.splitlines() if row.startswith(f"| `{signature(name)}` | `{of.__module__}` | ")]
    assert len(rows) == 1, f"docs/api.md needs a row: | `{signature(name)}` | `{of.__module__}` | what it is |"


def test_the_page_names_nothing_that_is_not_public():
    assert sorted(re.findall(r"^\| `(\w+)", PAGE, re.M)) == sorted(physics3d.__all__)
    with pytest.raises(AttributeError, match="public are Log"):
        physics3d.Rollout  # noqa: B018
    assert set(physics3d.__all__) <= set(dir(physics3d))
